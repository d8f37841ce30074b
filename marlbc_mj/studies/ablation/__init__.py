"""Ablations: what each choice of controller, reading and clock is worth, measured on whole episodes."""

from marlbc_mj.studies.ablation.measure import Case, Figures, Row, Study, run_study
from marlbc_mj.studies.ablation.page import study_table, write_page
from marlbc_mj.studies.ablation.studies import STUDIES, select_studies

__all__ = ["STUDIES", "Case", "Figures", "Row", "Study", "run_study", "select_studies", "study_table", "write_page"]
