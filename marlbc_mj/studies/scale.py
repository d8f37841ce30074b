"""Cost of teams from 4 to 256 agents: time per agent and mission step, and memory of a world.

Every size runs the same mission: a grid formation among discs, with the same number of discs per agent. All agents are under
OA>AA>FM, so every mission step looks up the nearest obstacle and the nearest neighbor of every agent. Sizes take turns within one
process, so that ratios are reliable on a machine with other load. Small teams are batched to as many agents as the largest team,
so that the time measured is that of the loop, not of the call.
"""

import gc
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.report import plotting as pl
from marlbc_mj.report.table import Column, Table, to_markdown
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.families import Field
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import Conclusion, run_study
from marlbc_mj.studies.timing import check_rounds, interleaved, ratio
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.files import write_json
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import cpu, provenance

SIZES = (4, 8, 16, 32, 64, 128, 256)
SCALED_SUPERVISORS = ("fsams", "fms", "layered")
DISCS = 1  # per agent
AGENT_STEPS = 2560  # agents x mission steps in one burst
MEMORY_AGENTS = 2048  # total number of agents of the worlds whose memory is measured
LEAST_WORLDS = 64  # enough to make leftover memory of plans negligible


def mission(agents: int) -> Scenario:
    """A grid of agents on a route with one disc per agent, dense enough that nearest-thing queries matter at every size."""
    length = float(30.0 + 12.0 * np.ceil(np.sqrt(agents)))
    discs = Field(obstacles=DISCS * agents, radius=(0.3, 0.6), gap=2.5)
    return discs.build(name=f"scale-{agents}", agents=agents, formation="grid", length=length)


