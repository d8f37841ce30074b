"""Layouts: how a seed places obstacles in front of a team that travels along +x. Each is a frozen dataclass with ``sample``.

Every layout leaves a way through: scattered discs keep a gap, walls have openings, and moving obstacles stay away from the slots
when a mission begins and ends. Draws that break this are rejected; after too many rejections an error gives the reason.
"""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.core.motion import NUMBERS, moved
from marlbc_mj.scenarios.layout import Sample
from marlbc_mj.util.errors import ConfigurationError

TRIES = 400  # places tried for one obstacle
RESTARTS = 20  # layouts tried before an error is raised
_FULL = 0.55  # share of an area that randomly placed discs can cover; more is rejected without trying

Range = tuple[float, float]


@dataclass(frozen=True)
class Scatter:
    """Discs at random places in a rectangle, their surfaces at least ``gap`` apart."""

    count: int
    radius: Range  # drawn uniformly [m]
    x: Range  # range of the centers [m]
    y: Range  # range of the centers [m]
    gap: float  # least distance between two surfaces [m]

    def sample(self, rng: np.random.Generator) -> Sample:
        """Discs placed at random one after the other where there is room."""
        mean = 0.5 * sum(self.radius) + 0.5 * self.gap
        area = (self.x[1] - self.x[0] + 2.0 * mean) * (self.y[1] - self.y[0] + 2.0 * mean)
        if self.count * np.pi * mean**2 > _FULL * area:
            raise ConfigurationError(
                self._reason(f"the discs with their gaps would cover more than {100 * _FULL:.0f} % of the area")
            )
        most = 0
        for _ in range(RESTARTS):
            discs = self._throw(rng)
            if len(discs) == self.count:
                return Sample(discs, np.zeros((0, NUMBERS)))
            most = max(most, len(discs))
        raise ConfigurationError(self._reason(f"the fullest of {RESTARTS} draws has room for {most}"))

    def _throw(self, rng: np.random.Generator) -> np.ndarray:
        """(k, 3) discs; k = ``count`` if there was room for all."""
        discs = np.empty((self.count, 3))
        radii = np.sort(rng.uniform(*self.radius, self.count))[::-1]  # the large ones first, while there is room
        for k, radius in enumerate(radii):
            places = np.column_stack([rng.uniform(*self.x, TRIES), rng.uniform(*self.y, TRIES)])
            free = self._first_free(places, radius, discs[:k])
            if free < 0:
                return discs[:k]
            discs[k] = *places[free], radius
        return discs

    def _first_free(self, places: np.ndarray, radius: float, discs: np.ndarray) -> int:
        """Index of the first of ``places`` (P, 2) with room for a disc among ``discs`` (k, 3); -1 if there is none."""
        first = 0
        while first < len(places):  # batches of doubling size: most discs find room after few tries, even among thousands
            some = places[first : 2 * first + 1]
            room = np.linalg.norm(some[:, None] - discs[None, :, :2], axis=-1) - discs[:, 2] - radius
            free = np.flatnonzero((room >= self.gap).all(axis=1))
            if len(free):
                return first + int(free[0])
            first += len(some)
        return -1

    def _reason(self, what: str) -> str:
        return (
            f"{self.count} obstacles of radius {self.radius[0]:g} to {self.radius[1]:g} m with gaps of {self.gap:g} m do not fit "
            f"into {self.x[1] - self.x[0]:g} x {self.y[1] - self.y[0]:g} m: {what}"
        )


