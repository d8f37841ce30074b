"""Agent avoidance: its law, its place in the orders, and missions in which agents come close without it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import AgentAvoidance
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.supervisors import Blend, make_supervisor
from marlbc_mj.supervisors.neighbors import REACH
from marlbc_mj.util.errors import ConfigurationError

TEAM = st.integers(2, 8).flatmap(lambda n: arrays(np.float64, (n, 2), elements=st.floats(-3, 3)))
PATH = np.array([[0.0, 0.0], [1.0, -0.5]])


def evaluate(team: np.ndarray, agent: int, behavior: AgentAvoidance):
    """Number of rows, velocity (2,) and Jacobian (2, 2) for one agent."""
    velocity, jacobian = np.full(2, np.nan), np.full((2, 2), np.nan)
    gains = laws.as_gains(behavior.law, behavior.params(agent))
    rows = behavior.law(gains, team[agent], PATH, np.zeros((0, 3)), team, agent, velocity, jacobian)
    return rows, velocity, jacobian


def distance(p: np.ndarray, team: np.ndarray, agent: int) -> float:
    return float(np.linalg.norm(np.delete(team, agent, axis=0) - p, axis=1).min())


@given(TEAM, st.data())
def test_its_jacobian_is_the_gradient_of_the_distance_to_the_nearest_neighbor(team, data):
    """Checked by central differences, except where two neighbors are equally near."""
    agent = data.draw(st.integers(0, len(team) - 1))
    apart = np.sort(np.linalg.norm(np.delete(team, agent, axis=0) - team[agent], axis=1))
    assume(apart[0] > 0.05 and (len(apart) == 1 or apart[1] - apart[0] > 1e-3))
    rows, _, jacobian = evaluate(team, agent, AgentAvoidance(distance=20.0))
    h = 1e-6
    gradient = [
        (distance(team[agent] + e, team, agent) - distance(team[agent] - e, team, agent)) / (2 * h) for e in h * np.eye(2)
    ]
    assert rows == 1
    np.testing.assert_allclose(jacobian[0], gradient, atol=1e-6)


@given(TEAM)
def test_it_is_one_sided(team):
    """Below d_AA, v relative to the path is Lambda (d_AA - d) along the normal; from d_AA on there is no velocity and no row."""
    behavior = AgentAvoidance(gain=7.0, distance=1.5)
    for agent in range(len(team)):
        rows, velocity, jacobian = evaluate(team, agent, behavior)
        d = distance(team[agent], team, agent)
        if d >= 1.5:
            assert rows == 0 and (velocity == 0).all()
        else:
            rate = jacobian[0] @ (velocity - PATH[1])
            assert rate == pytest.approx(7.0 * (1.5 - d), abs=1e-9)
            assert np.linalg.norm(jacobian[0]) == pytest.approx(1.0)


def test_two_agents_in_one_place_part():
    """They move in opposite directions."""
    team = np.array([[1.0, 1.0], [1.0, 1.0], [9.0, 9.0]])
    first, second = (evaluate(team, agent, AgentAvoidance())[1] - PATH[1] for agent in (0, 1))
    assert first[0] < 0 < second[0]


@pytest.mark.parametrize("numbers", [{"gain": 0.0}, {"distance": -1.0}, {"distance": np.nan}])
def test_bad_numbers_are_refused(numbers):
    with pytest.raises(ConfigurationError, match=str(next(iter(numbers.values())))):
        AgentAvoidance(**numbers)


def test_four_behaviors_make_24_orders_and_10_commands():
    """Orders equal down to the first of FM and FR are one command; above it OA and AA count in order. The case study has six."""
    orders = make_scenario("exchange").orders
    assert len(orders) == 24
    assert sorted(orders.commands) == sorted(
        [*("FM", "FR"), *(f"{top}>{m}" for top in ("OA", "AA", "OA>AA", "AA>OA") for m in ("FM", "FR"))]
    )
    assert orders.command_of[orders.index("AA>FM>OA>FR")] == orders.command_of[orders.index("AA>FM>FR>OA")]
    assert len(make_scenario("paper").orders) == 6


def test_tables_of_orders_do_not_explode():
    """Six behaviors have 720 orders; seven are refused, with the number of orders that they would have."""
    scenario = make_scenario("paper")
    more = tuple(AgentAvoidance(name=f"A{k}") for k in range(4))
    assert len(replace(scenario, behaviors=(*scenario.behaviors, *more[:3])).orders) == 720
    with pytest.raises(ConfigurationError, match="7 behaviors make 5040 orders; at most 6"):
        replace(scenario, behaviors=(*scenario.behaviors, *more))


@pytest.mark.parametrize("name", ["fsams", "fsams-hysteresis", "fms", "layered"])
def test_it_removes_collisions(name):
    """All paths cross in one place: without AA agents come closer than 0.5 m, with it they stay more than 1 m apart."""
    scenario = make_scenario("exchange", agents=6)
    without = replace(scenario, behaviors=scenario.behaviors[:3])
    closest = [
        measure(run_episode(World(one, record=True), make_supervisor(name), seed=3))["team"] for one in (without, scenario)
    ]
    assert closest[0]["agent_distance_min"] < 0.5
    assert closest[1]["agent_distance_min"] > 1.0
    if name != "layered":  # it projects nothing: agents that meet head-on stop each other
        assert closest[1]["end_error"] < 0.5


@pytest.mark.parametrize("name", ["fsams", "fms", "layered", "mpcms"])
def test_supervisors_put_it_on_top_when_a_neighbor_is_too_close(name):
    """Only the two agents that are close to each other get AA on top, not the two that are far away."""
    scenario = make_scenario("open", agents=4, formation="line")
    supervisor, world = make_supervisor(name), World(scenario)
    near = (0.9 if name == "layered" else 0.9 * REACH) * scenario.behaviors[3].distance
    position = np.array([[0.0, 0.0], [near, 0.0], [40.0, 0.0], [80.0, 0.0]])
    seen = world.observe()._replace(position=position[None], reference=position[None])
    decision, _ = supervisor.decide(seen, supervisor.start(scenario, 1))
    orders = decision.orders if isinstance(decision, Blend) else decision
    assert [scenario.orders.names[k].startswith("AA>") for k in orders[0]] == [True, True, False, False]
