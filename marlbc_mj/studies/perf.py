"""Speed of the benchmark on this machine. One job measures a group of variants in turn, so that their ratios are fair."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, NamedTuple

import numba
import numpy as np

from marlbc_mj.controllers import PD, SORLC, Controller
from marlbc_mj.core import laws
from marlbc_mj.core.disturbances import ConstantWind, Disturbance, PaperDrag
from marlbc_mj.core.laws import compiled, plain, threaded
from marlbc_mj.engine.native import call_step, step_address
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario, paper
from marlbc_mj.studies.perf_episode import measure_episode, scripted_orders
from marlbc_mj.studies.perf_training import measure_training, training_lines
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import run_jobs
from marlbc_mj.studies.timing import check_rounds, interleaved, ratio
from marlbc_mj.supervisors import Supervisor, carry_out, make_supervisor
from marlbc_mj.util.files import write_json
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.provenance import provenance

BARE = "bare mj_step"
BATCH = 64  # worlds of the physics comparison
BATCHES = (1, 64, 1024)  # numbers of worlds for the mission-step figures
SUPERVISED = ("fsams", "fms", "marlms")
"""Supervisors that decide for many worlds in one call."""
SUPERVISED_WORLDS = 1024
SUPERVISED_STEPS = 10  # mission steps in one measurement: one decision interval of marlms
BURST = 12_800  # physics steps in one measurement of a variant
PYTHON_STEPS = 20  # mission steps in one measurement of the Python loops


@laws.controller(gains="limit")
def _no_law(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """u = 0."""
    for axis in range(2):
        force_out[axis] = 0.0


@dataclass(frozen=True)
class _Idle:
    """A controller that does nothing, to measure the cost of the loop around a law."""

    limited: bool = True
    linear_gains: tuple[float, float] | None = None
    law = staticmethod(_no_law)

    def params(self, agent: int, limit: float) -> laws.Numbers:
        return {"limit": limit}

    def initial_state(self, agent: int) -> laws.Numbers:
        return {}


LOOP_PARTS: dict[str, tuple[Controller, Disturbance]] = {
    "references, composition, scores": (_Idle(), ConstantWind(force=(0.0, 0.0))),
    "the drag (43)": (_Idle(), PaperDrag()),
    "saturated PD": (PD(), PaperDrag()),
    "SORLC's compensator": (SORLC(basis="off"), PaperDrag()),
    "SORLC's networks, inputs in range": (SORLC(basis="scaled"), PaperDrag()),
}
"""Closed loops by the part that each adds to the one before it."""


class _PlainSORLC(SORLC):
    """SORLC run by the Python interpreter, to measure the law without compilation."""

    law = staticmethod(plain(SORLC.law))


@compiled
def _bare_serial(step, model, data, substeps):
    """A mission step of bare physics: all substeps of one world, then of the next, as in the closed loop."""
    for b in range(data.shape[0]):
        for _ in range(substeps):
            call_step(step, model, data[b])


@threaded
def _bare_parallel(step, model, data, substeps):
    for b in numba.prange(data.shape[0]):
        for _ in range(substeps):
            call_step(step, model, data[b])


class Fleet:
    """Worlds at stages spread evenly over the mission, so that one burst of steps samples all of it."""

    def __init__(
        self,
        scenario: Scenario,
        worlds: int,
        threads: int,
        orders: np.ndarray,
        *,
        native: bool | None = None,
        controller: Controller | None = None,
    ) -> None:
        self.world = World(scenario, controller, worlds=worlds, threads=threads, native=native)
        self.orders = orders
        if worlds > 1:
            self._spread(World(scenario, controller, worlds=min(worlds, BATCH)), scenario.mission_steps)

    def _spread(self, source: World, steps: int) -> None:
        """Run all source worlds, resetting them one by one so that their stages differ, and copy them to this fleet's worlds."""
        stages = source.worlds
        copies = self.world.worlds // stages
        for stage in range(stages):
            source.reset(mask=np.arange(stages) == stage)
            for _ in range(max(1, steps // (stages + 1))):
                source.step(self.orders[source.state.steps])
        for b in range(self.world.worlds):
            self.world.copy_world(source, b // copies, b)

    def advance(self, steps: int) -> None:
        """Call ``World.step`` ``steps`` times; a finished world starts again."""
        for _ in range(steps):
            self.world.step(self._next_orders())

    def advance_compiled(self, steps: int) -> None:
        """Like :meth:`advance`, but through the compiled call alone."""
        for _ in range(steps):
            self.world.advance(self._next_orders())

    def _next_orders(self) -> np.ndarray:
        self._restart_finished()
        return np.asarray(self.orders[self.world.state.steps])

    def _restart_finished(self) -> None:
        finished = self.world.state.steps >= len(self.orders)
        if finished.any():
            self.world.reset(mask=finished)


class SupervisedFleet(Fleet):
    """A fleet whose supervisor observes and decides for all worlds before every mission step."""

    def __init__(self, scenario: Scenario, worlds: int, threads: int, orders: np.ndarray, supervisor: Supervisor) -> None:
        super().__init__(scenario, worlds, threads, orders)
        self.supervisor, self.memory = supervisor, supervisor.start(scenario, worlds)

    def advance(self, steps: int) -> None:
        """Make ``steps`` decisions, each followed by ``World.step``; a finished world starts again."""
        for _ in range(steps):
            self._restart_finished()
            decision, self.memory = self.supervisor.decide(self.world.observe(), self.memory)
            carry_out(self.world, decision)


def _bare(fleet: Fleet, threads: int) -> Callable[[], None]:
    world = fleet.world
    run = _bare_serial if threads == 1 else _bare_parallel
    step, model = np.uint64(step_address()), np.uint64(world.plan.model._address)
    copies = World(world.scenario, worlds=world.worlds)
    data = copies.side.data
    substeps = world.scenario.substeps
    missions = BURST // (world.worlds * substeps)

    def burst(_keep: World = copies) -> None:
        numba.set_num_threads(threads)
        for _ in range(missions):
            run(step, model, data, substeps)

    return burst


class PerfJob(NamedTuple):
    """One group of variants."""

    part: str  # a key of PERF_PARTS
    rounds: int


@dataclass(frozen=True)
class PerfStudy:
    """All figures of ``marlbc perf``. Each job needs the machine to itself, so they must run one after another.

    Raises:
        ConfigurationError: fewer than 5 rounds.
    """

    rounds: int = 9

    def __post_init__(self) -> None:
        check_rounds(self.rounds)

    def jobs(self) -> list[PerfJob]:
        return [PerfJob(part, self.rounds) for part in PERF_PARTS]

    def run(self, job: PerfJob, watch: Watch) -> dict[str, Any]:
        return PERF_PARTS[job.part](threads_measured(), job.rounds, watch.progress)

    def gather(self, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """The figures of all jobs, merged as in the output file."""
        figures = {name: value for result in results for name, value in result.items() if name != "ratios"}
        ratios = {name: value for result in results for name, value in result.get("ratios", {}).items()}
        return {**figures, "ratios": ratios, "rounds": self.rounds}

    def report(self, results: Sequence[dict[str, Any]], out: Path | None, progress: Progress = silent) -> Report:
        """The figures as lines of text; ``out`` is a JSON file here, not a folder."""
        figures = self.gather(results)
        if out is not None:
            write_json(out, {**figures, **provenance()})
        return Report("\n".join(perf_lines(figures)))


def measure_perf(rounds: int = 9, progress: Progress = silent) -> dict[str, Any]:
    """Measure all figures of ``marlbc perf``: medians over ``rounds``; ratios are medians of per-round ratios.

    Raises:
        ConfigurationError: fewer than 5 rounds.
    """
    study = PerfStudy(rounds)
    return study.gather(run_jobs(study, progress=progress))


def threads_measured() -> tuple[int, ...]:
    """Numbers of threads to measure: one, and two where the machine has them."""
    return (1, 2) if numba.config.NUMBA_NUM_THREADS >= 2 else (1,)


def measure_physics(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Physics steps per second: bare MuJoCo and the closed loop by number of threads, and the Python loop."""
    progress("physics steps: bare, closed loop, Python loop", 0, 1)
    scenario = paper()
    orders = scripted_orders(scenario)
    variants: dict[Any, Callable[[], None]] = {}
    substeps = scenario.substeps
    for n in threads:
        fleet = Fleet(scenario, BATCH, n, orders)
        variants["bare", n] = _bare(fleet, n)
        steps = BURST // (BATCH * substeps)
        variants["closed", n] = partial(fleet.advance_compiled, steps)
    python = {
        "python": Fleet(scenario, 1, 1, orders, controller=_PlainSORLC()),
        "python, compiled laws": Fleet(scenario, 1, 1, orders, native=False),
    }
    for name, fleet in python.items():
        variants[name] = partial(fleet.advance, PYTHON_STEPS)
    taken = interleaved(variants, rounds)
    each = {
        name: [s / (PYTHON_STEPS * substeps if name in python else BURST) for s in seconds] for name, seconds in taken.items()
    }
    rate = {name: 1.0 / median(seconds) for name, seconds in each.items()}
    physics = {
        "bare_mj_step": {str(n): rate["bare", n] for n in threads},
        "closed_loop": {str(n): rate["closed", n] for n in threads},
        "python_loop": rate["python"],
        "python_loop_compiled_laws": rate["python, compiled laws"],
    }
    ratios = {f"closed_over_bare_{n}": ratio(each["bare", n], each["closed", n]) for n in threads}
    ratios["closed_over_python"] = ratio(each["python"], each["closed", 1])
    ratios["closed_over_python_compiled_laws"] = ratio(each["python, compiled laws"], each["closed", 1])
    if len(threads) > 1:
        ratios["second_thread"] = ratio(taken["closed", 1], taken["closed", 2])
        ratios["second_thread_bare"] = ratio(taken["bare", 1], taken["bare", 2])
    return {"physics_steps_per_s": physics, "ratios": ratios}


def measure_loop(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Processor time of one physics step of a team on one thread: of bare MuJoCo, and added by each part of LOOP_PARTS."""
    progress("where the time of the closed loop goes", 0, 1)
    orders, steps = scripted_orders(paper()), BURST // (BATCH * paper().substeps)
    fleets = {
        name: Fleet(replace(paper(), disturbance=disturbance), BATCH, 1, orders, controller=controller)
        for name, (controller, disturbance) in LOOP_PARTS.items()
    }
    variants: dict[Any, Callable[[], None]] = {BARE: _bare(next(iter(fleets.values())), 1)}
    variants |= {name: partial(fleet.advance_compiled, steps) for name, fleet in fleets.items()}
    taken = interleaved(variants, rounds, process_time)
    more = {
        after: median(1e6 * (b - a) / BURST for a, b in zip(taken[before], taken[after], strict=True))
        for before, after in pairwise(taken)
    }
    return {"loop_parts_us": {BARE: 1e6 * median(taken[BARE]) / BURST, **more}}


def measure_missions(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Mission steps per second by batch size and number of threads."""
    progress("mission steps by batch size", 0, 1)
    scenario = paper()
    orders = scripted_orders(scenario)
    fleets = {(b, n): Fleet(scenario, b, n, orders) for b in BATCHES for n in threads}
    steps = {b: max(1, 2000 // b) for b in BATCHES}
    variants: dict[Any, Callable[[], None]] = {key: partial(fleet.advance, steps[key[0]]) for key, fleet in fleets.items()}
    taken = interleaved(variants, rounds)
    rates = {str(b): {str(n): b * steps[b] / median(taken[b, n]) for n in threads} for b in BATCHES}
    return {"mission_steps_per_s": rates}


def measure_supervised(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Mission steps per second of many worlds on one thread, with a supervisor that observes and decides before each step."""
    progress("mission steps with a supervisor", 0, 1)
    scenario = paper()
    orders = scripted_orders(scenario)
    fleets = {"alone": Fleet(scenario, SUPERVISED_WORLDS, 1, orders)}
    fleets |= {name: SupervisedFleet(scenario, SUPERVISED_WORLDS, 1, orders, make_supervisor(name)) for name in SUPERVISED}
    variants: dict[Any, Callable[[], None]] = {name: partial(fleet.advance, SUPERVISED_STEPS) for name, fleet in fleets.items()}
    taken = interleaved(variants, rounds, process_time)
    done = SUPERVISED_WORLDS * SUPERVISED_STEPS
    return {
        "supervised_steps_per_s": {name: done / median(seconds) for name, seconds in taken.items()},
        "ratios": {f"{name}_over_step_alone": ratio(taken["alone"], taken[name]) for name in SUPERVISED},
    }


PERF_PARTS: dict[str, Callable[[tuple[int, ...], int, Progress], dict[str, Any]]] = {
    "physics": measure_physics,
    "loop": measure_loop,
    "missions": measure_missions,
    "supervised": measure_supervised,
    "episode": measure_episode,
    "training": measure_training,
}
"""The measurements, in the order in which they run."""


def perf_lines(figures: dict[str, Any]) -> list[str]:
    """The figures as text, one line each."""
    physics, ratios = figures["physics_steps_per_s"], figures["ratios"]
    lines = [
        f"{name}, {threads} thread(s): {rate:,.0f} physics steps/s"
        for name in ("bare_mj_step", "closed_loop")
        for threads, rate in physics[name].items()
    ]
    lines += [f"{name}: {physics[name]:,.0f} physics steps/s" for name in ("python_loop", "python_loop_compiled_laws")]
    lines += [f"of a physics step, {name}: {spent:.2f} us" for name, spent in figures["loop_parts_us"].items()]
    lines += [
        f"World.step, B = {batch}, {threads} thread(s): {rate:,.0f} mission steps/s"
        for batch, rates in figures["mission_steps_per_s"].items()
        for threads, rate in rates.items()
    ]
    lines += [
        f"World.step, B = {SUPERVISED_WORLDS}, 1 thread, {name}: {rate:,.0f} mission steps/s"
        for name, rate in figures["supervised_steps_per_s"].items()
    ]
    lines += [f"{name}: {ratio:.3f}" for name, ratio in ratios.items()]
    lines.append(f"100 s episode, B = 1, supervisor at every mission step: {figures['episode_s']:.3f} s")
    lines.append(f"the same with its orders known beforehand (World.rollout): {figures['rollout_s']:.3f} s")
    return [*lines, f"its log: {figures['record_s']:.3f} s", *training_lines(figures)]
