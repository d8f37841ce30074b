"""The ablation study: one job per case of every question, and a page with all tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from marlbc_mj.report.table import table_document, to_markdown
from marlbc_mj.studies.ablation.cases import AblationRow, Case, Measured, Question, compare_rows, measure_case
from marlbc_mj.studies.ablation.page import ablation_table, write_ablation_page
from marlbc_mj.studies.engines import EngineName
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import Conclusion, counting, run_study
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import git_revision, versions


class AblationJob(NamedTuple):
    """One case of a question."""

    question: str
    case: Case


@dataclass(frozen=True)
class AblationStudy:
    """Study that runs all cases of the chosen questions and makes one table per question."""

    questions: tuple[Question, ...]

    def jobs(self) -> list[AblationJob]:
        return [AblationJob(question.name, case) for question in self.questions for case in question.cases()]

    def run(self, job: AblationJob, watch: Watch) -> Measured:
        return measure_case(job.case)

    def rows(self, results: Sequence[Measured]) -> dict[str, tuple[Question, list[AblationRow]]]:
        """Each question with its rows, by the question's name, from the results of all jobs."""
        rows, begin = {}, 0
        for question in self.questions:
            end = begin + len(question.cases())
            rows[question.name] = question, compare_rows(question, results[begin:end])
            begin = end
        return rows

    def report(self, results: Sequence[Measured], out: Path | None, progress: Progress = silent) -> Report:
        rows = self.rows(results)
        if out is not None:
            facts = {"revision": git_revision(), "versions": ", ".join(f"{k} {v}" for k, v in versions().items())}
            write_ablation_page(rows, out, facts)
        tables = [ablation_table(question, made) for question, made in rows.values()]
        return Report("\n".join(map(to_markdown, tables)), list(map(table_document, tables)))


def run_ablation(
    questions: Sequence[Question],
    out: Path | None = None,
    *,
    overwrite: bool = False,
    workers: int = 1,
    engine: EngineName = "local",
    progress: Progress = silent,
) -> Conclusion[Measured]:
    """Run all cases of the questions and write ablation.md, ablation.csv and index.html into ``out``.

    Raises:
        ConfigurationError: ``out`` cannot be written.
    """
    study = AblationStudy(tuple(questions))
    ended = counting(study.jobs(), lambda job: job.question, progress)
    return run_study(study, out, overwrite=overwrite, workers=workers, engine=engine, ended=ended)
