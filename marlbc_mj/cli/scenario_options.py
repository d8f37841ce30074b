"""Options that change a scenario, shared by several commands."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marlbc_mj.cli.choices import (
    ROBOTS_SETTING,
    ScenarioSettings,
    SomeComposition,
    SomeCount,
    SomeDisturbance,
    SomeFormation,
    SomeNumber,
    SomeReference,
    SomeRobot,
    SomeSplit,
    selectable,
)
from marlbc_mj.util.errors import ConfigurationError

if TYPE_CHECKING:
    from marlbc_mj.scenarios import Scenario


FIXED_TEAMS = ("paper", "cruise", "robot_gate")
"""Scenarios that are not families: their number of agents and their formations are fixed."""


@dataclass(frozen=True)
class ScenarioOptions:
    """Changes to the scenario."""

    substep: SomeNumber = None
    """Physics and control step [s]; must divide the mission step of 0.05 s."""
    reference: SomeReference = None
    """Where behaviors are evaluated: at the reference (virtual) or at the measured position (actual)."""
    composition: SomeComposition = None
    """How an order becomes a reference: avoidance as an equality task (null-space) or as an inequality (set-based)."""
    two_sided: bool = False
    """Use the published obstacle avoidance, an equality task, which also attracts agents (erratum 6)."""
    disturbance: SomeDisturbance = None
    """Unknown force on the agents, such as drag or wind."""
    drag_scale: SomeNumber = None
    """Factor on the disturbance."""
    force_limit: SomeNumber = None
    """Actuator limit per axis [N]; controllers without a limit (see `marlbc list`) ignore it."""
    duration: SomeNumber = None
    """Duration of the mission [s]."""
    robot: SomeRobot = None
    """Robot of every agent; its mass and limits replace those of the scenario."""
    agents: SomeCount = None
    """Number of agents, 2 to 256, for scenarios that allow any number."""
    formation: SomeFormation = None
    """Formation of the team, for scenarios that allow any number of agents."""
    room: bool = False
    """Make room for the team: teams of 12 or more agents get a longer path, a column of several files and wider openings."""
    along_lines: bool = False
    """Agents join the column first across the path to the line of their slot, then along it, instead of straight."""
    split: SomeSplit = None
    """Split from which random layouts are drawn; train, unless the command uses held-out layouts."""
    set: ScenarioSettings = ()
    """Settings of communication and imperfections, and the robots of a mixed team, for example: communication.range=8
    robots=disc,disc,omni,crazyflie."""

    allow_code: bool = False
    """Allow a scenario file to run the Python file of its robot."""

    def build(self, name: str) -> "Scenario":
        """The named scenario with these changes."""
        self._check_team(name)
        from marlbc_mj.core.disturbances import make_disturbance
        from marlbc_mj.scenarios import make_scenario
        from marlbc_mj.scenarios.teams import room_for
        from marlbc_mj.util.changes import with_settings

        keys = ("substep", "reference", "composition", "force_limit", "duration", "agents", "formation", "split")
        changes: dict[str, Any] = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        if self.room:
            changes = {**room_for(name, self.formation, self.agents), **changes}
        if self.along_lines:
            changes["column_approach"] = "line"
        if self.two_sided:
            changes["two_sided"] = True
        if self.disturbance is not None or self.drag_scale is not None:
            scale = 1.0 if self.drag_scale is None else self.drag_scale
            changes["disturbance"] = make_disturbance(self.disturbance or "paper", scale)
        settings, robots = self._split_settings()
        scenario = make_scenario(name, allow_code=self.allow_code, **self._robot_changes(name, robots), **changes)
        return with_settings(scenario, settings)

    def _check_team(self, name: str) -> None:
        """Refuse another team in a shipped scenario of fixed size; imports nothing heavy."""
        given = [option for option in ("agents", "formation", "room") if getattr(self, option)]
        if given and name in FIXED_TEAMS:
            families = [each for each in selectable()["scenarios"] if each not in FIXED_TEAMS]
            raise ConfigurationError(f"{name} has a fixed team; --{given[0]} works with families: {', '.join(families)}")

    def _split_settings(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The settings without ``robots``, and the names in ``robots``: the scenario is scaled to the robots when it is made."""
        given = [setting for setting in self.set if setting.partition("=")[0] == ROBOTS_SETTING]
        names = given[-1].partition("=")[2].split(",") if given else []
        return tuple(setting for setting in self.set if setting not in given), tuple(names)

    def _robot_changes(self, name: str, robots: tuple[str, ...]) -> dict[str, Any]:
        """Fields that --robot or the robots of all agents change, without those that other options set.

        Raises:
            ConfigurationError: both are given, or a robot cannot be made.
        """
        from marlbc_mj.robots import make_fleet

        if self.robot is not None and robots:
            raise ConfigurationError(
                f"--robot {self.robot} is for all agents and robots={','.join(robots)} for each one; give only one of them"
            )
        if self.robot is None and not robots:
            return {}
        chosen = {"robots": robots} if robots else {"robot": self.robot, "robots": ()}
        if name == "robot_gate":
            return chosen
        scale = make_fleet(robots or (str(self.robot),)).scale()
        return {**{key: value for key, value in scale.items() if getattr(self, key, None) is None}, **chosen}
