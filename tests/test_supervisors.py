"""Supervisors: windows by the clock, the automaton's table, hysteresis and dwell."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Window, paper
from marlbc_mj.supervisors import FSAMS, SUPERVISORS, Scripted, Supervisor, make_supervisor
from marlbc_mj.util.errors import ConfigurationError

PAPER = paper()
SEEN = World(PAPER).observe()
FM, FR, OA = (PAPER.orders.index(name) for name in ("FM", "FR", "OA>FM"))
URGENCY = {FM: 0, FR: 1, OA: 2}
clearance_sequences = st.lists(
    st.lists(st.floats(-1.0, 6.0), min_size=4, max_size=4), min_size=2, max_size=60
)  # (T, 4), with jumps of any size


def at(step: int, clearance=(9.0, 9.0, 9.0, 9.0)) -> Observation:
    """One team at a mission step; only time and clearance matter to these supervisors."""
    return SEEN._replace(step=np.array([step]), time=np.array([step * 0.05]), clearance=np.array([clearance], dtype=float))


def run(supervisor, clearances) -> np.ndarray:
    """Orders (T, 4) for a sequence of clearances (T, 4)."""
    memory = supervisor.start(PAPER, 1)
    out = []
    for step, clearance in enumerate(clearances):
        orders, memory = supervisor.decide(at(step, clearance), memory)
        out.append(orders[0])
    return np.array(out)


def names_at(supervisor, time: float) -> list[str]:
    orders, _ = supervisor.decide(at(round(time / 0.05)), supervisor.start(PAPER, 1))
    return [PAPER.orders.commands[PAPER.orders.command_of[order]] for order in orders[0]]


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (0.0, ["FM"] * 4),
        (18.10, ["FM"] * 4),
        (18.15, ["OA>FM", "FM", "FM", "FM"]),
        (21.85, ["OA>FM", "FM", "FM", "FM"]),
        (21.90, ["FM"] * 4),
        (43.10, ["FM"] * 4),
        (43.15, ["FM", "FM", "FM", "OA>FM"]),
        (46.85, ["FM", "FM", "FM", "OA>FM"]),
        (46.90, ["FM"] * 4),
        (50.00, ["FM"] * 4),
        (50.05, ["FR"] * 4),
        (82.45, ["FR"] * 4),
        (82.50, ["FM"] * 4),
        (99.95, ["FM"] * 4),
    ],
)
def test_the_schedule_of_the_case_study_has_strict_bounds(time, expected):
    """Section 1: OA for agent 1 on (18.1, 21.9), for agent 4 on (43.1, 46.9), FR for all on (50, 82.5), FM otherwise."""
    assert names_at(Scripted(), time) == expected


@given(st.integers(0, 400), st.integers(1, 400))
def test_a_time_on_a_windows_bound_is_outside_it(first, length):
    """This holds for every bound that is a decimal multiple of 0.05 s, although 3 * 0.05 > 0.15 in floating point."""
    start, end = round(first * 0.05, 2), round((first + length) * 0.05, 2)
    scripted = Scripted(windows=(Window(start, end, 1, "FR"),))
    memory = scripted.start(PAPER, 1)
    inside = [scripted.decide(at(step), memory)[0][0, 1] == FR for step in range(first + length + 2)]
    assert inside == [first < step < first + length for step in range(first + length + 2)]


def test_later_windows_win_and_defaults_fill():
    """Two windows overlap, and the default order is another than FM."""
    scripted = Scripted(windows=(Window(0.1, 1.0, -1, "FM"), Window(0.2, 0.5, 2, "OA>FR")), default="FR")
    assert names_at(scripted, 0.05) == ["FR"] * 4
    assert names_at(scripted, 0.3) == ["FM", "FM", "OA>FR", "FM"]


@pytest.mark.parametrize(
    ("supervisor", "scenario", "message"),
    [
        (Scripted(windows=(Window(0, 1, 4, "FM"),)), PAPER, "got 4"),
        (Scripted(windows=(Window(0, 1, -2, "FM"),)), PAPER, "got -2"),
        (Scripted(windows=(Window(0, 1, 0, "XX"),)), PAPER, "'XX'"),
        (Scripted(default="XX"), PAPER, "'XX'"),
        (Scripted(), paper(schedule=()), "no schedule"),
    ],
)
def test_a_script_that_does_not_fit_is_refused(supervisor, scenario, message):
    """The message names the wrong agent or order, or the missing schedule."""
    with pytest.raises(ConfigurationError, match=message):
        supervisor.start(scenario, 1)


@pytest.mark.parametrize("hysteresis", ["hysteresis", "dwell"])
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_automaton_settings_must_be_finite_and_not_negative(hysteresis, value):
    """The message names the setting and the value."""
    with pytest.raises(ConfigurationError, match=f"{hysteresis} .* {value}"):
        FSAMS(**{hysteresis: value})


@pytest.mark.parametrize(
    ("clearance", "order"),
    [(-1, OA), (0, OA), (2, OA), (np.nextafter(2, 3), FR), (3, FR), (4, FR), (np.nextafter(4, 5), FM), (9, FM), (np.inf, FM)],
)
def test_the_published_rule_at_its_thresholds(clearance, order):
    """d <= d_OA: OA; d_OA < d <= 2 d_OA: FR; else FM (section 4.2.1, erratum 8), per agent and from any state."""
    others = [(9.0, 9.0, 9.0, 9.0), (1.0, 1.0, 1.0, 1.0), (3.0, 3.0, 3.0, 3.0)]
    for before in others:
        assert run(FSAMS(), [before, (clearance, 9.0, 1.0, 3.0)])[1].tolist() == [order, FM, OA, FR]


@given(clearance_sequences)
def test_the_published_rule_has_no_memory(clearances):
    """Without hysteresis and dwell the orders are a function of the clearance of the same step."""
    d = np.array(clearances)
    np.testing.assert_array_equal(run(FSAMS(), clearances), np.where(d <= 2.0, OA, np.where(d <= 4.0, FR, FM)))


@given(clearance_sequences, st.floats(0.0, 0.9), st.integers(0, 20))
def test_dwell_delays_relaxing_and_nothing_else(clearances, hysteresis, dwell_steps):
    """A less urgent state begins at least the dwell after the last change, a more urgent one at the step that requires it."""
    orders = run(FSAMS(hysteresis=hysteresis, dwell=dwell_steps * 0.05), clearances)
    urgency = np.vectorize(URGENCY.get)(orders)
    asked = (np.array(clearances) <= 4.0 - hysteresis).astype(int) + (np.array(clearances) <= 2.0 - hysteresis)
    assert (urgency >= asked).all()
    for agent in urgency.T:
        changes = np.flatnonzero(np.diff(np.concatenate([[0], agent])))
        relaxations = [k for k in changes if k > 0 and agent[k] < agent[k - 1]]
        for k in relaxations:
            last = changes[changes < k].max()
            assert k - last >= dwell_steps


@given(clearance_sequences, st.floats(0.01, 0.9))
def test_hysteresis_needs_the_clearance_to_cross_the_whole_band(clearances, hysteresis):
    """A state is entered at threshold - hysteresis and left above threshold + hysteresis; inside the band it does not change."""
    orders = run(FSAMS(hysteresis=hysteresis), clearances)
    urgency, d = np.vectorize(URGENCY.get)(orders), np.array(clearances)
    before = np.vstack([np.zeros(4, dtype=int), urgency[:-1]])
    for threshold, level in ((4.0, 1), (2.0, 2)):
        entered, left = (urgency >= level) & (before < level), (urgency < level) & (before >= level)
        assert (d[entered] <= threshold - hysteresis).all() and (d[left] > threshold + hysteresis).all()


def test_the_literal_dwell_also_delays_the_urgent_state():
    """With the option ``dwell_delays_urgent``, OA waits too."""
    sequence = [(3.0,) * 4] + [(1.0,) * 4] * 11
    assert run(FSAMS(dwell=0.5), sequence)[1].tolist() == [OA] * 4
    delayed = run(FSAMS(dwell=0.5, dwell_delays_urgent=True), sequence)
    assert (delayed[:10] == FR).all() and (delayed[10:] == OA).all()


@given(clearance_sequences)
def test_an_automaton_is_deterministic_and_leaves_its_memory_alone(clearances):
    """A decision does not change its memory: an old memory can be used again and gives the same orders."""
    supervisor = FSAMS(hysteresis=0.3, dwell=0.5)
    np.testing.assert_array_equal(run(supervisor, clearances), run(supervisor, clearances))
    memory = supervisor.start(PAPER, 1)
    first, _ = supervisor.decide(at(0, clearances[0]), memory)
    second, _ = supervisor.decide(at(0, clearances[0]), memory)
    np.testing.assert_array_equal(first, second)
    assert not memory.state.any()


def test_thresholds_follow_the_scenarios_safe_distance():
    """The automaton uses the scenario's d_OA."""
    scenario = paper(safe_distance=3.0)
    supervisor = FSAMS()
    orders, _ = supervisor.decide(at(0, (3.0, 3.1, 6.0, 6.1)), supervisor.start(scenario, 1))
    assert orders.tolist() == [[OA, FR, FR, FM]]


@pytest.mark.parametrize("name", ["scripted", "fsams", "fsams-hysteresis"])
def test_every_named_supervisor_keeps_the_protocol(name):
    """Orders are (B, N) valid indices."""
    assert name in SUPERVISORS
    supervisor = make_supervisor(name)
    assert isinstance(supervisor, Supervisor)
    orders, _ = supervisor.decide(at(0), supervisor.start(PAPER, 1))
    assert orders.shape == (1, 4) and ((orders >= 0) & (orders < 6)).all()


def test_the_fair_automaton_is_the_published_one_with_hysteresis_and_dwell():
    """The hysteresis is 0.3 m and the dwell 0.5 s."""
    fair = make_supervisor("fsams-hysteresis")
    assert (fair.hysteresis, fair.dwell, fair.dwell_delays_urgent) == (0.3, 0.5, False)
