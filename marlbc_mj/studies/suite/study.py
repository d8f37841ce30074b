"""The suite as a study: each job flies one method on a block of layouts; the report makes files and a page of all results."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from marlbc_mj.report.leaderboard import leading_tables, write_leaderboard
from marlbc_mj.report.table import table_document, to_markdown
from marlbc_mj.results.layout_runs import LayoutRun, MissionRuns
from marlbc_mj.studies.addresses import code_version
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.suite.clips import render_clips
from marlbc_mj.studies.suite.definition import TRACKS, SuiteMission
from marlbc_mj.studies.suite.entries import Choice
from marlbc_mj.studies.suite.files import SuiteResults, describe_suite, merge, read_suite, write_suite
from marlbc_mj.studies.suite.flights import SuiteJob, fly_layouts, suite_jobs
from marlbc_mj.util.progress import Progress, note, silent


@dataclass(frozen=True)
class SuiteStudy:
    """Study that flies every chosen method on every layout of the chosen missions."""

    missions: tuple[SuiteMission, ...]
    choice: Choice
    beside: Path | None = None
    """Folder of earlier suite results that are shown next to the new ones; None: none."""
    clips: bool = False
    """Whether the worst and the median layout of every method are rendered."""

    def jobs(self) -> list[SuiteJob]:
        return suite_jobs(self.missions, self.choice)

    def run(self, job: SuiteJob, watch: Watch) -> tuple[LayoutRun, ...]:
        return fly_layouts(job)

    def gather(self, results: Sequence[tuple[LayoutRun, ...]]) -> SuiteResults:
        """The rows of all jobs and the earlier results; without missions, the earlier results alone.

        Raises:
            ConfigurationError: earlier results that cannot be compared, see :func:`~marlbc_mj.studies.suite.files.read_suite`.
        """
        others = None if self.beside is None else read_suite(self.beside)
        if others is not None and not self.missions:
            return others
        pairs = zip(self.jobs(), results, strict=True)
        groups = [
            MissionRuns(*key, tuple(run for _, block in blocks for run in block))
            for key, blocks in groupby(pairs, key=lambda pair: (pair[0].track, pair[0].mission, pair[0].method))
        ]
        own = SuiteResults(describe_suite(), tuple(groups))
        return own if others is None else merge(own, others)

    def report(self, results: Sequence[tuple[LayoutRun, ...]], out: Path | None, progress: Progress = silent) -> Report:
        gathered = self.gather(results)
        if out is None:
            return Report()
        flown = {job.method: job.entrant for job in self.jobs()}
        problems = render_clips(gathered.groups, flown, out, progress) if self.clips else []
        write_suite(gathered, out)
        tables = write_leaderboard(gathered.groups, gathered.facts, track_summaries(), out)
        document = {"facts": gathered.facts, "tables": list(map(table_document, tables))}
        text = "\n".join(map(to_markdown, leading_tables(tables)))
        for line in _other_code_versions(gathered):
            note(line)
        return Report(text, document, tuple(problems))


def _other_code_versions(results: SuiteResults) -> list[str]:
    """One line for every other version of the code that made some of the results."""
    codes = dict.fromkeys(str(facts["code"]) for facts in (results.facts, *results.facts.get("beside", ())))
    return [f"some rows come from other code ({code}) than this ({code_version()})" for code in codes if code != code_version()]


def track_summaries() -> dict[str, str]:
    """One line about every track, by name, in the order of the leaderboard."""
    return {name: track.summary for name, track in TRACKS.items()}
