"""How fast the benchmark is on this machine: every variant in turn within one process, so that ratios hold on a noisy one."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numba
import numpy as np

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.core.laws import compiled, plain, threaded
from marlbc_mj.engine.native import call_step, step_address
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Frame, run_episode
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.scenarios import Scenario, paper
from marlbc_mj.supervisors import Scripted, situation
from marlbc_mj.util.errors import ConfigurationError

BATCH = 64  # worlds of the physics comparison
BATCHES = (1, 64, 1024)  # worlds of the mission-step figures
BURST = 12_800  # physics steps in one measurement of a variant
PYTHON_STEPS = 20  # mission steps in one measurement of the Python loops


class _PlainSORLC(SORLC):
    """SORLC as the Python interpreter runs it: what the law costs without compilation."""

    law = staticmethod(plain(SORLC.law))


@compiled
def _bare_serial(step, model, data, substeps):
    """A mission step of bare physics: every world its substeps, one world after the other, as the closed loop does."""
    for b in range(data.shape[0]):
        for _ in range(substeps):
            call_step(step, model, data[b])


@threaded
def _bare_parallel(step, model, data, substeps):
    for b in numba.prange(data.shape[0]):
        for _ in range(substeps):
            call_step(step, model, data[b])


def scripted_orders(scenario: Scenario) -> np.ndarray:
    """(M, N) orders of the scripted supervisor at every mission step."""
    supervisor = Scripted()
    memory = supervisor.start(scenario)
    world = World(scenario)
    start = situation(world.observe(), world.state.obstacles[0], scenario.mission_step)
    times = np.arange(scenario.mission_steps) * scenario.mission_step
    return np.array([supervisor.decide(start._replace(time=float(t)), memory)[0] for t in times])


class Fleet:
    """Worlds spread evenly over the mission, so that one burst of steps samples all of it."""

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
        """Reset one world after the other while all of them run; more worlds than that are copies of these."""
        stages = source.worlds
        copies = self.world.worlds // stages
        for stage in range(stages):
            source.reset(mask=np.arange(stages) == stage)
            for _ in range(max(1, steps // (stages + 1))):
                source.step(self.orders[source.state.steps])
        for b in range(self.world.worlds):
            self.world.copy_world(source, b // copies, b)

    def advance(self, steps: int) -> None:
        """``steps`` calls of ``World.step``; a finished world starts again."""
        for _ in range(steps):
            self.world.step(self._next_orders())

    def advance_compiled(self, steps: int) -> None:
        """The same through the compiled call alone."""
        for _ in range(steps):
            self.world.advance(self._next_orders())

    def _next_orders(self) -> np.ndarray:
        state = self.world.state
        finished = state.steps >= len(self.orders)
        if finished.any():
            self.world.reset(mask=finished)
        return self.orders[state.steps]


def _bare(fleet: Fleet, threads: int) -> Callable[[], None]:
    world = fleet.world
    run = _bare_serial if threads == 1 else _bare_parallel
    step, model = np.uint64(step_address()), np.uint64(world.plan.model._address)
    copies = World(world.scenario, worlds=world.worlds)
    data = np.ascontiguousarray(copies._addresses[:, 0])
    substeps = world.scenario.substeps
    missions = BURST // (world.worlds * substeps)

    def burst(_keep: World = copies) -> None:
        numba.set_num_threads(threads)
        for _ in range(missions):
            run(step, model, data, substeps)

    return burst


def _seconds(action: Callable[[], Any]) -> float:
    start = perf_counter()
    action()
    return perf_counter() - start


def interleaved(variants: dict[Any, Callable[[], None]], rounds: int) -> dict[Any, list[float]]:
    """Seconds of each variant in every round, variants in turn; one round before does not count."""
    taken: dict[Any, list[float]] = {name: [] for name in variants}
    for round_ in range(rounds + 1):
        for name, action in variants.items():
            seconds = _seconds(action)
            if round_:
                taken[name].append(seconds)
    return taken


def measure_perf(rounds: int = 9, progress: Callable[[str], None] | None = None) -> dict[str, Any]:
    """All figures of ``marlbc perf``: medians over ``rounds``, and the ratios as medians of per-round ratios.

    Raises:
        ConfigurationError: fewer than 5 rounds.
    """
    from marlbc_mj.studies.perf_training import measure_training  # it takes its rounds from here

    if rounds < 5:
        raise ConfigurationError(f"rounds must be at least 5 for a median to mean something, got {rounds}")
    say = progress or (lambda message: None)
    scenario = paper()
    orders = scripted_orders(scenario)
    threads = (1, 2) if numba.config.NUMBA_NUM_THREADS >= 2 else (1,)
    say("physics steps: bare, closed loop, Python loop")
    physics, ratios = _measure_physics(scenario, orders, threads, rounds)
    say("mission steps by batch size")
    missions = _measure_missions(scenario, orders, threads, rounds)
    say("one episode, and its log")
    episode = _measure_episode(scenario, rounds)
    learning, more_ratios = measure_training(threads, rounds, say)
    return {
        "physics_steps_per_s": physics,
        "mission_steps_per_s": missions,
        **episode,
        **learning,
        "ratios": {**ratios, **more_ratios},
        "rounds": rounds,
    }


def _measure_physics(
    scenario: Scenario, orders: np.ndarray, threads: tuple[int, ...], rounds: int
) -> tuple[dict[str, Any], dict[str, float]]:
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
    return physics, ratios


def ratio(above: list[float], below: list[float]) -> float:
    """Median of the ratios in each round."""
    return median(a / b for a, b in zip(above, below, strict=True))


def _measure_missions(
    scenario: Scenario, orders: np.ndarray, threads: tuple[int, ...], rounds: int
) -> dict[str, dict[str, float]]:
    fleets = {(b, n): Fleet(scenario, b, n, orders) for b in BATCHES for n in threads}
    steps = {b: max(1, 2000 // b) for b in BATCHES}
    variants: dict[Any, Callable[[], None]] = {key: partial(fleet.advance, steps[key[0]]) for key, fleet in fleets.items()}
    taken = interleaved(variants, rounds)
    return {str(b): {str(n): b * steps[b] / median(taken[b, n]) for n in threads} for b in BATCHES}


def _measure_episode(scenario: Scenario, rounds: int) -> dict[str, float]:
    """Seconds for a whole 100 s episode of one world: its supervisor deciding at every mission step, all orders known
    beforehand, and writing its log at mission rate.
    """
    world = World(scenario)
    schedule = np.ascontiguousarray(scripted_orders(scenario)[:, None])
    frames: list[Frame] = []
    run_episode(World(scenario, record=True), Scripted(), on_frame=frames.append)
    with tempfile.TemporaryDirectory() as folder:
        variants: dict[Any, Callable[[], None]] = {
            "episode": lambda: _episode(world),
            "rollout": lambda: _rollout(world, schedule),
            "record": lambda: _write(scenario, frames, Path(folder) / "perf.mcap"),
        }
        taken = interleaved(variants, rounds)
    return {f"{name}_s": median(seconds) for name, seconds in taken.items()}


def _rollout(world: World, schedule: np.ndarray) -> None:
    world.reset()
    world.rollout(schedule)


def _episode(world: World) -> None:
    scenario, supervisor = world.scenario, Scripted()
    memory = supervisor.start(scenario)
    observation = world.reset()
    done = False
    while not done:
        orders, memory = supervisor.decide(situation(observation, world.state.obstacles[0], scenario.mission_step), memory)
        step = world.step(orders[None])
        observation, done = step.observation, bool(step.done[0])


def _write(scenario: Scenario, frames: list[Frame], path: Path) -> None:
    with LogWriter(
        path,
        scenario,
        SORLC(),
        supervisor="scripted",
        controller_name="sorlc",
        seed=0,
        config={},
        overwrite=True,
    ) as log:
        for frame in frames:
            log.write(frame)


def perf_lines(figures: dict[str, Any]) -> list[str]:
    """The figures as text, one line each."""
    from marlbc_mj.studies.perf_training import training_lines

    physics, ratios = figures["physics_steps_per_s"], figures["ratios"]
    lines = [
        f"{name}, {threads} thread(s): {rate:,.0f} physics steps/s"
        for name in ("bare_mj_step", "closed_loop")
        for threads, rate in physics[name].items()
    ]
    lines += [f"{name}: {physics[name]:,.0f} physics steps/s" for name in ("python_loop", "python_loop_compiled_laws")]
    lines += [
        f"World.step, B = {batch}, {threads} thread(s): {rate:,.0f} mission steps/s"
        for batch, rates in figures["mission_steps_per_s"].items()
        for threads, rate in rates.items()
    ]
    lines += [f"{name}: {ratio:.3f}" for name, ratio in ratios.items()]
    lines.append(f"100 s episode, B = 1, supervisor at every mission step: {figures['episode_s']:.3f} s")
    lines.append(f"the same with its orders known beforehand (World.rollout): {figures['rollout_s']:.3f} s")
    return [*lines, f"its log: {figures['record_s']:.3f} s", *training_lines(figures)]
