"""``marlbc list``, ``perf``, ``ablation``, ``calibrate`` and ``oracle``: what there is, how fast, and what is behind it."""

import sys
from dataclasses import dataclass
from pathlib import Path

from marlbc_mj.cli.terminal import progress_bars


@dataclass(frozen=True)
class ListAll:
    """List everything that can be selected, one line each."""

    def run(self) -> None:
        """Print every registry."""
        from marlbc_mj.cli.listing import selectable

        for kind, entries in selectable().items():
            print(f"{kind}:")
            width = max(map(len, entries))
            for name, line in entries.items():
                print(f"  {name:<{width}}  {line}")


@dataclass(frozen=True)
class Perf:
    """Measure this machine: bare mj_step, the closed loop, the Python loop, batches, an episode, a log."""

    json: Path | None = None
    """File for the figures."""
    rounds: int = 9
    """Rounds, each running every variant once; medians are reported."""

    def run(self) -> None:
        """Measure, print, and write if asked."""
        from marlbc_mj.studies.perf import measure_perf, perf_lines
        from marlbc_mj.util.files import write_json
        from marlbc_mj.util.provenance import provenance

        figures = measure_perf(self.rounds, progress=lambda message: print(f"measuring {message}", file=sys.stderr))
        print("\n".join(perf_lines(figures)))
        if self.json is not None:
            write_json(self.json, {**figures, **provenance()})
            print(self.json)


@dataclass(frozen=True)
class Ablation:
    """Measure what SORLC's basis, its gains and compensator, the reference mode, the avoidance and the substep are worth."""

    study: tuple[str, ...] = ()
    """Studies to run: basis, sweep, sorlc, reference, avoidance, substep; all of them by default."""
    out: Path | None = None
    """Folder for ablation.md, ablation.csv and index.html."""
    overwrite: bool = False
    """Replace what is in the output folder."""

    def run(self) -> None:
        """Run the studies, print their tables, and write the page if asked."""
        from contextlib import nullcontext

        from marlbc_mj.report.table import to_markdown
        from marlbc_mj.studies.ablation import run_study, select_studies, study_table, write_page
        from marlbc_mj.util.files import staged_folder
        from marlbc_mj.util.provenance import git_revision, versions

        studies = select_studies(self.study)
        with nullcontext() if self.out is None else staged_folder(self.out, overwrite=self.overwrite) as folder:
            with progress_bars() as progress:
                results = {study.name: (study, run_study(study, progress)) for study in studies}
            if folder is not None:
                facts = {"revision": git_revision(), "versions": ", ".join(f"{k} {v}" for k, v in versions().items())}
                write_page(results, folder, facts)
        print("\n".join(to_markdown(study_table(study, rows)) for study, rows in results.values()))
        if self.out is not None:
            print(f"{self.out / 'index.html'} shows it all")


@dataclass(frozen=True)
class Calibrate:
    """Find the velocity gains that give Table 6's printed maxima, and compare them with the shipped ones."""

    controllers: tuple[str, ...] = ("finite-time", "fixed-time")
    """Controllers to calibrate."""

    def run(self) -> None:
        """Search and print the table."""
        from functools import partial

        from marlbc_mj.studies.calibration import CALIBRATED, calibrate, calibration_lines
        from marlbc_mj.util.errors import unknown

        for name in self.controllers:
            if name not in CALIBRATED:
                raise unknown("calibrated controller", name, CALIBRATED)
        with progress_bars() as progress:
            results = [calibrate(name, progress=partial(progress, name)) for name in self.controllers]
        print("\n".join(calibration_lines(results)))


@dataclass(frozen=True)
class OracleSearch:
    """Search the best safe switch times on the simulator, for the oracle supervisor; takes minutes."""

    scenario: str = "paper"
    """Scenario."""
    controller: str = "sorlc"
    """Controller that tracks the references."""
    seed: int = 0
    """Of the search."""
    budget: int = 4096
    """Episodes that may be simulated."""
    threads: int = 2
    """Worlds are shared out over this many."""
    out: Path | None = None
    """Cache to add the schedule to; the one that comes with the package by default."""

    def run(self) -> None:
        """Search, save, and say what was found."""
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.supervisors.oracle import save_schedule, search

        scenario = make_scenario(self.scenario)
        with progress_bars() as progress:
            found = search(
                scenario,
                self.controller,
                seed=self.seed,
                budget=self.budget,
                threads=self.threads,
                progress=lambda done, total: progress("search", done, self.budget),
            )
        save_schedule(found, scenario, self.controller, self.out)
        print(f"return {found.total:.0f} after {found.episodes} episodes (scripted: {found.scripted})")
