"""``marlbc list``, ``perf``, ``ablation`` and ``oracle``: what there is, how fast it is, and the studies behind the numbers."""

import sys
from dataclasses import dataclass
from pathlib import Path

from marlbc_mj.terminal import progress_bars


@dataclass(frozen=True)
class ListAll:
    """List everything that can be selected, one line each."""

    def run(self) -> None:
        """Print every registry."""
        from marlbc_mj.listing import selectable

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
        from marlbc_mj.files import write_json
        from marlbc_mj.perf import measure_perf, perf_lines
        from marlbc_mj.provenance import provenance

        figures = measure_perf(self.rounds, progress=lambda message: print(f"measuring {message}", file=sys.stderr))
        print("\n".join(perf_lines(figures)))
        if self.json is not None:
            write_json(self.json, {**figures, **provenance()})
            print(self.json)


@dataclass(frozen=True)
class Ablation:
    """Measure what SORLC's basis is worth: printed, scaled, off, the exact model, and the sweep of the scaled gains."""

    out: Path | None = None
    """Markdown file for the tables."""
    overwrite: bool = False
    """Replace an existing file."""

    def run(self) -> None:
        """Run the studies and print their tables."""
        from marlbc_mj.ablation import basis_study, gain_sweep, markdown
        from marlbc_mj.files import staged_file

        with progress_bars() as progress:
            text = markdown(basis_study(progress)) + "\n\n" + markdown(gain_sweep(progress)) + "\n"
        print(text)
        if self.out is not None:
            with staged_file(self.out, overwrite=self.overwrite) as staging:
                staging.write_text(text)


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
        from marlbc_mj.supervisors.oracle import save, search

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
        save(found, scenario, self.controller, self.out)
        print(f"return {found.total:.0f} after {found.episodes} episodes (scripted: {found.scripted})")
