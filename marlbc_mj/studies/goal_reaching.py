"""The double-integrator setting of GCBF+ (Zhang, So, Garg & Fan 2024, github.com/MIT-REALM/gcbfplus) as a scenario here.

Eight agents of radius 0.05 move among eight rectangles in a square of 4 by 4, each to its own goal. An agent reaches its goal
once it is within two radii of it, and fails once it touches an agent or a rectangle. Here lengths are ten times theirs, so that
the radius is that of the point mass, and times are the same. The mass is 1 kg, 100 N per axis correspond to their acceleration
limit of 10 per second squared, and references are at most 5 m/s, their velocity limit. Differences:

- they clip the velocity at its limit per axis; here the reference is bounded, and only forces move an agent;
- they make 256 or 1024 steps of 30 ms; here decisions are 30 ms apart, and control and physics run every 5 ms;
- rectangles are covered by discs, which stick out by up to 0.1 m; collisions are judged by the rectangles themselves;
- our rule senses obstacles and agents within 3 m, their policy senses within 5 m, by 32 rays.

Layouts are drawn by their rules, but not with their random numbers.
"""

import sys
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.cells import spacing
from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.statistics import Estimate, rate
from marlbc_mj.scenarios import Obstacle, Scenario, standard_behaviors
from marlbc_mj.scenarios.family import points
from marlbc_mj.supervisors import make_supervisor

AGENTS, BOXES = 8, 8
SIDE = 40.0  # of the square [m]
AGENT_RADIUS = 0.5  # [m]
LEAST_GAP = 4.0 * AGENT_RADIUS  # between starts, and from starts to rectangles; the same for goals [m]
SIDES = (1.0, 5.0)  # of a rectangle [m]
STEP = 0.03  # [s]
HORIZONS = (256, 1024)  # steps
EDGE_DISC = 0.25  # radius of the discs along a rectangle's edge, before they are enlarged to cover it [m]


class Box(NamedTuple):
    """A rectangle."""

    middle: np.ndarray  # (2,) [m]
    half: np.ndarray  # (2,) half side lengths [m]
    angle: float  # [rad]

    def distance(self, places: np.ndarray) -> np.ndarray:
        """(...) distance of ``places`` (..., 2) [m] from the rectangle; 0 inside."""
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        local = (places - self.middle) @ np.array([[cosine, -sine], [sine, cosine]])
        return np.asarray(np.linalg.norm(np.maximum(np.abs(local) - self.half, 0.0), axis=-1))

    def discs(self) -> list[Obstacle]:
        """Discs along its edge; they leave the interior uncovered, which no agent can reach."""
        inner = self.half - EDGE_DISC
        sides = [np.linspace(-half, half, int(np.ceil(2.0 * half / EDGE_DISC)) + 1) for half in inner]
        long = [(x, sign * inner[1]) for x in sides[0] for sign in (-1.0, 1.0)]
        short = [(sign * inner[0], y) for y in sides[1][1:-1] for sign in (-1.0, 1.0)]
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        places = np.array([*long, *short]) @ np.array([[cosine, sine], [-sine, cosine]]) + self.middle
        return [Obstacle(float(x), float(y), float(np.sqrt(2.0) * EDGE_DISC)) for x, y in places]


class GoalDraw(NamedTuple):
    """Starts, goals and rectangles of one draw."""

    starts: np.ndarray  # (N, 2) [m]
    goals: np.ndarray  # (N, 2) [m]
    boxes: tuple[Box, ...]


class GoalShares(NamedTuple):
    """Outcomes within a number of steps: shares with 95 % Wilson intervals."""

    steps: int
    reached: Estimate  # of agents
    safe: Estimate  # of agents that touched nothing
    success: Estimate  # of agents that reached their goal and touched nothing
    teams: Estimate  # of teams in which every agent succeeded


