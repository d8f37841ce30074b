"""Ablations: the effect of each choice of controller, of reading of the paper, and of time step, measured on whole episodes."""

from marlbc_mj.studies.ablation.cases import AblationRow, Case, Figures, Question
from marlbc_mj.studies.ablation.jobs import AblationStudy, run_ablation
from marlbc_mj.studies.ablation.page import ablation_table, write_ablation_page
from marlbc_mj.studies.ablation.questions import QUESTIONS, select_questions

__all__ = [
    "QUESTIONS",
    "AblationRow",
    "AblationStudy",
    "Case",
    "Figures",
    "Question",
    "ablation_table",
    "run_ablation",
    "select_questions",
    "write_ablation_page",
]
