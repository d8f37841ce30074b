"""Supervisors on held-out layouts of a scenario family: how often missions succeed, and why the others fail."""

from collections.abc import Sequence
from pathlib import Path

from marlbc_mj.results.seeds import SeedResults
from marlbc_mj.results.summary import method_key
from marlbc_mj.scenarios import Scenario, held_out
from marlbc_mj.studies.bench import BenchConfig
from marlbc_mj.studies.draws import run_bench_seeds
from marlbc_mj.studies.engines import EngineName
from marlbc_mj.supervisors import UNLEARNED
from marlbc_mj.util.progress import Progress

AGAINST = "fsams-hysteresis"
"""The supervisor that others are compared with, if it is among those that run."""


def run_evaluation(scenario: Scenario, config: BenchConfig, out: Path, *, progress: Progress | None = None) -> SeedResults:
    """Run the methods of :func:`evaluation` on layouts never used in training; writes the same files as ``bench --seeds``.

    Raises:
        ConfigurationError: a scenario that draws no layouts, an invalid setting or output folder; nothing is written then.
    """
    return run_bench_seeds(held_out(scenario), config, out, progress=progress)


def evaluation(
    supervisors: Sequence[str] | None = None,
    controller: str = "sorlc",
    *,
    seeds: int = 200,
    seed: int = 0,
    workers: int = 1,
    engine: EngineName = "local",
    overwrite: bool = False,
    shield: bool = False,
) -> BenchConfig:
    """Settings for supervisors with one controller on ``seeds`` layouts from ``seed`` on; by default all unlearned supervisors.

    Raises:
        ConfigurationError: unknown or repeated names, or a number out of range.
    """
    names = UNLEARNED if supervisors is None else tuple(supervisors)
    against = AGAINST if AGAINST in names or not names else names[0]
    return BenchConfig(
        supervisors=names,
        controllers=(controller,),
        seed=seed,
        seeds=seeds,
        workers=workers,
        engine=engine,
        overwrite=overwrite,
        shield=shield,
        against=method_key(against, controller),
    )
