"""Every method on the same draws around a scenario: a job is one method on up to 100 seeds, many of them simulated together."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.controllers import make_controller
from marlbc_mj.report.seed_page import write_seed_report
from marlbc_mj.report.so_far import write_seeds_so_far
from marlbc_mj.results.seeds import MethodRuns, SeedResults, seed_range
from marlbc_mj.results.summary import method_key
from marlbc_mj.scenarios import Perturbation, Scenario
from marlbc_mj.studies.batches import evaluate_batch
from marlbc_mj.studies.bench import BenchConfig, describe
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import run_jobs, run_study
from marlbc_mj.studies.so_far import PartialPage
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, check_named_once
from marlbc_mj.util.files import write_json
from marlbc_mj.util.progress import Progress, silent

CASE_STUDY_PERTURBATION = Perturbation(start_spread=1.0, obstacle_spread=0.5, drag_scale=(0.0, 2.0))
"""For scenarios without their own: starts within 1 m, obstacles within 0.5 m per axis, drag from zero to twice the published one.

In the case study slots pass the point obstacles at 1 m, and the gate is 8 m wide. So 0.5 m changes when a supervisor has to
act, not whether the mission is feasible. A schedule fixed in time may then violate the safe distance; that is an outcome.
"""
SEEDS_PER_JOB = 100
"""Small enough that a study has more jobs than workers and that repeating a job is quick."""


class DrawsJob(NamedTuple):
    """One method on some seeds."""

    scenario: Scenario
    supervisor: str
    controller: str
    seeds: tuple[int, ...]
    shield: bool = False  # whether agents have a shield


@dataclass(frozen=True)
class DrawsStudy:
    """Methods on the same draws of a scenario, compared in tables with intervals. No method's runs depend on the other methods.

    Raises:
        ConfigurationError: unknown names, no or repeated methods or seeds.
    """

    scenario: Scenario
    """The scenario, with the perturbation that draws are made from."""
    methods: tuple[tuple[str, str], ...]
    """Names of supervisor and controller."""
    seeds: tuple[int, ...]
    against: str | None = None
    """Key of the method that others are compared with; None: the first."""
    config: BenchConfig | None = None
    """The settings of the benchmark, for the report."""

    def __post_init__(self) -> None:
        keys = [method_key(*method) for method in self.methods]
        if not keys:
            raise ConfigurationError("name at least one supervisor and one controller")
        check_named_once("method", keys)
        if not self.seeds:
            raise ConfigurationError("name at least one seed")
        if len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise ConfigurationError(f"seeds must differ and not be negative, got {list(self.seeds)}")
        if self.against is not None and self.against not in keys:
            raise ConfigurationError(f"reference {self.against!r} is not among the methods; choose from: {', '.join(keys)}")
        for supervisor, controller in self.methods:
            make_supervisor(supervisor, controller)
            make_controller(controller)

    def jobs(self) -> list[DrawsJob]:
        shield = self.config is not None and self.config.shield
        parts = [self.seeds[first : first + SEEDS_PER_JOB] for first in range(0, len(self.seeds), SEEDS_PER_JOB)]
        return [DrawsJob(self.scenario, *method, seeds, shield) for method in self.methods for seeds in parts]

    def run(self, job: DrawsJob, watch: Watch) -> MethodRuns:
        return fly_draws(job, watch.progress)

    def gather(self, runs: Sequence[MethodRuns]) -> SeedResults:
        """The whole matrix from the results of all jobs."""
        methods = groupby(runs, lambda part: (part.supervisor, part.controller))
        whole = (MethodRuns(*names, tuple(chain.from_iterable(part.runs for part in parts))) for names, parts in methods)
        return SeedResults(self.scenario, self.seeds, tuple(whole), self.against or method_key(*self.methods[0]))

    def report(self, results: Sequence[MethodRuns], out: Path | None, progress: Progress = silent) -> Report:
        if out is not None:
            config = self.config or BenchConfig()
            facts = describe(self.scenario, config)
            write_json(out / "config.json", facts)
            write_seed_report(self.gather(results), out, config=facts, figures=config.figures, progress=progress)
        return Report()


def run_bench_seeds(scenario: Scenario, config: BenchConfig, out: Path, *, progress: Progress | None = None) -> SeedResults:
    """Run the whole matrix on ``config.seeds`` draws around the scenario; writes tables with intervals, no logs and no videos.

    Until all methods have ended, ``out/.jobs/so_far`` holds a page and tables of those that have.

    Raises:
        ConfigurationError: an invalid setting or output folder; nothing is written then.
    """
    seeds = seed_range(config.seeds or 0, config.seed)
    study = DrawsStudy(perturbed(scenario), tuple(config.methods), seeds, config.against, config)
    done = run_study(
        study,
        out,
        overwrite=config.overwrite,
        workers=config.workers,
        engine=config.engine,
        progress=tallied(study.methods, len(seeds), progress or silent),
        ended=growing_page(study, out, describe(study.scenario, config)),
    )
    return study.gather(done.results)


def growing_page(study: DrawsStudy, out: Path, facts: Mapping[str, Any]) -> Callable[[DrawsJob, MethodRuns], None]:
    """A callback for ``ended`` that keeps a page of the methods whose jobs have all ended."""
    parts = dict[tuple[str, int], MethodRuns]()  # by method and first seed
    own = {key: [(key, job.seeds[0]) for job in jobs] for key, jobs in groupby(study.jobs(), _key)}

    def write(ended: Sequence[list[MethodRuns]], total: int, folder: Path) -> None:
        write_seeds_so_far(study.gather(list(chain.from_iterable(ended))), total, folder, facts)

    page = PartialPage(out, list(own), write)

    def tell(job: DrawsJob, runs: MethodRuns) -> None:
        key = _key(job)
        parts[key, job.seeds[0]] = runs
        if all(part in parts for part in own[key]):
            page.add(key, [parts[part] for part in own[key]])

    return tell


def _key(job: DrawsJob) -> str:
    return method_key(job.supervisor, job.controller)


def run_methods(
    scenario: Scenario,
    methods: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    progress: Progress | None = None,
    *,
    reference: str | None = None,
    workers: int = 1,
) -> SeedResults:
    """Run every method on every seed.

    A run that fails, or a method that cannot start in this scenario, is kept with its reason.

    Args:
        scenario: the scenario to draw from, with the perturbation that :func:`perturbed` gives it.
        methods: names of supervisor and controller.
        seeds: one draw each, the same for every method.
        progress: called with the method, the number of its seeds that are done and their total.
        reference: key of the method that others are compared with; the first by default.
        workers: processes that run the jobs; decision times are best measured with one.

    Raises:
        ConfigurationError: unknown names, no or repeated methods or seeds; nothing has been run then.
    """
    study = DrawsStudy(perturbed(scenario), tuple(methods), tuple(seeds), reference)
    told = tallied(study.methods, len(study.seeds), progress or silent)
    return study.gather(run_jobs(study, workers=workers, progress=told))


def perturbed(scenario: Scenario) -> Scenario:
    """The scenario; with the case study's perturbation if it has none of its own and draws no layouts."""
    if scenario.perturbation != Perturbation() or scenario.layout is not None:
        return scenario
    return replace(scenario, perturbation=CASE_STUDY_PERTURBATION)


def with_drag_range(scenario: Scenario, drag_range: tuple[float, float]) -> Scenario:
    """The scenario with the case study's perturbation, but its disturbance multiplied by a draw from ``drag_range``."""
    return replace(scenario, perturbation=replace(CASE_STUDY_PERTURBATION, drag_scale=drag_range))


def fly_draws(job: DrawsJob, progress: Progress = silent) -> MethodRuns:
    """Run one method on the seeds of a job; ``progress`` is called after every seed."""
    runs = evaluate_batch(job.scenario, job.seeds, job.supervisor, job.controller, shield=job.shield, progress=progress)
    return MethodRuns(job.supervisor, job.controller, runs)


def tallied(methods: Sequence[tuple[str, str]], total: int, progress: Progress) -> Progress:
    """A progress callback that sums the jobs of each method, which report every seed once, up to ``total`` seeds per method."""
    keys, done = {method_key(*method) for method in methods}, Counter[str]()

    def tell(what: str, part: float, of: float) -> None:
        done[what] += 1
        progress(what, *((done[what], total) if what in keys else (part, of)))

    return tell
