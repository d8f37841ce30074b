"""``marlbc study`` and ``marlbc arms``: train variants of a learner on several seeds, in worker processes, and compare them."""

import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes

from marlbc_mj.cli.choices import ArmNames, SomeCount, SomePath, StudySource, TrainingSettings, VariantNames
from marlbc_mj.cli.output import ReportOptions
from marlbc_mj.util.errors import SimulationError
from marlbc_mj.util.progress import note

DEFAULT_OUT = Path("runs/study")


@dataclass(frozen=True)
class StudyCommand:
    """Compare learners (MARLMS, its ablations and baselines) on several seeds each; the same command resumes a stopped study."""

    variants: VariantNames = ()
    """Variants to train; all of them by default."""
    seeds: int = 5
    """Runs per variant, with seeds from 0 on."""
    budget: SomeCount = None
    """Mission steps per run; by default the budget of the preset `fast`."""
    workers: int = 2
    """Number of processes that share the runs, with one thread each."""
    out: SomePath = None
    """Folder for runs, study.csv, curves.csv, study.md, study.tex, and the figure as PDF and PNG; runs/study by default."""
    source: StudySource = None
    """Only make table and figure again from study.csv and curves.csv in this folder; written there or into --out."""
    set: TrainingSettings = ()
    """Settings for all runs, as in `marlbc train`."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Train the unfinished runs, then write and print the comparison; a stopped study compares the results so far.

        Raises:
            SimulationError: a run failed; the comparison shows that, too.
        """
        from marlbc_mj.studies.learners.records import read_study
        from marlbc_mj.studies.learners.trainings import LearnerStudy, compare_learners, failed_runs, train_learners

        if self.source is not None:
            report = compare_learners(*read_study(self.source), self.out or self.source)
            self.output.report(report.text, report.document)
            return
        from marlbc_mj.util.changes import with_settings

        adjust = partial(with_settings, settings=self.set)
        study = LearnerStudy(self.out or DEFAULT_OUT, self.variants, self.seeds, self.budget, adjust)
        stopped = train_learners(study, self.workers, self.output.lines())
        report = study.report((), study.out)
        self.output.report(report.text, report.document)
        if stopped:
            note("stopped; every run is saved; repeat the command to resume")
            sys.exit(128 + stopped)
        failed = failed_runs(study)
        if failed:
            raise SimulationError(f"{len(failed)} of {len(study.jobs())} runs failed: {', '.join(failed)}")


@dataclass(frozen=True)
class ArmsCommand:
    """Run ablations of marlms-general: change one setting at a time, train on several seeds, and fly on held-out layouts."""

    arms: ArmNames = ()
    """Arms (ablations) to train; all of them by default."""
    seeds: int = 5
    """Training runs per arm, with seeds from 1 on."""
    budget: int = 400_000
    """Mission steps per training run."""
    layouts: int = 40
    """Number of held-out layouts per mission."""
    seed: int = 70_000
    """Seed of the first layout."""
    workers: int = 1
    """Number of processes, or of tasks in a SLURM array, that share the training runs."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where jobs run: on this machine, on Ray (the cluster in RAY_ADDRESS, else this machine), or in a SLURM array."""
    out: Path = Path("out/arms")
    """Folder for arms.csv, arms.md, and the figure as PDF and PNG."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Train and fly all arms that have not finished, then write and print the comparison."""
        from marlbc_mj.studies.learners.arms import ArmStudy
        from marlbc_mj.studies.runner import counting, run_study

        study = ArmStudy(self.arms, self.seeds, self.budget, self.layouts, self.seed)
        with self.output.progress() as told:
            ended = counting(study.jobs(), lambda _: "trainings", told.progress)
            done = run_study(study, self.out, overwrite=self.overwrite, workers=self.workers, engine=self.engine, ended=ended)
        self.output.report(done.report.text, done.report.document)
        self.output.say(f"{self.out / 'arms.pdf'} shows the results")
