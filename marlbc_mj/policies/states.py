"""The state vectors of learners: the published one, and an extended one relative to slots and obstacles."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import unknown

RANGE = 10.0
"""Coarser of the two scales of lengths in the extended state [m]; longer ones saturate."""

CLOSE = 2.0
"""Finer of the two scales of lengths in the extended state [m]."""

OLD = 5.0
"""Age of a command that is 1 in the extended state [s]; greater ages saturate."""

LENGTHS = 10  # lengths per agent
TEAM_ENTRIES = 3  # one-hot G, after the entries of all agents

SPEED = 5.0
"""Velocity error that is 1 in the extended state [m/s]; greater errors saturate."""


class State(Protocol):
    """Turns observations into state vectors."""

    size: int  # S
    scale: np.ndarray  # (S,) divisor that a network applies to the state
    low: np.ndarray  # (S,) least values
    high: np.ndarray  # (S,) greatest values
    layout: dict[str, float]  # data on which weights depend; ``version`` increases when the meaning of entries changes

    def __call__(self, observation: Observation) -> np.ndarray:
        """(B, S) float32 states of B teams."""
        ...


class PublishedState:
    """s = (X, Pr, G) as published: positions [m] and velocities [m/s] per agent, commands, G; (2n+1)N+1 numbers."""

    def __init__(self, scenario: Scenario) -> None:
        agents = scenario.agents
        self.size = 5 * agents + 1
        self.scale = np.array([50.0, 50.0, 10.0, 10.0] * agents + [len(scenario.orders.commands)] * agents + [2.0])
        self.layout: dict[str, float] = {"version": 1, "size": self.size}
        self.low = np.array([-np.inf] * 4 * agents + [0.0] * (agents + 1))
        self.high = np.array([np.inf] * 4 * agents + [len(scenario.orders.commands) - 1.0] * agents + [2.0])

    def __call__(self, observation: Observation) -> np.ndarray:
        """(B, 5N+1) float32; it contains neither obstacles (erratum 9) nor the age of the commands."""
        return observation.state().astype(np.float32)


class ExtendedState:
    """Relative, normalised state. It does not depend on the place along the path, so it transfers to other obstacles.

    Per agent: error to its FM and FR slots around the measured centroid; velocity minus that of the path; one-hot command and its
    age, divided by ``OLD``; the nearest obstacle (offset of the surface, clearance beyond the safe distance), seen from the
    agent and from its FM slot. Then one-hot G. Each length appears twice, divided by ``RANGE`` and by ``CLOSE``, clipped to
    [-1, 1]: decisions look metres ahead but depend on centimetres.
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
        """(B, N (23 + C) + 3) float32 with C commands; the age of an initial command is 1.

        Raises:
            IndexError: a command that the scenario does not have.
        """
        out = np.zeros((len(observation.position), self.size), dtype=np.float32)
        _fill(observation, self.slots, self.velocity, self.safe, out)
        return out


@laws.compiled
def nearest_surface(point, obstacles, out):
    """Write to ``out`` (3,) [m] the offset from ``point`` (2,) to the nearest surface of ``obstacles`` (K, 3) along x and y, and
    the clearance, at most ``RANGE``. Without obstacles the offset is zero.
    """
    out[2] = min(nearest_obstacle(point, obstacles, out[:2]), RANGE)
    out[:2] *= -out[2]


@laws.compiled
def _fill(observation, slots, path, safe, out):
    """Write the extended state of every team to ``out`` (B, S), which must be zero before.

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
"""Factory of each state, by name."""


def make_state(name: str, scenario: Scenario) -> State:
    """Make a state by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in STATES:
        raise unknown("state", name, STATES)
    return STATES[name](scenario)
