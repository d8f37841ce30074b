"""How long a whole episode of one world, and writing its log, takes on this machine."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from marlbc_mj.controllers import SORLC
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Frame, run_episode
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.scenarios import Scenario, paper
from marlbc_mj.studies.timing import interleaved
from marlbc_mj.supervisors import Scripted
from marlbc_mj.supervisors.scripted import orders_at
from marlbc_mj.util.progress import Progress, silent


def measure_episode(threads: tuple[int, ...], rounds: int, progress: Progress = silent) -> dict[str, Any]:
    """Seconds for a whole 100 s episode of one world: with a supervisor deciding at every mission step, with all orders known in
    advance, and for writing its log at mission rate. Always on one thread; ``threads`` is ignored.
    """
    progress("one episode, and its log", 0, 1)
    scenario = paper()
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
    memory = supervisor.start(scenario, 1)
    observation = world.reset()
    done = False
    while not done:
        orders, memory = supervisor.decide(observation, memory)
        step = world.step(orders)
        observation, done = step.observation, bool(step.done[0])


def _write(scenario: Scenario, frames: list[Frame], path: Path) -> None:
    with LogWriter(
        path,
        scenario,
        SORLC(),
        names=("scripted", "sorlc"),
        seed=0,
        config={},
        overwrite=True,
    ) as log:
        for frame in frames:
            log.write(frame)


def scripted_orders(scenario: Scenario) -> np.ndarray:
    """(M, N) orders of the scripted supervisor at every mission step."""
    return orders_at(np.arange(scenario.mission_steps) * scenario.mission_step, Scripted().start(scenario, 1))
