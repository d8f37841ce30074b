"""A scenario: everything that defines one problem instance, as one frozen documented dataclass."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from math import factorial
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from marlbc_mj.core.behaviors import AgentAvoidance, Behavior, Formation, LineFormation, ObstacleAvoidance
from marlbc_mj.core.communication import IDEAL, Communication
from marlbc_mj.core.disturbances import Disturbance, PaperDrag
from marlbc_mj.core.imperfections import NO_IMPERFECTIONS, Imperfections
from marlbc_mj.core.motion import NUMBERS, obstacles_at
from marlbc_mj.core.orders import Orders
from marlbc_mj.robots import RobotFleet, make_fleet
from marlbc_mj.scenarios.layout import SPLITS, Layout, Motion, check_motions, layout_number, motion_array
from marlbc_mj.scenarios.robot_names import PAPER_ROBOT, settle_robots
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.seeding import stream
from marlbc_mj.util.settings import check_kinds

Point = tuple[float, float]
MOST_SUBSTEPS = 10_000  # substeps in one mission step
MOST_STEPS = 10_000_000  # mission steps in one episode; they take about an hour to simulate
MOST_BEHAVIORS = 6  # 6 behaviors have 720 orders, still few enough for a table
REFERENCE_MODES = ("virtual", "actual")
COMPOSITIONS = ("null-space", "set-based")
"""Null-space composition treats avoidance as an equality task (12), set-based composition as an inequality."""
ADDED_LATER = {"added_later": True}
"""Metadata of a field added later: at its default it changes nothing and is left out of hashes, so old hashes stay valid."""


class OnPath(Protocol):
    """Anything with a mission's path: a scenario, or the part of one that a log keeps."""

    @property
    def path_origin(self) -> Point: ...
    @property
    def path_velocity(self) -> Point: ...


def desired_centroid(mission: OnPath, time: float) -> np.ndarray:
    """(2,) desired centroid p_cd of a mission at ``time`` [s], in m."""
    return np.array(mission.path_origin) + time * np.array(mission.path_velocity)


class Obstacle(NamedTuple):
    """A disc, or a point when its radius is zero."""

    x: float  # [m]
    y: float  # [m]
    radius: float = 0.0  # [m]


class Window(NamedTuple):
    """A time window, both ends exclusive, in which the scripted supervisor gives ``agent`` (-1: all agents) this order."""

    start: float  # [s]
    end: float  # [s]
    agent: int
    order: str