def draw_goals(rng: np.random.Generator) -> GoalDraw:
    """Random rectangles in the square, then starts and goals in the remaining room."""
    middles, angles = rng.uniform(0.0, SIDE, (BOXES, 2)), rng.uniform(0.0, 2.0 * np.pi, BOXES)
    halves = 0.5 * rng.uniform(*SIDES, (BOXES, 2))
    boxes = tuple(Box(*each) for each in zip(middles, halves, angles.tolist(), strict=True))
    return GoalDraw(_places(rng, boxes), _places(rng, boxes), boxes)


def _places(rng: np.random.Generator, boxes: tuple[Box, ...]) -> np.ndarray:
    """(N, 2) random positions, each more than LEAST_GAP from the others and from all rectangles."""
    found: list[np.ndarray] = []
    while len(found) < AGENTS:
        place = rng.uniform(0.0, SIDE, 2)
        others = [float(np.linalg.norm(place - other)) for other in found]
        if min([*others, *(float(box.distance(place)) for box in boxes)]) > LEAST_GAP:
            found.append(place)
    return np.array(found)


def goal_scenario(drawn: GoalDraw) -> Scenario:
    """The scenario of a draw: the slots of FM are the goals around their fixed mean, so each agent goes to its own goal."""
    middle = drawn.goals.mean(axis=0)
    slots = points(drawn.goals - middle)
    return Scenario(
        name="goals",
        starts=points(drawn.starts),
        behaviors=standard_behaviors(
            slots, slots, formation_gain=2.0, safe_distance=AGENT_RADIUS, agent_distance=2.0 * AGENT_RADIUS
        ),
        path_origin=points(middle[None])[0],
        obstacles=tuple(disc for box in drawn.boxes for disc in box.discs()),
        safe_distance=AGENT_RADIUS,
        duration=STEP * max(HORIZONS),
        mission_step=STEP,
        force_limit=100.0,
        speed_limit=5.0,
        disturbance=LinearDrag(coefficient=0.0),
        composition="set-based",
    )


def fly_to_goals(seed: int, supervisor: str = "fixed", *, shield: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Times at which each agent of a draw first reached its goal and first touched something: (N,) each, in mission steps, the
    second to the substep; infinite if never.
    """
    drawn = draw_goals(np.random.default_rng(seed))
    world = World(goal_scenario(drawn), record=True, shield=shield)
    at, substeps = run_episode(world, make_supervisor(supervisor)).position, world.scenario.substeps
    near = np.linalg.norm(at[::substeps] - drawn.goals, axis=-1) < 2.0 * AGENT_RADIUS
    touched = np.min([box.distance(at) for box in drawn.boxes], axis=0) < AGENT_RADIUS
    touched |= spacing(at) < 2.0 * AGENT_RADIUS
    return _first(near), _first(touched) / substeps


def _first(events: np.ndarray) -> np.ndarray:
    """(N,) index of the first true entry in each column of ``events`` (M, N); infinite if there is none."""
    return np.where(events.any(axis=0), events.argmax(axis=0), np.inf)


def goal_shares(ends: list[tuple[np.ndarray, np.ndarray]], steps: int) -> GoalShares:
    """Shares of the outcomes that :func:`fly_to_goals` returned, within a number of steps."""
    reached, touched = (np.array(rows) <= steps for rows in zip(*ends, strict=True))
    success = reached & ~touched
    return GoalShares(
        steps, rate(reached.ravel()), rate(~touched.ravel()), rate(success.ravel()), rate(np.asarray(success.all(axis=1)))
    )


def report_goals() -> None:
    """Print the shares over a number of draws: ``python -m marlbc_mj.studies.goal_reaching [DRAWS [SUPERVISOR [noshield]]]``."""
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    supervisor = sys.argv[2] if len(sys.argv) > 2 else "fixed"
    ends = [fly_to_goals(seed, supervisor, shield="noshield" not in sys.argv) for seed in range(draws)]
    for steps in HORIZONS:
        shares = goal_shares(ends, steps)
        for name, share in list(shares._asdict().items())[1:]:
            print(f"{steps} steps, {name}: {100 * share.value:.1f} % [{100 * share.low:.1f}, {100 * share.high:.1f}]", flush=True)


if __name__ == "__main__":
    report_goals()