@dataclass(frozen=True)
class Walls:
    """Gates and corridors: walls of discs across the route, each with an opening, and along both sides of the passage behind it.

    An opening's middle is drawn within ``shift`` of the path; its free width, between disc surfaces, is ``width``.
    """

    passages: tuple[Range, ...]  # start and end of each along x [m]; equal for a gate
    width: float  # [m]
    shift: float  # [m]
    radius: float  # radius of the discs [m]
    reach: float  # walls across the route extend at least this far from the path [m]

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw all passages, each opening at a random place."""
        walls = [self._passage(*ends, float(rng.uniform(-self.shift, self.shift))) for ends in self.passages]
        return Sample(np.concatenate(walls), np.zeros((0, NUMBERS)))

    def _passage(self, first: float, last: float, middle: float) -> np.ndarray:
        """(k, 3) discs of one passage; k does not depend on ``middle``."""
        side = 0.5 * self.width + self.radius
        across = side + 2.0 * self.radius * np.arange(int(np.ceil((self.reach + self.shift - side) / (2.0 * self.radius))) + 1)
        along = np.linspace(first, last, int(np.ceil((last - first) / (2.0 * self.radius))) + 1)[1:]
        places = [(first, middle + sign * y) for sign in (1.0, -1.0) for y in across]
        places += [(x, middle + sign * side) for sign in (1.0, -1.0) for x in along]
        return np.array([(x, y, self.radius) for x, y in places]).reshape(-1, 3)  # (0, 3) if the opening is wider than the walls


@dataclass(frozen=True)
class Traffic:
    """Moving discs: some cross the route in a straight line as the team passes, the others swing back and forth across it."""

    count: int
    swinging: int  # number of discs that swing; the others cross
    radius: Range  # [m]
    speed: Range  # speed of crossing discs, peak speed of swinging discs [m/s]
    swing: Range  # amplitude [m]
    x: Range  # where they meet the team [m]
    y: float  # largest distance from the path at that moment, or of the middle of the swing [m]
    arrival: tuple[float, float]  # the team reaches x at the time arrival[0] + arrival[1] x [s]
    spread: float  # how early or late a crossing disc may be [s]
    end: float  # duration of the mission [s]
    keep_out: tuple[tuple[float, float, float, float], ...]  # boxes x0, x1, y0, y1 to avoid at the start and at the end [m]
    gap: float  # least distance between two surfaces, checked every 0.25 s [m]

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw obstacles one by one; each is kept if it stays clear of the earlier ones, and of the slots at start and end."""
        for _ in range(RESTARTS):
            anchors, motions = self._add_all(rng)
            if len(anchors) == self.count:
                return Sample(anchors, motions)
        raise ConfigurationError(
            f"no room for {self.count} moving obstacles of radius up to {self.radius[1]:g} m on {self.x[1] - self.x[0]:g} m of "
            f"path in {RESTARTS} draws; use fewer or smaller obstacles or a longer path"
        )

    def _add_all(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        times = np.arange(0.0, self.end + 0.25, 0.25)
        anchors, motions = np.zeros((0, 3)), np.zeros((0, NUMBERS))
        tracks = np.zeros((len(times), 0, 3))
        meetings = rng.permutation(np.linspace(*self.x, self.count))
        for k, x in enumerate(meetings):
            for _ in range(TRIES // 10):
                anchor, motion = self._one(rng, float(x), k < self.swinging)
                track = moved(times, anchor[None], motion[None])[..., :3]
                if self._free(track[:, 0], tracks):
                    anchors, motions = np.vstack([anchors, anchor]), np.vstack([motions, motion])
                    tracks = np.concatenate([tracks, track], axis=1)
                    break
            else:
                break
        return anchors, motions

    def _one(self, rng: np.random.Generator, x: float, swings: bool) -> tuple[np.ndarray, np.ndarray]:
        """Anchor (3,) and motion (6,) of one random obstacle."""
        radius, speed, side = rng.uniform(*self.radius), rng.uniform(*self.speed), rng.choice((-1.0, 1.0))
        y = rng.uniform(-self.y, self.y)
        if swings:
            amplitude = rng.uniform(*self.swing)
            return np.array([x, y, radius]), np.array(
                [0.0, 0.0, 0.0, amplitude, speed / amplitude, rng.uniform(0.0, 2.0 * np.pi)]
            )
        when = self.arrival[0] + self.arrival[1] * x + rng.uniform(-self.spread, self.spread)
        slant = rng.uniform(-0.5, 0.5)
        velocity = speed * np.array([np.sin(slant), side * np.cos(slant)])
        return np.array([*(np.array([x, y]) - velocity * when), radius]), np.array([*velocity, 0.0, 0.0, 1.0, 0.0])

    def _free(self, track: np.ndarray, tracks: np.ndarray) -> bool:
        """Whether a track (T, 3) keeps ``gap`` to the other tracks (T, k, 3) and is outside ``keep_out`` at start and end."""
        between = np.linalg.norm(tracks[..., :2] - track[:, None, :2], axis=-1) - tracks[..., 2] - track[:, None, 2]
        if (between < self.gap).any():
            return False
        for (x, y, radius), (x0, x1, y0, y1) in zip((track[0], track[-1]), self.keep_out, strict=True):
            if x0 - radius < x < x1 + radius and y0 - radius < y < y1 + radius:
                return False
        return True
