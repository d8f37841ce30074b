"""``marlbc evaluate`` and ``marlbc scale``: supervisors on missions nobody was tuned for, and what teams of any size cost."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.benchmark import ScenarioOptions
from marlbc_mj.cli.terminal import progress_bars


@dataclass(frozen=True)
class Evaluate:
    """Run supervisors on held-out layouts of a scenario family: success, violation and collision rates with intervals.

    By default every supervisor without learning. Scripted schedules and the oracle's belong to scenarios whose geometry is the
    same for every seed; elsewhere they are reported as failed, with the reason.
    """

    scenario: Positional[str] = "field"
    """Scenario that draws layouts, see `marlbc list`, or a .toml file."""
    supervisors: tuple[str, ...] | None = None
    """Supervisors to run."""
    controller: str = "sorlc"
    """Controller they run with."""
    seeds: int = 200
    """Number of held-out layouts."""
    seed: int = 0
    """First seed."""
    workers: int = 1
    """Processes that share the supervisors."""
    out: Path = Path("out/evaluation")
    """Folder of the results."""
    overwrite: bool = False
    """Replace the results in the output folder."""
    options: OmitArgPrefixes[ScenarioOptions] = field(default_factory=ScenarioOptions)

    def run(self) -> None:
        """Evaluate, and print the table of outcomes."""
        from marlbc_mj.report.seed_tables import outcome_table
        from marlbc_mj.report.table import to_markdown
        from marlbc_mj.results.summary import method_key
        from marlbc_mj.scenarios import held_out
        from marlbc_mj.studies.bench import BenchConfig, run_bench_seeds
        from marlbc_mj.supervisors import UNLEARNED

        names = UNLEARNED if self.supervisors is None else self.supervisors
        against = "fsams-hysteresis" if "fsams-hysteresis" in names else names[0]
        config = BenchConfig(
            supervisors=names,
            controllers=(self.controller,),
            seed=self.seed,
            seeds=self.seeds,
            workers=self.workers,
            overwrite=self.overwrite,
            against=method_key(against, self.controller),
        )
        with progress_bars() as progress:
            results = run_bench_seeds(held_out(self.options.build(self.scenario)), config, self.out, progress=progress)
        print(to_markdown(outcome_table(results)))
        print(f"{self.out / 'index.html'} shows it all")


@dataclass(frozen=True)
class Scale:
    """Measure what a mission step costs per agent, and the memory of a world, for teams from 4 to 256 agents."""

    out: Path | None = None
    """Folder for scale.md, scale.json and figures/scale.{pdf,png}."""
    rounds: int = 7
    """Rounds, each running every size once; medians are reported."""
    overwrite: bool = False
    """Replace what is in the output folder."""

    def run(self) -> None:
        """Measure, print the table, and write table and figure if asked."""
        from contextlib import nullcontext

        from marlbc_mj.report.table import to_markdown
        from marlbc_mj.studies.scale import measure_scale, scale_table, write_scale
        from marlbc_mj.util.files import staged_folder

        with nullcontext() if self.out is None else staged_folder(self.out, overwrite=self.overwrite) as folder:
            figures = measure_scale(self.rounds, progress=lambda message: print(f"measuring {message}", file=sys.stderr))
            if folder is not None:
                write_scale(figures, folder)
        print(to_markdown(scale_table(figures)))
        if self.out is not None:
            print(f"{self.out} holds table, figures and numbers")
