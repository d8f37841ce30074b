"""Where training episodes begin: at the start of the mission, or as exploring starts anywhere along the route."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import clearances
from marlbc_mj.core.motion import obstacles_at
from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.core.safety import violates
from marlbc_mj.scenarios.base import Scenario, desired_centroid
from marlbc_mj.scenarios.layout import motion_array
from marlbc_mj.util.errors import ConfigurationError

PLACES_TRIED = 20
"""Number of places along the route to try for an exploring start."""


@dataclass(frozen=True)
class Starts:
    """Where episodes begin: the share ``exploring`` anywhere along the route, in formation or in column, moving with the slots.

    An episode from an exploring start lasts ``length`` and is then truncated, not terminal. Where a slot of the first formation
    is within the safe distance of an obstacle, the team starts in column; where a column slot is, too, it starts elsewhere.
    Orders have to change where a slot becomes blocked or free. Elsewhere there is little to learn, so ``focus`` puts starts
    shortly before such places.
    """

    exploring: float = 0.0  # share of episodes in [0, 1]
    length: float = 20.0  # [s]
    focus: float = 0.0  # share of exploring starts shortly before a slot of the first formation becomes blocked or free
    lead: float = 8.0  # longest time before that change [s]
    turning: float = 0.0  # share of exploring starts in which the whole team should first take one of the formations

    def __post_init__(self) -> None:
        for name in ("exploring", "focus", "turning"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} must be a share of starts between 0 and 1, got {getattr(self, name)}")
        if not self.lead >= 0:
            raise ConfigurationError(f"the lead of a focused start must not be negative, got {self.lead} s")
        if not self.length > 0:
            raise ConfigurationError(f"the length of an exploring start must be positive, got {self.length} s")


class Start(NamedTuple):
    """An exploring start of one team."""

    step: int  # number of mission steps that count as made
    position: np.ndarray  # (N, 2) [m]
    command: np.ndarray  # (N,) commands that count as the last ones
    turn: int  # command with which the whole team should begin; -1: none


class Route:
    """Draws the exploring starts of one scenario.

    Args:
        scenario: the problem instance.
        starts: shares of the different kinds of starts.
        interval: mission steps per decision; starts coincide with decisions.
        commands: the commands in the action set.
    """

    def __init__(self, scenario: Scenario, starts: Starts, interval: int, commands: Iterable[int]) -> None:
        self.scenario = scenario
        self.starts = starts
        self.interval = interval
        self.decisions = scenario.mission_steps // interval  # in a whole mission
        parts = [name.split(SEPARATOR) for name in scenario.orders.commands]
        known = sorted(commands, key=lambda c: len(parts[c]))
        self.keeping = [
            [c for c in known if parts[c][-1] == kept] or known for kept in scenario.formation_names
        ]  # per formation, the set's commands that an exploring start in it can have, the shortest first
        self.critical = self._critical()

    def draw(self, rng: np.random.Generator, anchors: np.ndarray, motions: np.ndarray) -> Start | None:
        """Draw a start with the slots of a formation clear of obstacles; None if none is found.

        ``anchors`` (K, 3) [m] and ``motions`` (K, 6) describe the episode's obstacles; with (0, 6) all are at rest.
        """
        for _ in range(PLACES_TRIED):
            step = self._decision(rng) * self.interval
            for which in ((0, 1), (1,))[int(rng.integers(2))]:
                position = self._centre(step) + self.scenario.formations[which]
                if not self._blocked(position, obstacles_at(step * self.scenario.mission_step, anchors, motions)).any():
                    command = rng.choice(self.keeping[which], size=self.scenario.agents)
                    turns = happens(self.starts.turning, rng)
                    return Start(step, position, command, self.keeping[int(rng.integers(2))][0] if turns else -1)
        return None

    def _decision(self, rng: np.random.Generator) -> int:
        """Draw the index of the decision at which an exploring start begins."""
        last = self.decisions - 1
        if len(self.critical) and happens(self.starts.focus, rng):
            lead = rng.uniform(0.0, self.starts.lead) / (self.interval * self.scenario.mission_step)
            return min(max(round(float(rng.choice(self.critical)) - lead), 0), last - 1)
        return int(rng.integers(last))

    def _critical(self) -> np.ndarray:
        """Decisions by which a slot of the first formation has just come within the safe distance of an obstacle, or left it."""
        decisions = np.arange(self.decisions) * self.interval
        slots = [self._centre(int(step)) + self.scenario.formations[0] for step in decisions]
        anchors, motions = self.scenario.obstacle_array(), motion_array(self.scenario.motions)
        places = [obstacles_at(step * self.scenario.mission_step, anchors, motions) for step in decisions]
        blocked = np.array([self._blocked(*pair) for pair in zip(slots, places, strict=True)])
        return np.flatnonzero((blocked[1:] != blocked[:-1]).any(axis=1)) + 1

    def _centre(self, step: int) -> np.ndarray:
        """(2,) desired centroid at a mission step [m]."""
        return desired_centroid(self.scenario, step * self.scenario.mission_step)

    def _blocked(self, positions: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
        """(N,) bool: positions (N, 2) [m] within the safe distance of an obstacle."""
        return np.asarray(violates(clearances(positions, obstacles), self.scenario.safe_distance))


def happens(share: float, rng: np.random.Generator) -> bool:
    """True with probability ``share``; a share of 0 draws no random number and leaves the stream unchanged."""
    return share > 0 and rng.random() < share
