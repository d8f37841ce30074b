"""FMS: its fuzzy sets, the rules one by one, and a whole episode."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors.fms import FMS, memberships
from marlbc_mj.util.errors import ConfigurationError

PAPER = paper()
SEEN = World(PAPER).observe()
FM, FR, OA = (PAPER.orders.index(name) for name in ("FM", "FR", "OA>FM"))
clearances = st.floats(-5.0, 20.0)
rates = st.floats(-100.0, 100.0)


def run(clearance, supervisor=None) -> np.ndarray:
    """Orders (T, 4) for clearances (T,) [m], the same for all agents; the safe distance is 2 m."""
    supervisor = supervisor or FMS()
    memory, out = supervisor.start(PAPER, 1), []
    for step, d in enumerate(clearance):
        now = SEEN._replace(step=np.array([step]), time=np.array([step * 0.05]), clearance=np.full((1, 4), d))
        orders, memory = supervisor.decide(now, memory)
        out.append(orders[0])
    return np.array(out)


@given(clearances, rates)
def test_the_fuzzy_sets_are_a_partition_of_unity(clearance, rate):
    """near + mid + far = 1 and closing + opening = 1, each within [0, 1]."""
    sets = memberships(np.array([clearance]), np.array([rate]), 2.0)
    assert sets.near + sets.mid + sets.far == pytest.approx(1.0, abs=1e-12)
    assert sets.closing + sets.opening == pytest.approx(1.0, abs=1e-12)
    assert all(-1e-12 <= float(degree[0]) <= 1.0 for degree in sets)


@given(clearances, clearances, rates, rates)
def test_near_falls_and_far_rises_with_clearance_and_opening_with_rate(clearance, other, rate, another):
    d, r = np.sort([clearance, other]), np.sort([rate, another])
    sets = memberships(d, r, 2.0)
    assert sets.near[0] >= sets.near[1]
    assert sets.far[0] <= sets.far[1]
    assert sets.opening[0] <= sets.opening[1]


@pytest.mark.parametrize(
    ("x", "near", "mid", "far"),
    [(-1, 1, 0, 0), (1, 1, 0, 0), (1.15, 0.5, 0.5, 0), (1.3, 0, 1, 0), (2, 0, 1, 0), (2.3, 0, 0.5, 0.5), (2.6, 0, 0, 1)],
)
def test_corners_of_the_trapezoids(x, near, mid, far):
    sets = memberships(np.array([2.0 * x]), np.zeros(1), 2.0)
    assert np.concatenate(sets[:3]) == pytest.approx([near, mid, far], abs=1e-12)


def test_the_rate_is_a_logistic_function_of_twice_its_value():
    sets = memberships(np.full(2, 4.0), np.array([0.7, -0.7]), 2.0)
    expected = 1 / (1 + np.exp(-1.4))
    assert sets.opening == pytest.approx([expected, 1 - expected])


def test_each_rule_alone():
    """near -> OA on top; far -> FM; mid and closing fast -> FR; infinitely far without obstacles -> FM."""
    assert (run([1.5])[-1] == OA).all()
    assert (run([9.0])[-1] == FM).all()
    assert (run([4.5, 3.5])[-1] == FR).all()
    assert (run([np.inf, np.inf])[-1] == FM).all()


def test_opening_in_the_middle_keeps_the_order_in_force():
    """After near, OA stays in force while the clearance is mid and opening, until it is far."""
    orders = run([1.5, 2.8, 3.2, 3.6, 6.0])
    assert (orders[:4] == OA).all()
    assert (orders[4] == FM).all()


def test_a_lead_below_the_threshold_does_not_switch():
    """At x = 1.15 in the first step, OA has 0.5, FR 0.25 and keeping FM 0.25, so OA leads by 0.25."""
    assert (run([2.3])[-1] == OA).all()
    assert (run([2.3], FMS(lead=0.3))[-1] == FM).all()


@pytest.mark.parametrize("lead", [-0.1, 1.1, float("nan")])
def test_a_lead_outside_the_range_of_strengths_is_refused(lead):
    with pytest.raises(ConfigurationError, match=f"lead must be between 0 and 1, got {lead}"):
        FMS(lead=lead)


def test_on_the_case_study_it_is_deterministic_and_chatters():
    """Decisions on clearance alone undo their own causes, so every agent switches more than ten times."""
    first, second = (run_episode(World(PAPER, record=True), FMS()) for _ in range(2))
    np.testing.assert_array_equal(first.command, second.command)
    metrics = measure(first)
    assert all(agent["switches"] > 10 for agent in metrics["agents"])
    assert metrics["team"]["return"] < 15_000
