"""Does any force lead out of the shield's safe set? Random states on its edge, hostile forces, and f in the worst direction.

``python -m marlbc_mj.studies.shield_states [STATES]`` tries 10^7 states by default for each of several shields, of which three
are wrong on purpose.
"""

import sys
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import compiled
from marlbc_mj.core.lookout import LISTED
from marlbc_mj.core.shield import ASSUMPTIONS, ShieldCounts, shield_team
from marlbc_mj.core.stopping import (
    ForceBound,
    ShieldNumbers,
    ShieldView,
    force_bound,
    gap_to,
    moves,
    pace_of,
    retreat_drift,
    stopping_distance,
    stopping_of,
)

ROUNDING = 1e-9  # [m]
ASSUMED = len(ASSUMPTIONS)


class Trial(NamedTuple):
    """A plant, and what its shield believes about it."""

    bound: ForceBound  # of f
    speed_cap: float  # [m/s]
    force_limit: float = 200.0  # [N]
    mass: float = 1.0  # [kg]
    substep: float = 0.005  # [s]
    things: int = 1  # most obstacles and neighbors that press at once
    obstacle_speed: float = 0.0  # greatest speed of obstacles; 0: they are at rest [m/s]
    obstacle_acceleration: float = 0.0  # greatest acceleration of moving obstacles [m/s^2]
    believed_acceleration: float | None = None  # what the shield believes it is; None: the true one [m/s^2]
    believed: ForceBound | None = None  # what the shield believes the bound is; None: the true one
    believed_force: float | None = None  # what the shield believes the limit is; None: the true one [N]

    def numbers(self) -> ShieldNumbers:
        """The numbers of the shield, which keeps 0.5 m from obstacles and 1 m between agents."""
        believed = self.bound if self.believed is None else self.believed
        force = self.force_limit if self.believed_force is None else self.believed_force
        acceleration = self.obstacle_acceleration if self.believed_acceleration is None else self.believed_acceleration
        numbers = ShieldNumbers(force, force, self.mass, *believed, self.speed_cap, 0.5, 1.0, 0.0)
        return numbers._replace(obstacle_speed=self.obstacle_speed, obstacle_acceleration=acceleration)

    def truth(self) -> ShieldNumbers:
        """The same numbers with the true values of the plant."""
        return self._replace(believed=None, believed_force=None, believed_acceleration=None).numbers()


def leave_rate(trial: Trial, states: int, seed: int = 0) -> float:
    """Share of random states on the edge of S from which one substep leads out of it.

    With several things, the :func:`retreat_drift` is tolerated, for which a shield's margin leaves room.
    """
    return float(_leave_rate(trial.numbers(), trial.truth(), trial.substep, trial.things, states, np.random.default_rng(seed)))


@compiled
def _leave_rate(numbers, truth, h, things, states, rng):
    left, agents, obstacles = 0, 2, np.zeros((max(things - 1, 1), 5 if truth.obstacle_speed > 0.0 else 3))
    p, v, stopping, force = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2))
    last, interventions, change, breaches = np.zeros((2, 2, 2)), np.zeros(2), np.zeros(2), np.zeros((2, ASSUMED))
    around, near = np.zeros((0, 1 + LISTED), dtype=np.int64), np.zeros(1 + len(obstacles) + agents, dtype=np.int64)
    view = ShieldView(
        h=h,
        p=p,
        v=v,
        moving=v,
        obstacles=obstacles,
        stopping=stopping,
        grid=np.zeros(0),
        planes=np.zeros((0, 0, 2, 3)),
        looked=np.zeros((0, 3)),
        around=around,
        near=near,
    )
    counts = ShieldCounts(interventions, change, breaches)
    for _ in range(states):
        _draw_state(rng, numbers, h, things, view)
        for i in range(agents):
            _draw_wish(rng, numbers, view, i, force[i])
        shield_team(numbers, view, last, force, counts)
        allowed = ROUNDING
        if things > 1:
            for i in range(agents):
                allowed += retreat_drift(truth, h, np.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2))
        for i in range(agents):
            _push(rng, numbers, truth, view, i, force[i])
        for i in range(agents):
            for axis in range(2):
                p[i, axis] += h * v[i, axis]
        if truth.obstacle_speed > 0.0:
            _move_obstacles(rng, truth, h, obstacles)
        left += _is_outside(numbers, view, allowed)
    return left / states


@compiled
def _draw_state(rng, numbers, h, things, view):
    """Draw two agents and obstacles with gaps that are 0 or small, so that the state is on the edge of S. Speeds vary widely."""
    for i in range(2):
        speed = min(numbers.speed_cap * rng.random() ** rng.integers(1, 5), numbers.speed_cap)
        if rng.random() < 0.1:
            speed = 3.0 * h * numbers.force_limit / numbers.mass * rng.random()
        angle = 2.0 * np.pi * rng.random()
        view.v[i, 0], view.v[i, 1] = speed * np.cos(angle), speed * np.sin(angle)
        view.stopping[i] = stopping_distance(numbers, speed)
    far = 1e6
    alone = things == 1 and rng.random() < 0.5
    _place(rng, view.p[1], view, -1.0 if alone else far if things == 1 else -1.0, 1.0 + view.stopping[0] + view.stopping[1])
    for k in range(view.obstacles.shape[0]):
        radius = 0.0 if rng.random() < 0.3 else 5.0 * rng.random()
        if moves(view, k):
            pace, angle = numbers.obstacle_speed * rng.random(), 2.0 * np.pi * rng.random()
            view.obstacles[k, 3], view.obstacles[k, 4] = pace * np.cos(angle), pace * np.sin(angle)
        _place(rng, view.obstacles[k], view, far if alone else -1.0, radius + 0.5 + stopping_of(numbers, view, 0, k))
        view.obstacles[k, 2] = radius
    if things > 1:  # the second agent must be in S as well
        for k in range(view.obstacles.shape[0]):
            if gap_to(numbers, view, 1, k)[0] < 0.0:
                view.obstacles[k, 0] = far


