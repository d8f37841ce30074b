"""For tests of shields: a supervisor that sends every agent against something."""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.cells import spacing
from marlbc_mj.engine.world import World


class Closest(NamedTuple):
    """The worst at any substep [m]."""

    clearance: float
    distance: float  # between two agents
    off: float  # of an agent from its reference


def attack(world: World, steps: int, seed: int = 0, *, speed: float, change: int, forget: bool = False) -> Closest:
    """Send every agent against an obstacle or another agent, one of its own, at ``speed`` [m/s].

    Args:
        world: one world, made with ``record=True``.
        steps: mission steps.
        seed: of the choices.
        speed: of the reference velocities [m/s].
        change: mission steps after which everybody gets another target.
        forget: whether references start where agents are, without a memory of where they could not go.
    """
    rng, agents = np.random.default_rng(seed), world.scenario.agents
    clearance, distance, off = np.inf, np.inf, 0.0
    obstacles = world.state.obstacles[0]
    for step in range(steps):
        p = world.state.position[0]
        if step % change == 0:
            targets = rng.integers(0, len(obstacles) + agents, agents)
        ends = np.concatenate([obstacles[:, :2], p[rng.permutation(agents)]])
        way = ends[targets] - p
        if forget:
            world.state.reference[0] = p
        velocity = speed * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        record = world.step(np.zeros((1, agents), dtype=np.int64), velocity[None]).record
        at = np.concatenate([record.position[0], world.state.position])
        gaps = np.linalg.norm(at[:, :, None] - obstacles[:, :2], axis=-1) - obstacles[:, 2]
        clearance, distance = min(clearance, gaps.min()), min(distance, spacing(at).min())
        off = max(off, float(np.linalg.norm(record.position - record.reference, axis=-1).max()))
    return Closest(clearance, distance, off)