class SizedTeams:
    """Worlds of one team size, with all agents under OA>AA>FM."""

    def __init__(self, agents: int) -> None:
        self.scenario = mission(agents)
        self.world = World(self.scenario, worlds=max(1, max(SIZES) // agents))
        self.orders = np.full((self.world.worlds, agents), self.scenario.orders.index("OA>AA>FM"))
        self.steps = max(1, AGENT_STEPS // (self.world.worlds * agents))
        self.agent_steps = self.world.worlds * agents * self.steps
        self.supervisors = {name: make_supervisor(name) for name in SCALED_SUPERVISORS}
        self.memories = {name: supervisor.start(self.scenario, 1) for name, supervisor in self.supervisors.items()}

    def advance(self) -> None:
        """Run one burst of mission steps; a finished mission starts again."""
        for _ in range(self.steps):
            if self.world.state.steps[0] >= self.scenario.mission_steps:
                self.world.reset()
            self.world.advance(self.orders)

    def decide(self, name: str) -> None:
        """Make one decision of a supervisor for one team, in its current state."""
        seen = Observation(*(field[:1] for field in self.world.observe()))
        _, self.memories[name] = self.supervisors[name].decide(seen, self.memories[name])


class ScaleJob(NamedTuple):
    """One group of measurements, at every team size."""

    part: str  # a key of SCALE_PARTS
    rounds: int


@dataclass(frozen=True)
class ScaleStudy:
    """All figures of ``marlbc scale``. Each job needs the machine to itself, so they must run one after another.

    Raises:
        ConfigurationError: fewer than 5 rounds.
    """

    rounds: int = 7

    def __post_init__(self) -> None:
        check_rounds(self.rounds)

    def jobs(self) -> list[ScaleJob]:
        return [ScaleJob(part, self.rounds) for part in SCALE_PARTS]

    def run(self, job: ScaleJob, watch: Watch) -> dict[str, Any]:
        return SCALE_PARTS[job.part](job.rounds, watch.progress)

    def describe(self, job: ScaleJob) -> tuple[ScaleJob, str]:
        """The job and the processor, since figures are valid for this processor only."""
        return job, cpu()

    def gather(self, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """The figures of all jobs, merged as in the output file."""
        return {**{name: value for result in results for name, value in result.items()}, "rounds": self.rounds}

    def report(self, results: Sequence[dict[str, Any]], out: Path | None, progress: Progress = silent) -> Report:
        figures = self.gather(results)
        if out is not None:
            write_scale(figures, out)
        return Report(to_markdown(scale_table(figures)), figures)


def run_scale(
    rounds: int, out: Path | None, *, overwrite: bool = False, progress: Progress = silent
) -> Conclusion[dict[str, Any]]:
    """Measure all figures; writes scale.md, scale.json and figures/scale.{pdf,png} into ``out``.

    Raises:
        ConfigurationError: fewer than 5 rounds, or ``out`` cannot be written.
    """
    return run_study(ScaleStudy(rounds), out, overwrite=overwrite, progress=progress)


def measure_times(rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Times of mission steps and decisions: medians over ``rounds``; growth is the median of per-round ratios."""
    progress("missions from 4 to 256 agents", 0, 2)
    teams = {agents: SizedTeams(agents) for agents in SIZES}
    taken = interleaved({agents: team.advance for agents, team in teams.items()}, rounds)
    each = {agents: [s / teams[agents].agent_steps for s in seconds] for agents, seconds in taken.items()}
    progress("decisions of supervisors that decide per agent", 1, 2)
    variants: dict[Any, Callable[[], None]] = {
        (name, agents): partial(team.decide, name) for name in SCALED_SUPERVISORS for agents, team in teams.items()
    }
    decisions = interleaved(variants, rounds)
    return {
        "us_per_agent_and_mission_step": {str(n): 1e6 * median(each[n]) for n in SIZES},
        "growth": {str(n): ratio(each[n], each[SIZES[0]]) for n in SIZES},
        "decision_us_per_agent": {
            name: {str(n): 1e6 * median(decisions[name, n]) / n for n in SIZES} for name in SCALED_SUPERVISORS
        },
    }


def measure_memory(rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Memory per world and per agent [KiB]; measured once, ``rounds`` is ignored."""
    progress("memory", 0, 1)
    memory = {agents: _memory(agents) for agents in SIZES}
    return {
        "kib_per_world": {str(n): memory[n] / 1024.0 for n in SIZES},
        "kib_per_agent": {str(n): memory[n] / 1024.0 / n for n in SIZES},
    }


SCALE_PARTS: dict[str, Callable[[int, Progress], dict[str, Any]]] = {"times": measure_times, "memory": measure_memory}
"""The measurements, in the order in which they run."""


_MEMORY = """
import sys
import numpy as np
from marlbc_mj.engine.world import World
from marlbc_mj.studies.scale import mission, resident
agents, worlds = int(sys.argv[1]), int(sys.argv[2])
scenario = mission(agents)
def use(count):
    world = World(scenario, worlds=count)
    world.advance(np.full((count, agents), scenario.orders.index("OA>AA>FM")))
    return world
warm = use(1), use(1)
before = resident()
one = use(1)
middle = resident()
many = use(1 + worlds)
print((resident() - middle - (middle - before)) / worlds)
"""


def _memory(agents: int) -> float:
    """Resident memory added by one more world of this team size, without its plan, measured in a separate process [bytes]."""
    worlds = max(LEAST_WORLDS, MEMORY_AGENTS // agents)
    run = subprocess.run([sys.executable, "-c", _MEMORY, str(agents), str(worlds)], capture_output=True, text=True, check=True)
    return float(run.stdout)


def resident() -> int:
    """Resident memory of this process [bytes]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def scale_table(figures: dict[str, Any]) -> Table:
    """The figures as a table with one row per team size."""
    columns = (
        Column("", "agents"),
        Column("mission step", "µs per agent"),
        Column("mission step", f"of {SIZES[0]} agents'"),
        *(Column("decision", f"{display_name(name)}, µs per agent") for name in SCALED_SUPERVISORS),
        Column("memory", "KiB per world"),
        Column("memory", "KiB per agent"),
    )
    rows = []
    for n in map(str, SIZES):
        decisions = (f"{figures['decision_us_per_agent'][name][n]:.1f}" for name in SCALED_SUPERVISORS)
        cost = (f"{figures['us_per_agent_and_mission_step'][n]:.2f}", f"{figures['growth'][n]:.2f} ×")
        rows.append((n, *cost, *decisions, f"{figures['kib_per_world'][n]:.0f}", f"{figures['kib_per_agent'][n]:.1f}"))
    notes = (
        f"Medians of {figures['rounds']} rounds in which all sizes take turns; the ratio is the median of each round's.",
        f"A grid among {DISCS} disc(s) per agent, everyone under OA>AA>FM, SORLC, 10 substeps a mission step, one thread.",
        "Memory: what one more World copy adds to the resident memory of a process.",
    )
    return Table("scale", "What a mission step costs, by team size", columns, tuple(rows), notes)


def write_scale(figures: dict[str, Any], folder: Path) -> None:
    """Write scale.md, scale.json and figures/scale.{pdf,png}."""
    (folder / "scale.md").write_text(to_markdown(scale_table(figures)), encoding="utf-8")
    write_json(folder / "scale.json", {**figures, **provenance()})
    (folder / "figures").mkdir()
    with pl.style():
        figure = _figure(figures)
        for kind in ("pdf", "png"):
            figure.savefig(folder / "figures" / f"scale.{kind}")


def _figure(figures: dict[str, Any]) -> Any:
    """Plots of the time per agent and the memory of a world over team size."""
    figure, panels = pl.panels(pl.DOUBLE, 2.2, 1, 2, pl.Margins(across=0.75))
    times, memory = panels[0]
    sizes = list(SIZES)
    cost = [figures["us_per_agent_and_mission_step"][str(n)] for n in sizes]
    times.plot(sizes, cost, "o-", color="#0072B2", markersize=3.5)
    times.axhline(1.5 * cost[0], color=pl.GREY, linewidth=0.7, linestyle=(0, (3, 2)))
    times.annotate("1.5 times the cost at 4 agents", (sizes[-1], 1.5 * cost[0]), (0, 3), textcoords="offset points", ha="right")
    times.set(ylim=(0, 1.75 * cost[0]), ylabel="mission step [µs per agent]")
    memory.plot(sizes, [figures["kib_per_world"][str(n)] for n in sizes], "o-", color="#D55E00", markersize=3.5)
    memory.set(ylim=0, xlim=0, ylabel="memory of a world [KiB]", xlabel="agents")  # linear axes: a straight line is linear growth
    times.set_xscale("log", base=2)
    times.set_xticks(sizes, [str(n) for n in sizes])
    times.set_xlabel("agents")
    for axes in (times, memory):
        axes.grid(color="#E4E4E4", linewidth=0.4)
        axes.set_axisbelow(True)
    return figure
