"""Room for teams of any size: missions that a column of several files can fly."""

import numpy as np
import pytest

from marlbc_mj import World
from marlbc_mj.controllers import make_controller
from marlbc_mj.policies.general import COLUMN_ACTION, FORMATION
from marlbc_mj.policies.general_inputs import COLUMN_WAY, FORMATION_WAY, INPUTS, WAYS
from marlbc_mj.scenarios import FAMILIES
from marlbc_mj.scenarios.teams import files_of, room_for, team_mission
from marlbc_mj.studies.safety import ground
from marlbc_mj.training.general.config import GeneralConfig, learner_config
from marlbc_mj.training.general.squads import LOST_AFTER, Squad, look_ahead, shut_out
from marlbc_mj.util.errors import ConfigurationError

TEAMS = [("wedge", 4), ("circle", 8), ("line", 6), ("grid", 9), ("circle", 12), ("wedge", 16), ("grid", 16), ("grid", 32)]


@pytest.mark.parametrize(("formation", "agents"), TEAMS)
@pytest.mark.parametrize("family", ["field", "gates", "corridor"])
def test_the_column_is_shorter_than_the_way(family: str, formation: str, agents: int) -> None:
    """At least a fifth of the way is left in front of the column, and as much behind it."""
    scenario = team_mission(family, formation, agents)
    column = scenario.formations[1]
    way = scenario.duration * scenario.path_velocity[0]
    assert np.ptp(column[:, 0]) <= 0.6 * way
    assert len(np.unique(column[:, 1].round(6))) <= 2 * files_of(agents)


@pytest.mark.parametrize("family", ["field", "forest", "gates", "corridor", "traffic"])
def test_a_team_of_four_has_the_families_own_mission(family: str) -> None:
    assert team_mission(family, "wedge", 4) == FAMILIES[family]().build()


def test_only_families_make_room() -> None:
    with pytest.raises(ConfigurationError, match="make room"):
        room_for("paper", None, 16)
    assert room_for("gates", "grid", 32) == {"agents": 32, "formation": "grid", "length": 120.0, "files": 4, "width": 14.0}


def test_a_guiding_look_ahead_sees_only_its_bins() -> None:
    """Two lanes blocked within its bins make a column, one does not; the column stays while any agent's way back is blocked."""
    inputs, last, bins = np.ones((4, 3, INPUTS)), np.full((4, 3), FORMATION), np.full(4, 6)
    inputs[0, :2, 5] = inputs[1, :2, 6] = inputs[2, 1, 5] = -0.5
    inputs[3, 1, FORMATION_WAY] = -0.5
    assert look_ahead(inputs, last, bins).tolist() == [COLUMN_ACTION, FORMATION, FORMATION, FORMATION]
    last[3, 2] = COLUMN_ACTION
    assert look_ahead(inputs, last, bins).tolist() == [COLUMN_ACTION, FORMATION, FORMATION, COLUMN_ACTION]


def test_shut_out_conditions() -> None:
    inputs = np.zeros((1, 4, INPUTS))
    inputs[..., [FORMATION_WAY, COLUMN_WAY]] = -1.0
    inputs[..., [WAYS + 1, WAYS + 3]] = 0.99
    inputs[0, 1, COLUMN_WAY] = 0.1
    inputs[0, 2, WAYS + 3] = 0.5
    inputs[0, 3, FORMATION_WAY] = 0.0
    assert shut_out(inputs).tolist() == [[True, False, False, False]]


def test_an_episode_ends_where_an_agent_is_lost() -> None:
    """A team that never leaves its formation is lost at a gate; the last reward includes the cost of all future time."""
    config = GeneralConfig(families=("gates",), teams=("line-6",), lossy=0.0, guided=0.0, least_exploration=0.0)
    squad = Squad(team_mission("gates", "line", 6, composition="set-based", substep=0.01), config, learner_config(config), 0)
    squad.end[:] = squad.scenario.mission_steps
    greedy = np.full((1, 6), FORMATION)
    outcomes = [squad.step(greedy) for _ in range(90)]
    first = next(k for k, outcome in enumerate(outcomes) if outcome.terminal.any())
    assert first > LOST_AFTER
    assert outcomes[first].ended.all()
    np.testing.assert_allclose(outcomes[first].reward, -1.3 / (1.0 - config.gamma), rtol=1e-6)
    assert all(outcome.reward.min() >= -1.3 for outcome in outcomes[:first])


def test_a_mission_is_over_at_its_end_and_who_is_late_pays() -> None:
    """The last decision of a whole mission is terminal; that of an episode cut short to begin in another phase is not."""
    config = GeneralConfig(families=("field",), teams=("wedge-4",), lossy=0.0, guided=0.0, least_exploration=0.0)
    mission = team_mission("field", "wedge", 4, composition="set-based", substep=0.01, duration=6.0)
    squad = Squad(mission, config, learner_config(config), 0)
    squad.end[:] = 3 * squad.interval
    early = [squad.step(np.full((1, 4), FORMATION)) for _ in range(3)]
    assert early[-1].ended.all() and not any(outcome.terminal.any() for outcome in early)
    action, last = np.full((1, 4), COLUMN_ACTION), -(-mission.mission_steps // squad.interval) - 1
    column = [squad.step(action) for _ in range(last + 1)]
    assert [bool(outcome.terminal.all()) for outcome in column] == [False] * last + [True]
    late = column[-1].final[0, :, WAYS] > np.tanh(mission.formation_tolerance / mission.safe_distance)
    assert late.any()
    costs = -column[-1].reward[0]
    assert (costs[late] >= config.late_cost).all() and (costs[~late] <= 1.0 + config.stray_cost).all()
    assert (np.array([-outcome.reward for outcome in column[:-1]]) <= 1.0 + config.stray_cost + config.switch_cost).all()


@pytest.mark.parametrize("approach", ["straight", "line"])
def test_late_agents_pass_along_their_lines(approach: str) -> None:
    """Once the column has passed an opening, agents before the walls beside it stay if they approach straight, not by lines."""
    scenario = team_mission("gates", "line", 6, composition="set-based", substep=0.01, column_approach=approach, gates=1)
    world = World(scenario, make_controller("pd"))
    world.reset(0)
    formation, column = (scenario.orders.index(name) for name in scenario.formation_names)
    steps = scenario.mission_steps
    world.rollout(np.full((int(0.6 * steps), 1, 6), formation))
    world.rollout(np.full((int(0.3 * steps), 1, 6), column))
    x = world.observe().position[0, :, 0]
    assert (x > 35.0).all() == (approach == "line")


def test_a_mission_of_the_study_of_safety_names_team_and_approach() -> None:
    straight, lines = (ground(f"corridor-grid-9{end}") for end in ("", "-lines"))
    assert straight == team_mission("corridor", "grid", 9, split="test")
    assert lines == team_mission("corridor", "grid", 9, split="test", column_approach="line")
    with pytest.raises(ConfigurationError, match="FORMATION-AGENTS"):
        ground("gates-nine")
