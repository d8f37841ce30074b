"""The state vectors that learners see: the printed one, and an extended one relative to slots and obstacles."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from marlbc_mj import laws
from marlbc_mj.behaviors import nearest_obstacle
from marlbc_mj.engine.state import Observation
from marlbc_mj.errors import unknown
from marlbc_mj.scenarios import Scenario

RANGE = 10.0
"""How far a feature of the extended state reaches [m]; beyond it, it saturates."""

CLOSE = 2.0
"""The finer of the two scales of lengths in the extended state [m]."""

OLD = 5.0
"""A command that has been in force for this long is 1 in the extended state, and so is any older one [s]."""

LENGTHS = 10  # an agent has

SPEED = 5.0
"""A velocity error of this size is 1 in the extended state [m/s]."""


class State(Protocol):
    """Turns observations into state vectors."""

    size: int  # S
    scale: np.ndarray  # (S,) what a network divides the state by
    low: np.ndarray  # (S,)
    high: np.ndarray  # (S,)
    layout: dict[str, float]  # what a policy's weights depend on; ``version`` is raised when numbers change their meaning

    def __call__(self, observation: Observation, obstacles: np.ndarray, age: np.ndarray) -> np.ndarray:
        """(B, S) float32 states from a batch observation, obstacles (B, K, 3) [m] and how long every command has been in force,
        (B, N) [s].
        """
        ...


class PrintedState:
    """s = (X, Pr, G) as printed: positions [m] and velocities [m/s] agent by agent, commands, G. (2n+1)N+1 numbers."""

    def __init__(self, scenario: Scenario) -> None:
        agents = scenario.agents
        self.size = 5 * agents + 1
        self.scale = np.array([50.0, 50.0, 10.0, 10.0] * agents + [len(scenario.orders.commands)] * agents + [2.0])
        self.layout: dict[str, float] = {"version": 1, "size": self.size}
        self.low = np.array([-np.inf] * 4 * agents + [0.0] * (agents + 1))
        self.high = np.array([np.inf] * 4 * agents + [len(scenario.orders.commands) - 1.0] * agents + [2.0])

    def __call__(self, observation: Observation, obstacles: np.ndarray, age: np.ndarray) -> np.ndarray:
        """(B, 5N+1) float32; obstacles (B, K, 3) are not in it (erratum 9), nor is the age of the commands."""
        return observation.state().astype(np.float32)


class ExtendedState:
    """Everything relative and normalised: nothing in it says where on the path, so it carries over to other obstacles.

    Per agent: error to its FM and FR slots about the measured centroid; velocity minus the path's; its command one-hot, and how
    long it has been in force, by ``OLD``; the nearest obstacle (offset of the surface, clearance beyond the safe distance), seen
    from the agent and from its FM slot, occupied or not. Then G one-hot. Lengths appear twice, by ``RANGE`` and by ``CLOSE``,
    clipped to [-1, 1]: a decision looks metres ahead and turns on centimetres.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.commands = len(scenario.orders.commands)
        self.slots = scenario.formations
        self.velocity = np.array(scenario.path_velocity)
        self.safe = np.array([0.0, 0.0, scenario.safe_distance])
        self.size = scenario.agents * (2 * LENGTHS + 3 + self.commands) + 3
        self.layout = {"version": 1, "size": self.size, "range": RANGE, "close": CLOSE, "speed": SPEED, "old": OLD}
        self.scale = np.ones(self.size)
        self.low, self.high = np.full(self.size, -1.0), np.ones(self.size)

    def __call__(self, observation: Observation, obstacles: np.ndarray, age: np.ndarray) -> np.ndarray:
        """(B, N (23 + C) + 3) float32 from a batch observation, obstacles (B, K, 3) [m] and ages (B, N) [s]; C commands."""
        position = observation.position
        worlds = len(position)
        centroid = position.mean(axis=1, keepdims=True)
        slots = centroid[:, None] + self.slots  # (B, 2, N, 2)
        lengths = np.concatenate(
            [
                position - slots[:, 0],
                position - slots[:, 1],
                nearest(position, obstacles) - self.safe,
                nearest(slots[:, 0], obstacles) - self.safe,
            ],
            axis=-1,
        )
        speeds = (observation.velocity - self.velocity) / SPEED
        commands = np.eye(self.commands)[observation.command]
        parts = [lengths / RANGE, lengths / CLOSE, speeds, commands, age[..., None] / OLD]
        agents = np.concatenate(parts, axis=-1).reshape(worlds, -1)
        joint = np.concatenate([agents, np.eye(3)[observation.formation]], axis=-1)
        return np.asarray(np.clip(joint, -1.0, 1.0), dtype=np.float32)


@laws.compiled
def _fill_nearest(points, obstacles, out):  # type: ignore[no-untyped-def]
    for b in range(points.shape[0]):
        for i in range(points.shape[1]):
            normal = out[b, i, :2]
            clearance = min(nearest_obstacle(points[b, i], obstacles[b], normal), RANGE)
            normal *= -clearance
            out[b, i, 2] = clearance


def nearest(points: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
    """(B, N, 3) [m]: offset of the nearest obstacle's surface along x and y, and the clearance, at most ``RANGE``, seen from
    ``points`` (B, N, 2) among ``obstacles`` (B, K, 3). Without obstacles the offset is zero.
    """
    out = np.empty((*points.shape[:2], 3))
    _fill_nearest(np.ascontiguousarray(points), obstacles, out)
    return out


STATES: dict[str, Callable[[Scenario], State]] = {"printed": PrintedState, "extended": ExtendedState}
"""Factory by name."""


def make_state(name: str, scenario: Scenario) -> State:
    """A state by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in STATES:
        raise unknown("state", name, STATES)
    return STATES[name](scenario)