@dataclass(frozen=True)
class Perturbation:
    """How a seed changes the scenario: uniform draws around its values. With the defaults every seed gives the same instance."""

    start_spread: float = 0.0  # each start coordinate moves by at most this [m]
    obstacle_spread: float = 0.0  # each obstacle coordinate moves by at most this [m]
    drag_scale: tuple[float, float] = (1.0, 1.0)  # the disturbance is multiplied by a draw from this range

    def __post_init__(self) -> None:
        for name in ("start_spread", "obstacle_spread"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ConfigurationError(f"perturbation: {name} must be finite and not negative, got {value}")
        if not 0.0 <= self.drag_scale[0] <= self.drag_scale[1] < np.inf:
            raise ConfigurationError(
                f"perturbation: drag_scale must be two finite numbers, not negative, the smaller first, got {self.drag_scale}"
            )


class Draw(NamedTuple):
    """One seed's instance of a scenario."""

    starts: np.ndarray  # (N, 2) [m]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; for a moving obstacle, its place without motion
    drag_scale: float
    motions: np.ndarray = np.zeros((0, NUMBERS))  # (K, 6), or (0, 6) where all obstacles are at rest
    layout: int | None = None  # number of the layout; None if the scenario draws no layout


@dataclass(frozen=True)
class Scenario:
    """A team, its path, its behaviors, the obstacles and the simulation settings.

    A supervisor decides every ``mission_step``; the control law and the physics run every ``substep``. A mission step is a whole
    number of substeps. Every number is checked when the scenario is built.

    Raises:
        ConfigurationError: a value is invalid; the message names it.
    """

    name: str
    starts: tuple[Point, ...]  # p(0), one per agent [m]
    behaviors: tuple[Behavior, ...]  # in the order of their indices
    path_origin: Point = (0.0, 0.0)  # p_cd(0) [m]
    path_velocity: Point = (0.0, 0.0)  # p_cd' [m/s]
    obstacles: tuple[Obstacle, ...] = ()
    safe_distance: float = 2.0  # d_OA: a clearance of at most this is a violation [m]
    formation_names: tuple[str, str] = ("FM", "FR")  # behaviors whose slots define G = 2 and G = 1
    formation_tolerance: float = 0.5  # largest distance from the slot, relative to the centroid [m]
    duration: float = 100.0  # [s]
    mission_step: float = 0.05  # [s]
    substep: float = 0.005  # [s]
    reference: Literal["virtual", "actual"] = "virtual"  # where behaviors are evaluated: at p_r or at the measured p
    robot: str = PAPER_ROBOT  # robot of all agents
    mass: float = 1.0  # [kg]
    force_limit: float = 200.0  # per axis [N]
    # force for a controller's output of 1 [N]; set to a robot's mass, it makes controller gains per unit mass
    unit_force: float = field(default=1.0, metadata=ADDED_LATER)
    speed_limit: float = field(
        default=np.inf, metadata=ADDED_LATER
    )  # speed limit of references [m/s]; the paper's point mass has none
    acceleration_limit: float = field(default=np.inf, metadata=ADDED_LATER)  # acceleration limit of references [m/s^2]
    imperfections: Imperfections = field(
        default=NO_IMPERFECTIONS, metadata=ADDED_LATER
    )  # sensor noise, sensor delay, actuator loss
    disturbance: Disturbance = field(default_factory=PaperDrag)
    perturbation: Perturbation = Perturbation()
    schedule: tuple[Window, ...] = ()  # windows of the scripted supervisor; outside all of them the order is FM
    description: str = ""
    motions: tuple[Motion, ...] = field(
        default=(), metadata=ADDED_LATER
    )  # one per obstacle, or empty if all obstacles are at rest
    layout: Layout | None = field(default=None, metadata=ADDED_LATER)  # draws obstacles and motions anew for every seed
    split: Literal["train", "test"] = field(default="train", metadata=ADDED_LATER)  # which layouts are drawn
    # how an order becomes a reference, see COMPOSITIONS
    composition: Literal["null-space", "set-based"] = field(default="null-space", metadata=ADDED_LATER)
    communication: Communication = field(default=IDEAL, metadata=ADDED_LATER)  # range, delay and loss of messages
    robots: tuple[str, ...] = field(
        default=(), metadata=ADDED_LATER
    )  # robot of each agent if they differ; ``robot`` is then the first

    def __post_init__(self) -> None:
        check_kinds(self, f"scenario {self.name!r}: ")
        if not isinstance(self.disturbance, Disturbance):
            raise ConfigurationError(f"scenario {self.name!r}: disturbance must be a Disturbance, got {self.disturbance!r}")
        object.__setattr__(self, "obstacles", tuple(Obstacle(*o) for o in self.obstacles))
        object.__setattr__(self, "schedule", tuple(Window(*w) for w in self.schedule))
        object.__setattr__(self, "motions", tuple(Motion(*m) for m in self.motions))
        self._check_numbers()
        robot, robots = settle_robots(self.name, self.agents, self.robot, self.robots)
        object.__setattr__(self, "robot", robot)
        object.__setattr__(self, "robots", robots)
        self._check_team()
        self._check_clocks()
        self.imperfections.check(self.agents, self.substep)
        self.communication.check(np.array(self.starts, dtype=np.float64), self.mission_step)
        self.check_windows(self.schedule)

    @property
    def agents(self) -> int:
        """N, the number of agents."""
        return len(self.starts)

    @property
    def fleet(self) -> RobotFleet:
        """The robots of all agents.

        Raises:
            ConfigurationError: an unknown robot, or robots that cannot share a world.
        """
        return make_fleet(self.robots or (self.robot,) * self.agents)

    @property
    def force_limits(self) -> np.ndarray:
        """(N,) force limits per axis [N]: ``force_limit``, in a mixed team capped by each robot's own limit."""
        return self.fleet.force_limits(self.force_limit) if self.robots else np.full(self.agents, float(self.force_limit))

    @property
    def least_acceleration(self) -> float:
        """Largest acceleration per axis of the weakest agent [m/s^2]."""
        return float((self.force_limits / (self.fleet.masses(self.mass) if self.robots else self.mass)).min())

    @property
    def unhashed(self) -> set[str]:
        """Names of the fields that hashes leave out: those of :data:`ADDED_LATER` that have their defaults."""
        return {each.name for each in fields(self) if each.metadata == ADDED_LATER and getattr(self, each.name) == each.default}

    @property
    def mission_steps(self) -> int:
        """Number of mission steps in one episode."""
        return round(self.duration / self.mission_step)

    @property
    def substeps(self) -> int:
        """Number of physics substeps in one mission step."""
        return round(self.mission_step / self.substep)

    @cached_property
    def orders(self) -> Orders:
        """All priority orders of this scenario's behaviors."""
        return Orders([b.name for b in self.behaviors], [b.complete for b in self.behaviors])

    @cached_property
    def formations(self) -> np.ndarray:
        """(2, N, 2) slot offsets [m] that define G = 2 (first) and G = 1 (second)."""
        by_name = {b.name: b for b in self.behaviors}
        offsets = [by_name[name].offsets for name in self.formation_names]  # type: ignore[attr-defined]
        return np.array(offsets, dtype=np.float64)

    @property
    def draws(self) -> bool:
        """Whether anything depends on the seed: starts, obstacles, drag, layout, sensor noise or lost messages."""
        noisy = self.imperfections.position_noise > 0 or self.imperfections.velocity_noise > 0
        return self.perturbation != Perturbation() or self.layout is not None or noisy or self.communication.loss > 0

    @property
    def moving(self) -> bool:
        """Whether obstacles move."""
        return len(self.motions) > 0

    def obstacle_array(self) -> np.ndarray:
        """(K, 3) x, y, radius [m] of the obstacles; for a moving obstacle, its place without motion."""
        return np.array(self.obstacles, dtype=np.float64).reshape(-1, 3)

    def draw(self, rng: np.random.Generator) -> Draw:
        """One instance: starts, obstacles and drag scale drawn around this scenario's values.

        A scenario with a layout draws the layout first. A draw that puts an obstacle on a start is repeated.

        Raises:
            ConfigurationError: 100 draws in a row put an obstacle on a start, or no layout was found.
        """
        spread = self.perturbation
        for _ in range(100):
            starts = np.array(self.starts, dtype=np.float64)
            obstacles, motions, number = self._lay_out(rng)
            starts += rng.uniform(-spread.start_spread, spread.start_spread, starts.shape)
            obstacles[:, :2] += rng.uniform(-spread.obstacle_spread, spread.obstacle_spread, (len(obstacles), 2))
            first = obstacles_at(0.0, obstacles, motions)
            gaps = np.linalg.norm(starts[:, None] - first[None, :, :2], axis=-1) - first[:, 2]
            if (gaps > 0).all():
                return Draw(starts, obstacles, float(rng.uniform(*spread.drag_scale)), motions, number)
        raise ConfigurationError(f"scenario {self.name!r}: with {spread}, each of 100 draws puts an obstacle on a start")

    def draw_of(self, seed: int) -> Draw:
        """The draw that ``World.reset(seed)`` uses for world 0.

        Raises:
            ConfigurationError: as :meth:`draw`.
        """
        return self.draw(stream(seed))

    def _lay_out(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int | None]:
        """Obstacles (K, 3), motions (K, 6) or (0, 6), and the layout's number, None without a layout."""
        if self.layout is None:
            return self.obstacle_array(), motion_array(self.motions), None
        number = layout_number(rng, self.split)
        obstacles, motions = self.layout.sample(np.random.default_rng(number))
        return obstacles.copy(), motions, number

    def check_windows(self, windows: tuple[Window, ...]) -> None:
        """Raise ConfigurationError for a window with an unknown agent, times that are not finite, or an end before its start."""
        for window in windows:
            if not np.isfinite((window.start, window.end)).all():
                raise ConfigurationError(f"window {tuple(window)}: times must be finite")
            if window.start > window.end:
                raise ConfigurationError(f"window {tuple(window)}: it ends before it starts")
            if not -1 <= window.agent < self.agents:
                raise ConfigurationError(
                    f"window {tuple(window)}: agent must be -1 (all) or 0 to {self.agents - 1}, got {window.agent}"
                )

    def _check_numbers(self) -> None:
        positive = (
            "safe_distance",
            "formation_tolerance",
            "duration",
            "mission_step",
            "substep",
            "mass",
            "force_limit",
            "unit_force",
        )
        for name in positive:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigurationError(f"scenario {self.name!r}: {name} must be positive and finite, got {value}")
        for name in ("speed_limit", "acceleration_limit"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"scenario {self.name!r}: {name} must be positive, got {getattr(self, name)}")
        if self.reference not in REFERENCE_MODES:
            raise unknown("reference mode", self.reference, REFERENCE_MODES)
        if self.composition not in COMPOSITIONS:
            raise unknown("composition", self.composition, COMPOSITIONS)
        if self.split not in SPLITS:
            raise unknown("split", self.split, SPLITS)
        arrays = {"starts": self.starts, "obstacles": self.obstacles, "path": (self.path_origin, self.path_velocity)}
        for name, values in arrays.items():
            try:
                finite = np.isfinite(np.array(values, dtype=float)).all()
            except (TypeError, ValueError):
                raise ConfigurationError(f"scenario {self.name!r}: {name} must be numbers, got {values!r}") from None
            if not finite:
                raise ConfigurationError(f"scenario {self.name!r}: {name} must be finite, got {values}")

    def _check_team(self) -> None:
        if self.agents < 2:
            raise ConfigurationError(f"scenario {self.name!r} has {self.agents} agent(s); a team needs at least 2")
        names = [b.name for b in self.behaviors]
        if len(names) > MOST_BEHAVIORS:
            raise ConfigurationError(
                f"{len(names)} behaviors make {factorial(len(names))} orders; at most {MOST_BEHAVIORS} behaviors are supported"
            )
        if len(set(names)) != len(names):
            raise ConfigurationError(f"scenario {self.name!r}: two behaviors share a name: {', '.join(names)}")
        slotted = [b.name for b in self.behaviors if hasattr(b, "offsets")]
        for name in self.formation_names:
            if name not in slotted:
                raise unknown("formation behavior", name, slotted)
        for behavior in self.behaviors:
            offsets = getattr(behavior, "offsets", None)
            if offsets is not None:
                self._check_slots(behavior.name, offsets)
            if self.composition == "set-based" and getattr(behavior, "two_sided", False):
                raise ConfigurationError(
                    f"scenario {self.name!r}: a two-sided {behavior.name} is an equality task, but composition is set-based"
                )
        check_motions(self.motions, len(self.obstacles))
        first = obstacles_at(0.0, self.obstacle_array(), motion_array(self.motions))
        starts = np.array(self.starts, dtype=np.float64)
        for k, obstacle in enumerate(self.obstacles):
            if obstacle.radius < 0:
                raise ConfigurationError(f"obstacle {k} has a negative radius: {obstacle}")
            covered = np.flatnonzero(np.hypot(*(starts - first[k, :2]).T) <= obstacle.radius)
            if len(covered):
                i = int(covered[0])
                raise ConfigurationError(f"obstacle {k} {tuple(obstacle)} covers the start of agent {i + 1} {self.starts[i]}")

    def _check_slots(self, name: str, offsets: tuple[Point, ...]) -> None:
        if len(offsets) != self.agents:
            raise ConfigurationError(f"{name} has {len(offsets)} slots for {self.agents} agents")
        slots = np.array(offsets)
        near = np.linalg.norm(slots[:, None] - slots[None], axis=-1) < 1e-9
        for i, j in np.argwhere(np.tril(near, -1)):
            raise ConfigurationError(f"{name} slots of agents {j + 1} and {i + 1} overlap at {tuple(map(float, slots[i]))}")

    def _check_clocks(self) -> None:
        if self.mission_step / self.substep > MOST_SUBSTEPS:
            raise ConfigurationError(
                f"a mission step of {self.mission_step} s has more than {MOST_SUBSTEPS} substeps of {self.substep} s"
            )
        if self.duration / self.mission_step > MOST_STEPS:
            raise ConfigurationError(
                f"duration {self.duration} s has more than {MOST_STEPS} mission steps of {self.mission_step} s"
            )
        for long, short in (("mission_step", "substep"), ("duration", "mission_step")):
            ratio = getattr(self, long) / getattr(self, short)
            if ratio < 1 - 1e-9 or abs(ratio - round(ratio)) > 1e-9 * max(1.0, ratio):
                raise ConfigurationError(
                    f"{long} {getattr(self, long)} s must be a whole multiple of {short} {getattr(self, short)} s"
                )


def with_changes(made: Mapping[str, Any], changes: Mapping[str, Any]) -> Scenario:
    """A scenario from the fields ``made``, of which ``changes`` override some.

    Raises:
        ConfigurationError: a change that names no field of a scenario.
    """
    known = [each.name for each in fields(Scenario)]
    if "agents" in changes:
        team = f"a fixed team of {len(made['starts'])} agents"
        raise ConfigurationError(
            f"scenario {changes.get('name', made['name'])!r} has {team}; only families such as 'field' and 'gates' accept agents"
        )
    for name in changes:
        if name not in known:
            raise unknown("field of a scenario", name, known)
    return Scenario(**{**made, **changes})


def standard_behaviors(
    formation: tuple[Point, ...],
    reconstruction: tuple[Point, ...],
    *,
    avoidance_gain: float = 20.0,
    formation_gain: float = 8.0,
    safe_distance: float = 2.0,
    two_sided: bool = False,
    agent_distance: float | None = None,
    line_width: float | None = None,
) -> tuple[Behavior, ...]:
    """OA, FM and FR, by default with the gains of Table 2, then AA with OA's gain if ``agent_distance`` is given.

    With ``line_width`` [m], FR is a :class:`~marlbc_mj.core.behaviors.LineFormation` of that width.
    """
    column = Formation("FR", reconstruction, formation_gain)
    if line_width is not None:
        column = LineFormation("FR", reconstruction, formation_gain, line_width)
    return (
        ObstacleAvoidance(avoidance_gain, safe_distance, two_sided),
        Formation("FM", formation, formation_gain),
        column,
        *(() if agent_distance is None else (AgentAvoidance(avoidance_gain, agent_distance),)),
    )
