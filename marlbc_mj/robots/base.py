"""The definition of a robot: its MJCF file, the joints of its planar motion, its two laws, and the scale of its missions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.robots.planar import check_slides, straighten
from marlbc_mj.robots.standard import plain_name, quiet, standard_text
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.text import one_line

MODELS = Path(str(files("marlbc_mj") / "models"))
"""Folder of the MJCF files; in the repository it is a link to ``models/``."""


def _names(law: laws.Law) -> tuple[laws.Names, laws.Names]:
    """Names of a law's gains and state."""
    declared = laws.interface(law)
    return declared.gains, declared.state


def _as_it_is(spec: mujoco.MjSpec) -> None:
    """Leave the MJCF unchanged."""


@dataclass(frozen=True)
class Robot:
    """How a robot's planar position and velocity are read, and how a planar force drives it. Names are those inside the MJCF.

    A robot without laws is *direct*: its two ``motors`` push along x and y with the scenario's force limit, and p and v are its
    joints' coordinates and velocities. Gears, reversed or offset slides and all kinds of limits are taken into account.

    Every other robot has two laws: before each substep ``drive`` turns the force into controls; after it ``reading`` returns p, v
    and the force that the actuators really applied.

    ``mass`` and the fields after it set the scale of a robot's missions, see :meth:`scale`. A robot without a mass takes the
    scenario's, as the paper's point mass does.

    Raises:
        ConfigurationError: an invalid value, or one law without the other.
    """

    name: str
    mjcf: Path
    description: str
    joints: tuple[str, ...]  # two slide joints along x and y, or one free joint; unknown dynamics act on them
    body: str  # body with the mass; its geoms take the agent's color
    radius: float  # radius of the enclosing circle, seen from above [m]
    motors: tuple[str, ...] = ()  # actuators along x and y of a direct robot
    drive: laws.Law | None = None  # law of kind laws.DRIVE
    reading: laws.Law | None = None  # law of kind laws.READING
    params: laws.Numbers = field(default_factory=dict)  # gains of both laws, by name
    state: laws.Numbers = field(default_factory=dict)  # initial state of the laws, by name; missing entries start at 0
    report: tuple[str, ...] = ()  # state entries shown in diagnostics, for example "saturated"
    mass: float | None = None  # effective mass for a planar force, including wheels and rotors [kg]
    force_limit: float = np.inf  # per axis [N]
    speed_limit: float = np.inf  # speed limit of references [m/s]
    acceleration_limit: float = np.inf  # acceleration limit of references [m/s^2]
    gains: tuple[float, float] = (100.0, 100.0)  # PD gains per unit mass that track a step without overshoot [1/s^2, 1/s]
    length: float = 1.0  # length unit: 1 m of the paper's mission at this robot's scale [m]
    substep: float = np.inf  # largest substep for its contacts and inner loops [s]
    height: float = 0.0  # flight height [m]; 0 for a ground robot
    contact: bool = False  # whether it collides with obstacles and other agents
    force_error: float | None = None  # bound on forces other than u and f, in every direction [N]; None: unknown
    slip: float = 0.0  # how far its velocity may lag behind its force through contact with the ground [m/s]
    friction: float = 0.0  # bound on friction against the motion, which force_error does not include [N]
    tube: float | None = None  # measured largest distance from its reference with its own gains [m]; None: unknown
    ground: bool = False  # whether its geoms touch the arena's ground; if not, its MJCF has a floor or it flies
    prepare: Callable[[mujoco.MjSpec], None] = _as_it_is  # fills in values that the MJCF leaves open

    def __post_init__(self) -> None:
        self._check_kinds()
        positive = ("radius", "mass", "force_limit", "speed_limit", "acceleration_limit", "length", "substep")
        for name in positive:
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigurationError(f"robot {self.name!r}: {name} must be positive, got {value}")
        if (self.drive is None) != (self.reading is None):
            raise ConfigurationError(f"robot {self.name!r} has only one of drive and reading; give both, or neither and motors")
        if self.drive is not None and self.reading is not None and _names(self.drive) != _names(self.reading):
            raise ConfigurationError(f"robot {self.name!r}: drive and reading must declare the same names of gains and state")
        if self.drive is None and len(self.motors) != 2:
            raise ConfigurationError(f"robot {self.name!r} needs two motors, or a drive and a reading; got {self.motors}")
        if len(self.joints) not in (1, 2):
            raise ConfigurationError(f"robot {self.name!r}: joints must name two slides or one free joint, got {self.joints}")

    def _check_kinds(self) -> None:
        """Raise ConfigurationError for a field of the wrong type; replace slashes in names as in the MJCF."""
        if not isinstance(self.mjcf, Path):
            raise ConfigurationError(f"robot {self.name!r}: mjcf must be a pathlib.Path, got {self.mjcf!r}; write Path(...)")
        if not isinstance(self.body, str):
            raise ConfigurationError(f"robot {self.name!r}: body must be the name of a body, got {self.body!r}")
        for field_name in ("joints", "motors", "report"):
            value = getattr(self, field_name)
            if not isinstance(value, tuple) or not all(isinstance(each, str) for each in value):
                raise ConfigurationError(f"robot {self.name!r}: {field_name} must be a tuple of names, got {value!r}")
            if field_name != "report":
                object.__setattr__(self, field_name, tuple(map(plain_name, value)))
        object.__setattr__(self, "body", plain_name(self.body))
        for field_name in ("radius", "mass", "force_limit", "speed_limit", "acceleration_limit", "length", "substep", "height"):
            value = getattr(self, field_name)
            if not (value is None and field_name == "mass") and not isinstance(value, int | float | np.number):
                raise ConfigurationError(f"robot {self.name!r}: {field_name} must be a number, got {value!r}")

    @property
    def direct(self) -> bool:
        """Whether the planar force is the motors' control, without a drive in between."""
        return self.drive is None

    def params_row(self) -> np.ndarray:
        """(P,) gains that the loop passes to both laws; empty for a direct robot.

        Raises:
            ConfigurationError: a missing or unknown name.
        """
        return np.zeros(0) if self.drive is None else laws.pack_gains(self.drive, self.params)

    def state_row(self) -> np.ndarray:
        """(S,) initial state of both laws, in the loop's order; empty for a direct robot.

        Raises:
            ConfigurationError: an unknown name.
        """
        return np.zeros(0) if self.drive is None else laws.pack_state(self.drive, self.state)

    @property
    def diagnostics(self) -> dict[str, int]:
        """Index in the state of each entry named in ``report``."""
        return {} if self.drive is None else {name: laws.interface(self.drive).state.at(name) for name in self.report}

    @property
    def shipped(self) -> bool:
        """Whether its MJCF comes with this package; such a file is used as it is."""
        return self.mjcf.is_relative_to(MODELS)

    def spec(self) -> mujoco.MjSpec:
        """A copy of the MJCF, ready to be attached; the file is read once. A user's file is converted to standard form.

        Raises:
            ConfigurationError: the file cannot be read, is not MJCF, or lacks a body, joint or motor that the robot names.
        """
        return self._prepared.copy()

    @cached_property
    def _prepared(self) -> mujoco.MjSpec:
        """The MJCF of a shipped robot, or a user's in standard form; a direct robot's controls are then its planar forces."""
        if self.shipped:
            return self._as_shipped()
        with quiet():
            spec = mujoco.MjSpec.from_string(standard_text(self.mjcf))
            self.prepare(spec)
            self._check_names(spec)
            try:
                if self.direct:
                    straighten(spec, self.body, self.joints, self.motors)
                elif len(self.joints) == 2:
                    check_slides(spec, self.joints)
            except ConfigurationError as error:
                raise ConfigurationError(f"robot {self.name!r}, {self.mjcf.name}: {error}") from error
        return spec

    def _as_shipped(self) -> mujoco.MjSpec:
        """The MJCF from its file, after ``prepare``."""
        try:
            spec = mujoco.MjSpec.from_file(str(self.mjcf))
        except (ValueError, FileNotFoundError) as error:
            raise ConfigurationError(f"robot {self.name!r}: cannot read {self.mjcf}: {one_line(error)}") from error
        self.prepare(spec)
        return spec

    def _check_names(self, spec: mujoco.MjSpec) -> None:
        """Raise ConfigurationError if the MJCF lacks a named body, joint or motor."""
        there = {
            "body": ((self.body,), [body.name for body in spec.bodies[1:]]),
            "joints": (self.joints, [joint.name for joint in spec.joints]),
            "motors": (self.motors, [actuator.name for actuator in spec.actuators]),
        }
        for field_name, (wanted, names) in there.items():
            for name in wanted:
                if name not in names:
                    raise ConfigurationError(
                        f"robot {self.name!r}: {field_name} names {name!r}, which {self.mjcf.name} does not have; "
                        f"it has: {', '.join(names) or 'none'}"
                    )

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the fields only; the MJCF is read again when needed."""
        return {name: value for name, value in vars(self).items() if name != "_prepared"}

    def scale(self) -> dict[str, Any]:
        """The fields of a :class:`~marlbc_mj.scenarios.Scenario` that this robot sets: mass, limits, force unit, substep."""
        if self.mass is None:
            return {"robot": self.name}
        return {
            "robot": self.name,
            "mass": self.mass,
            "unit_force": self.mass,
            "force_limit": self.force_limit,
            "speed_limit": self.speed_limit,
            "acceleration_limit": self.acceleration_limit,
            "substep": self.substep,
        }

    def check(self, scenario: Any) -> None:
        """Raise ConfigurationError if a scenario's mass, force limit or substep does not fit this robot."""
        if self.mass is not None and not np.isclose(scenario.mass, self.mass, rtol=1e-9, atol=0.0):
            raise ConfigurationError(
                f"scenario {scenario.name!r}: mass {scenario.mass:g} kg, but robot {self.name!r} has {self.mass:g} kg; "
                f"take the robot's scale: **make_robot({self.name!r}).scale()"
            )
        for name in ("force_limit", "substep"):
            self.check_limit(scenario, name)

    def check_limit(self, scenario: Any, name: str) -> None:
        """Raise ConfigurationError if a scenario's field exceeds this robot's field of the same name."""
        value, most = getattr(scenario, name), getattr(self, name)
        if value > most * (1 + 1e-9):
            raise ConfigurationError(
                f"scenario {scenario.name!r}: {name} must be at most {most:g} for robot {self.name!r}, got {value:g}"
            )