@compiled
def _place(rng, out, view, far, least):
    """Put ``out`` at distance ``least`` or slightly more from the first agent, at the origin; at ``far`` if that is positive."""
    view.p[0, 0] = view.p[0, 1] = 0.0
    gap = 0.0 if rng.random() < 0.5 else 0.1 * rng.random() ** 4
    distance = far if far > 0.0 else least + gap
    angle = 2.0 * np.pi * rng.random()
    if rng.random() < 0.5:  # ahead
        angle = np.arctan2(view.v[0, 1], view.v[0, 0]) + 0.3 * (rng.random() - 0.5)
    out[0], out[1] = distance * np.cos(angle), distance * np.sin(angle)


@compiled
def _move_obstacles(rng, truth, h, obstacles):
    """Move obstacles for a substep at their greatest acceleration in a random direction, or at none if they would be too fast."""
    for k in range(obstacles.shape[0]):
        angle, change = 2.0 * np.pi * rng.random(), truth.obstacle_acceleration
        x, y = change * np.cos(angle), change * np.sin(angle)
        if (obstacles[k, 3] + h * x) ** 2 + (obstacles[k, 4] + h * y) ** 2 > truth.obstacle_speed**2:
            x, y = 0.0, 0.0
        obstacles[k, 0] += h * obstacles[k, 3] + 0.5 * h * h * x
        obstacles[k, 1] += h * obstacles[k, 4] + 0.5 * h * h * y
        obstacles[k, 3] += h * x
        obstacles[k, 4] += h * y


@compiled
def _draw_wish(rng, numbers, view, i, force):
    """Draw a force of up to twice the limit, often straight at a thing."""
    size, angle = 2.0 * numbers.force_limit * rng.random(), 2.0 * np.pi * rng.random()
    k = rng.integers(0, view.obstacles.shape[0] + 2)
    force[0], force[1] = size * np.cos(angle), size * np.sin(angle)
    if k != view.obstacles.shape[0] + i and rng.random() < 0.7:
        _, normal_x, normal_y = gap_to(numbers, view, i, k)
        force[0], force[1] = -size * normal_x, -size * normal_y


@compiled
def _push(rng, numbers, truth, view, i, force):
    """Set v+ of agent ``i``: the force is scaled to the true limit, and f is at its bound in the worst or a random direction."""
    per = view.h / truth.mass
    for axis in range(2):
        force[axis] *= truth.force_limit / numbers.force_limit
    speed = np.sqrt(view.v[i, 0] ** 2 + view.v[i, 1] ** 2)
    x, y = view.v[i, 0] + per * force[0], view.v[i, 1] + per * force[1]
    angle = 2.0 * np.pi * rng.random()
    towards_x, towards_y = np.cos(angle), np.sin(angle)
    k = rng.integers(0, view.obstacles.shape[0] + 2)
    if k != view.obstacles.shape[0] + i and rng.random() < 0.8:
        _, normal_x, normal_y = gap_to(numbers, view, i, k)
        centre = view.h * (truth.force_limit - force_bound(truth, speed)) / truth.mass
        pace_x, pace_y = pace_of(view, k)
        away_x, away_y = x - pace_x - centre * normal_x, y - pace_y - centre * normal_y
        distance = np.sqrt(away_x**2 + away_y**2)
        if distance > 0.0:
            towards_x, towards_y = away_x / distance, away_y / distance
    view.v[i, 0] = x + per * force_bound(truth, speed) * towards_x
    view.v[i, 1] = y + per * force_bound(truth, speed) * towards_y


@compiled
def _is_outside(numbers, view, allowed):
    for i in range(2):
        view.stopping[i] = stopping_distance(numbers, np.sqrt(view.v[i, 0] ** 2 + view.v[i, 1] ** 2))
    for i in range(2):
        if np.sqrt(view.v[i, 0] ** 2 + view.v[i, 1] ** 2) > numbers.speed_cap + ROUNDING:
            return True
        for k in range(view.obstacles.shape[0] + 2):
            if k != view.obstacles.shape[0] + i and gap_to(numbers, view, i, k)[0] < -allowed:
                return True
    return False


def report_states() -> None:
    """Print the share of states that leave S, for correct shields and for three wrong ones."""
    states = int(float(sys.argv[1])) if len(sys.argv) > 1 else 10_000_000
    drag = ForceBound(linear=5.0 * float(np.sqrt(2.0)))
    right = Trial(drag, speed_cap=14.0)
    trials = {
        "drag x 5, one thing": right,
        "drag x 5, four things": right._replace(things=4),
        "drag x 5, one obstacle that moves": right._replace(obstacle_speed=2.0, obstacle_acceleration=2.0),
        "wind of 20 N, one thing": right._replace(bound=ForceBound(20.0, 1.0)),
        "wrong: brakes 10 % too strong": right._replace(believed_force=1.1 * right.force_limit),
        "wrong: half of the bound": right._replace(believed=ForceBound(linear=0.5 * drag.linear)),
        "wrong: obstacles that do not accelerate": right._replace(
            obstacle_speed=2.0, obstacle_acceleration=20.0, believed_acceleration=0.0
        ),
    }
    for name, trial in trials.items():
        print(f"{name}: {leave_rate(trial, states):.3g} of {states} states left", flush=True)


if __name__ == "__main__":
    report_states()
