"""The state vectors that learners see: the published one, and an extended one relative to slots and obstacles."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import unknown

RANGE = 10.0
"""How far a feature of the extended state reaches [m]; beyond it, it saturates."""

CLOSE = 2.0
"""The finer of the two scales of lengths in the extended state [m]."""

OLD = 5.0
"""A command that has been in force for this long is 1 in the extended state, and so is any older one [s]."""

LENGTHS = 10  # an agent has
TEAM_ENTRIES = 3  # G one-hot, behind all agents'

SPEED = 5.0
"""A velocity error of this size is 1 in the extended state [m/s]."""


class State(Protocol):
    """Turns observations into state vectors."""

    size: int  # S
    scale: np.ndarray  # (S,) what a network divides the state by
    low: np.ndarray  # (S,)
    high: np.ndarray  # (S,)
    layout: dict[str, float]  # what a policy's weights depend on; ``version`` is raised when numbers change their meaning

    def __call__(self, observation: Observation) -> np.ndarray:
        """(B, S) float32 states of B teams."""
        ...


class PublishedState:
    """s = (X, Pr, G) as published: positions [m] and velocities [m/s] agent by agent, commands, G. (2n+1)N+1 numbers."""

    def __init__(self, scenario: Scenario) -> None:
        agents = scenario.agents
        self.size = 5 * agents + 1
        self.scale = np.array([50.0, 50.0, 10.0, 10.0] * agents + [len(scenario.orders.commands)] * agents + [2.0])
        self.layout: dict[str, float] = {"version": 1, "size": self.size}
        self.low = np.array([-np.inf] * 4 * agents + [0.0] * (agents + 1))
        self.high = np.array([np.inf] * 4 * agents + [len(scenario.orders.commands) - 1.0] * agents + [2.0])

    def __call__(self, observation: Observation) -> np.ndarray:
        """(B, 5N+1) float32; obstacles are not in it (erratum 9), nor is the age of the commands."""
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
        self.safe = scenario.safe_distance
        self.size = scenario.agents * (2 * LENGTHS + 3 + self.commands) + TEAM_ENTRIES
        self.layout = {"version": 1, "size": self.size, "range": RANGE, "close": CLOSE, "speed": SPEED, "old": OLD}
        self.scale = np.ones(self.size)
        self.low, self.high = np.full(self.size, -1.0), np.ones(self.size)

    def __call__(self, observation: Observation) -> np.ndarray:
        """(B, N (23 + C) + 3) float32 with C commands; a command that an episode began with is old.

        Raises:
            IndexError: a command that is none of the scenario's.
        """
        out = np.zeros((len(observation.position), self.size), dtype=np.float32)
        _fill(observation, self.slots, self.velocity, self.safe, out)
        return out


@laws.compiled
def nearest_surface(point, obstacles, out):
    """Write into ``out`` (3,) [m]: offset of the nearest obstacle's surface along x and y, and the clearance, at most ``RANGE``,
    seen from ``point`` (2,) among ``obstacles`` (K, 3). Without obstacles the offset is zero.
    """
    out[2] = min(nearest_obstacle(point, obstacles, out[:2]), RANGE)
    out[:2] *= -out[2]


@laws.compiled
def _fill(observation, slots, path, safe, out):
    """The extended state of every team into ``out`` (B, S), which is 0.

    ``slots`` (2, N, 2) [m], ``path`` (2,) the desired centroid's velocity [m/s], ``safe`` d_OA [m].
    """
    position, velocity, obstacles = observation.position, observation.velocity, observation.obstacles
    command, age = observation.command, observation.age
    agents = position.shape[1]
    width = (out.shape[1] - TEAM_ENTRIES) // agents
    centroid, slot, lengths = np.empty(2), np.empty(2), np.empty(LENGTHS)
    for b in range(position.shape[0]):
        for c in range(2):
            centroid[c] = position[b, :, c].sum() / agents
        for i in range(agents):
            for c in range(2):
                slot[c] = centroid[c] + slots[0, i, c]
                lengths[c] = position[b, i, c] - slot[c]
                lengths[2 + c] = position[b, i, c] - (centroid[c] + slots[1, i, c])
            nearest_surface(position[b, i], obstacles[b], lengths[4:7])
            nearest_surface(slot, obstacles[b], lengths[7:])
            lengths[6] -= safe
            lengths[9] -= safe
            own = out[b, i * width : (i + 1) * width]
            for k in range(LENGTHS):
                own[k] = laws.clip(lengths[k] / RANGE, 1.0)
                own[LENGTHS + k] = laws.clip(lengths[k] / CLOSE, 1.0)
            for c in range(2):
                own[2 * LENGTHS + c] = laws.clip((velocity[b, i, c] - path[c]) / SPEED, 1.0)
            if not 0 <= command[b, i] < width - 2 * LENGTHS - 3:
                raise IndexError("a command is none of the scenario's")
            own[2 * LENGTHS + 2 + command[b, i]] = 1.0
            own[width - 1] = laws.clip(age[b, i] / OLD, 1.0)
        out[b, agents * width + observation.formation[b]] = 1.0


STATES: dict[str, Callable[[Scenario], State]] = {"published": PublishedState, "extended": ExtendedState}
"""Factory by name."""


def make_state(name: str, scenario: Scenario) -> State:
    """A state by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in STATES:
        raise unknown("state", name, STATES)
    return STATES[name](scenario)
