"""For tests of shields: steers every agent at an obstacle or at another agent."""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.cells import spacing
from marlbc_mj.engine.world import World


class Closest(NamedTuple):
    """Extreme values over all substeps [m]."""

    clearance: float  # smallest
    distance: float  # smallest, between two agents
    off: float  # largest distance of an agent from its reference


def attack(world: World, steps: int, seed: int = 0, *, speed: float, change: int, forget: bool = False) -> Closest:
    """Steer every agent at a random obstacle or agent at ``speed``, and return the closest approaches.

    Args:
        world: a World with a single world, made with ``record=True``.
        steps: number of mission steps.
        seed: random seed of the targets.
        speed: magnitude of the reference velocities [m/s].
        change: number of mission steps after which every agent gets a new target.
        forget: whether to set the references to the agents' positions at every mission step, so that they do not run ahead.
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
