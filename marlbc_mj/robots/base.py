"""What a robot is: its MJCF file, where its planar motion is, its two laws, and the scale of its missions."""

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
"""Folder of the MJCF files; in the repository a link to ``models/``."""


def _names(law: laws.Law) -> tuple[laws.Names, laws.Names]:
    """Names of a law's gains and state."""
    declared = laws.interface(law)
    return declared.gains, declared.state


def _as_it_is(spec: mujoco.MjSpec) -> None:
    """A file that needs no change."""


@dataclass(frozen=True)
class Robot:
    """How a body's planar position and velocity are found, and how a planar force drives it. Names are those inside the MJCF.

    A robot without laws is *direct*: its two ``motors`` push along x and y with the scenario's force limit, and p, v are its
    joints' own; gears, reversed or offset slides and forms of limits are taken into account.

    Every other robot has a ``drive`` that turns the force into controls before each substep and a ``reading`` of p, v and the
    force that its actuators really gave, after it.

    ``mass`` and what follows it are the scale of a robot's missions, see :meth:`scale`. A robot with no mass of its own takes the
    scenario's, as the paper's point mass does.

    Raises:
        ConfigurationError: a number that cannot be, or one law without the other.
    """

    name: str
    mjcf: Path
    description: str
    joints: tuple[str, ...]  # two slide joints along x and y, or one free joint: unknown dynamics push here
    body: str  # carries the mass; its geoms take the agent's color
    radius: float  # of the smallest circle that it fits in, seen from above [m]
    motors: tuple[str, ...] = ()  # direct robots: the actuators of x and y
    drive: laws.Law | None = None  # as laws.DRIVE
    reading: laws.Law | None = None  # as laws.READING
    params: laws.Numbers = field(default_factory=dict)  # gains of both laws, by name
    state: laws.Numbers = field(default_factory=dict)  # what the laws remember, by name; what is left out starts at 0
    report: tuple[str, ...] = ()  # names in the state that diagnostics show, "saturated" for example
    mass: float | None = None  # what a planar force accelerates, wheels and rotors included [kg]
    force_limit: float = np.inf  # per axis [N]
    speed_limit: float = np.inf  # of references [m/s]
    acceleration_limit: float = np.inf  # of references [m/s^2]
    gains: tuple[float, float] = (100.0, 100.0)  # that track a step without overshoot, per unit mass [1/s^2, 1/s]
    length: float = 1.0  # what 1 m of the paper's mission is for this robot [m]
    substep: float = np.inf  # largest that its contacts and inner loops take [s]
    height: float = 0.0  # that it flies at [m]
    contact: bool = False  # obstacles and other agents are solid
    force_error: float | None = None  # bound of what moves it besides u and f, in every direction [N]; None: not known
    slip: float = 0.0  # by which its velocity may lag behind its force, in contact with the ground [m/s]
    friction: float = 0.0  # Coulomb friction that only slows it down, and that force_error leaves out [N]
    tube: float | None = None  # measured: how far it may be from its reference with its own gains [m]; None: not known
    ground: bool = False  # stands on the arena's ground by its own geoms' contact; else its MJCF has a floor, or it flies
    prepare: Callable[[mujoco.MjSpec], None] = _as_it_is  # fills in what the MJCF leaves open

    def __post_init__(self) -> None:
        self._check_kinds()
        positive = ("radius", "mass", "force_limit", "speed_limit", "acceleration_limit", "length", "substep")
        for name in positive:
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigurationError(f"robot {self.name!r}: {name} must be positive, got {value}")
        if (self.drive is None) != (self.reading is None):
            raise ConfigurationError(f"robot {self.name!r} has one of drive and reading; it needs both, or neither and motors")
        if self.drive is not None and self.reading is not None and _names(self.drive) != _names(self.reading):
            raise ConfigurationError(f"robot {self.name!r}: drive and reading must declare the same names of gains and state")
        if self.drive is None and len(self.motors) != 2:
            raise ConfigurationError(f"robot {self.name!r} needs two motors, or a drive and a reading; got {self.motors}")
        if len(self.joints) not in (1, 2):
            raise ConfigurationError(f"robot {self.name!r}: joints must name two slides or one free joint, got {self.joints}")

    def _check_kinds(self) -> None:
        """Raise ConfigurationError for a field of the wrong kind; names lose their slashes, as those of the MJCF do."""
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
        """Whether the planar force goes to the motors as it is."""
        return self.drive is None

    def params_row(self) -> np.ndarray:
        """(P,) gains as the loop hands them to both laws; empty for a direct robot.

        Raises:
            ConfigurationError: a name that is missing or unknown.
        """
        return np.zeros(0) if self.drive is None else laws.pack_gains(self.drive, self.params)

    def state_row(self) -> np.ndarray:
        """(S,) state of both laws at the start, in the loop's order; empty for a direct robot.

        Raises:
            ConfigurationError: an unknown name.
        """
        return np.zeros(0) if self.drive is None else laws.pack_state(self.drive, self.state)

    @property
    def diagnostics(self) -> dict[str, int]:
        """Where in the state each number is that ``report`` names."""
        return {} if self.drive is None else {name: laws.interface(self.drive).state.at(name) for name in self.report}

    @property
    def shipped(self) -> bool:
        """Whether its MJCF comes with this package and is taken as it is."""
        return self.mjcf.is_relative_to(MODELS)

    def spec(self) -> mujoco.MjSpec:
        """The MJCF, ready to be attached: a copy of what is read once. A user's file is brought into standard form.

        Raises:
            ConfigurationError: the file cannot be read, is no MJCF, or lacks what the robot names.
        """
        return self._prepared.copy()

    @cached_property
    def _prepared(self) -> mujoco.MjSpec:
        """The MJCF of a shipped robot, or a user's in standard form; of a direct robot with planar forces for controls."""
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
        """The MJCF as its file has it."""
        try:
            spec = mujoco.MjSpec.from_file(str(self.mjcf))
        except (ValueError, FileNotFoundError) as error:
            raise ConfigurationError(f"robot {self.name!r}: cannot read {self.mjcf}: {one_line(error)}") from error
        self.prepare(spec)
        return spec

    def _check_names(self, spec: mujoco.MjSpec) -> None:
        """Raise ConfigurationError for a body, joint or motor that the MJCF does not have."""
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
        """The fields alone: what was read from the file is read again."""
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
        """Raise ConfigurationError where a scenario asks of this robot what it is not."""
        if self.mass is not None and not np.isclose(scenario.mass, self.mass, rtol=1e-9, atol=0.0):
            raise ConfigurationError(
                f"scenario {scenario.name!r}: mass {scenario.mass:g} kg, but robot {self.name!r} has {self.mass:g} kg; "
                f"take the robot's scale: **make_robot({self.name!r}).scale()"
            )
        for name in ("force_limit", "substep"):
            self.check_limit(scenario, name)

    def check_limit(self, scenario: Any, name: str) -> None:
        """Raise ConfigurationError for a field of a scenario that is larger than this robot's of the same name."""
        value, most = getattr(scenario, name), getattr(self, name)
        if value > most * (1 + 1e-9):
            raise ConfigurationError(
                f"scenario {scenario.name!r}: {name} must be at most {most:g} for robot {self.name!r}, got {value:g}"
            )
