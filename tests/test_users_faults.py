"""Users' laws and supervisors that raise errors or return wrong values: one line says where and what."""

import sys
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import pytest

import marlbc_mj.tasks
from marlbc_mj import PD, World, make_controller, make_scenario, measure, paper, run_episode
from marlbc_mj.cli import main
from marlbc_mj.core import laws
from marlbc_mj.supervisors import Blend, make_supervisor
from marlbc_mj.tasks.gymnasium_env import PaperFormation
from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError

JOINT = np.zeros((1, 4), dtype=np.int64)


def plain_law(body: Any) -> Any:
    """A controller law in plain Python that writes ``body(gains, p)`` as the force."""

    def law(gains, state, p, v, p_r, v_r, drag, h, force_out):
        force_out[:] = body(gains, p)

    return law


@dataclass(frozen=True)
class Mine:
    """A controller with parts that may be wrong."""

    law: Any = field(default_factory=lambda: plain_law(lambda gains, p: 0.0))
    limited: Any = True
    linear_gains: Any = None
    gains: Any = ()
    state: Any = ()

    def params(self, agent: int, limit: float) -> Any:
        return self.gains(agent) if callable(self.gains) else self.gains

    def initial_state(self, agent: int) -> Any:
        return self.state(agent) if callable(self.state) else self.state


def broken(*_: Any) -> Any:
    raise KeyError("stiffness")


LAWS = {
    "raises": (Mine(plain_law(broken)), r"law 'law' fails: KeyError: 'stiffness' \(test_users_faults.py, line \d+\)"),
    "returns a text": (Mine(plain_law(lambda gains, p: "left")), "law 'law' fails: ValueError"),
    "another shape": (Mine(plain_law(lambda gains, p: np.zeros(3))), "law 'law' fails: ValueError.*shape"),
    "an index": (Mine(plain_law(lambda gains, p: gains[7])), "law 'law' fails: IndexError"),
    "NaN": (Mine(plain_law(lambda gains, p: np.nan)), "world 0, agent 1, t = 0.000 s: .* not finite"),
    "too large": (Mine(plain_law(lambda gains, p: 1e300)), "world 0, agent 1"),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_law_that_fails_is_named(name):
    """The error names the law, in a World, in Gymnasium and in dm_control; an exception also has its line in the user's file."""
    controller, said = LAWS[name]
    env = PaperFormation(controller=controller, duration=0.5)
    env.reset(seed=0)
    dm = marlbc_mj.tasks.load("formation", "paper", controller=controller, duration=0.5)
    dm.reset()
    for step in (
        lambda: World(paper(duration=0.5), controller).step(JOINT),
        lambda: env.step(JOINT[0]),
        lambda: dm.step(JOINT[0]),
    ):
        with pytest.raises(SimulationError, match=said) as error:
            step()
        assert "\n" not in str(error.value)


PARTS = {
    "nothing": (3, "is not a controller: int lacks law"),
    "no law": (Mine(law=3), "its law is 3"),
    "gains that fail": (Mine(gains=broken), r"controller Mine: params\(\) fails: KeyError: 'stiffness'"),
    "gains that are texts": (Mine(gains=("a",)), "the gains of law 'law' must be numbers"),
    "gains that are a number": (Mine(gains=3.0), "must be names with numbers"),
    "no gains": (Mine(gains=None), "must be names with numbers"),
    "state that fails": (Mine(state=broken), r"controller Mine: initial_state\(\) fails"),
    "unknown gains": (Mine(gains={"stiff": 1.0}), "has no gain named 'stiff'"),
    "linear gains": (Mine(linear_gains=(1.0, 2.0, 3.0)), "controller Mine: linear_gains fails: ValueError"),
}


@pytest.mark.parametrize("name", PARTS)
def test_a_wrong_part_of_a_controller_is_named(name):
    controller, said = PARTS[name]
    with pytest.raises(ConfigurationError, match=said):
        World(paper(duration=0.5), controller)


def test_a_class_in_place_of_what_it_makes():
    with pytest.raises(ConfigurationError, match=r"controller is the class PD; create an instance: PD\(\)"):
        World(paper(duration=0.5), PD)
    with pytest.raises(ConfigurationError, match=r"supervisor is the class Decider; create an instance: Decider\(\)"):
        run_episode(World(paper(duration=0.5), PD(), record=True), Decider)


SETTINGS = {
    "a team": (
        lambda: paper(agents=6),
        "scenario 'paper' has a fixed team of 4 agents; only families such as",
    ),
    "a team by name": (lambda: make_scenario("cruise", agents=6), "scenario 'cruise' has a fixed team of 4 agents"),
    "no field": (lambda: paper(durration=6), "unknown field of a scenario 'durration'; perhaps 'duration'; choose from: name"),
    "a text": (lambda: paper(duration="6"), "scenario 'paper': duration must be a number, got '6'"),
    "a word": (lambda: make_scenario("field", agents="four"), "scenario 'field': agents must be a whole number, got 'four'"),
    "true": (lambda: paper(mass=True), "scenario 'paper': mass must be a number, got True"),
    "starts": (lambda: paper(starts="x"), "scenario 'paper': starts must be numbers, got 'x'"),
    "a name": (lambda: paper(disturbance="wind"), "scenario 'paper': disturbance must be a Disturbance, got 'wind'"),
    "no name": (lambda: make_supervisor(None), "a name must be a string, got NoneType"),
    "an object": (lambda: make_controller(PD()), "a name must be a string, got PD"),
    "no episode": (lambda: measure(None), "measure takes a Trajectory or what read_log returns, got NoneType"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_wrong_setting_is_named(name):
    make, said = SETTINGS[name]
    with pytest.raises(ConfigurationError) as error:
        make()
    assert str(error.value).startswith(said) and "\n" not in str(error.value)


def test_numbers_of_numpy_are_numbers():
    assert paper(duration=np.float32(5.0), mass=np.int64(2)).mission_steps == 100


def test_something_else_than_a_scenario():
    with pytest.raises(ConfigurationError, match="scenario must be a Scenario, got str"):
        World("paper")


@laws.controller(gains=("limit",))
def asserting(gains, state, p, v, p_r, v_r, drag, h, force_out):
    assert p[0] < 1.0
    force_out[0] = gains.limit


@laws.allocation_free
def helper(x):
    if x > 1.0:
        raise ValueError("too far")
    return x


@laws.controller(gains=("limit",))
def helped(gains, state, p, v, p_r, v_r, drag, h, force_out):
    force_out[0] = helper(p[0]) * gains.limit


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
@pytest.mark.parametrize("law", [asserting, helped])
def test_a_compiled_law_cannot_raise(law):
    """Threads would lose the error, so the law is refused before it runs."""
    with pytest.raises(ConfigurationError, match=rf"law '{law.__name__}' raises an error \(test_users_faults.py, line \d+\)"):
        World(paper(duration=0.5), Mine(law, gains={"limit": 1.0}))


@dataclass(frozen=True)
class Decider:
    """A supervisor that may return wrong answers."""

    answer: Any
    memory: Any = 0

    def start(self, scenario: Any) -> Any:
        return self.memory() if callable(self.memory) else self.memory

    def decide(self, observation: Any, memory: Any) -> Any:
        return self.answer() if callable(self.answer) else self.answer


ORDERS = np.zeros(4, dtype=np.int64)
ANSWERS = {
    "raises": (
        Decider(broken),
        r"supervisor Decider: decide\(\) fails: KeyError: 'stiffness' \(test_users_faults.py, line \d+\)",
    ),
    "leaves": (Decider(lambda: sys.exit(5)), r"it calls sys.exit\(5\)"),
    "fails at the start": (Decider(0, broken), r"supervisor Decider: start\(\) fails: KeyError"),
    "nothing": (Decider(None), r"must return \(orders, memory\), got NoneType"),
    "orders alone": (Decider(ORDERS), "got ndarray"),
    "three": (Decider((ORDERS, 0, 0)), "got tuple"),
    "a blend alone": (Decider(Blend(ORDERS, np.zeros((4, 2)))), "got Blend"),
    "a list": (Decider(([0, 0, 0, 0], 0)), "array of integers"),
    "a name": (Decider(("FM", 0)), "array of integers"),
    "names": (Decider((["FM", "FM", "OA>FM", "FR"], 0)), "got list of names; scenario.orders.index gives the number of a name"),
    "names in an array": (
        Decider((np.array(["FM"] * 4), 0)),
        "got <U2 of names; scenario.orders.index gives the number of a name",
    ),
    "an attribute that is not there": (Decider(lambda: np.nothing), r"decide\(\) fails: AttributeError"),
    "too few": (Decider((ORDERS[:3], 0)), "shape"),
    "no order": (Decider((ORDERS + 99, 0)), "indices from 0 to"),
    "NaN": (Decider((Blend(ORDERS, np.full((4, 2), np.nan)), 0)), "velocity must be finite"),
    "huge": (Decider((Blend(ORDERS, np.full((4, 2), 1e300)), 0)), "below 1e[+]09 m/s, got 1e[+]300 for world 0, agent 1"),
    "other velocities": (Decider((Blend(ORDERS, np.zeros(3)), 0)), "velocities must have shape"),
    "velocities that are texts": (Decider((Blend(ORDERS, np.full((4, 2), "x")), 0)), "velocity must be numbers"),
    "no supervisor": (3, "int lacks start, decide"),
}


@pytest.mark.parametrize("name", ANSWERS)
def test_a_supervisor_that_fails_is_named(name):
    supervisor, said = ANSWERS[name]
    with pytest.raises(MarlbcError, match=said) as error:
        run_episode(World(paper(duration=0.5), PD(), record=True), supervisor)
    assert "\n" not in str(error.value)


def test_an_episode_needs_every_substep():
    with pytest.raises(ConfigurationError, match="record=True"):
        run_episode(World(paper(duration=0.5), PD()), make_supervisor("fixed"))


FILE = """
import numpy as np
class Late:
    def start(self, scenario):
        return 0
    def decide(self, observation, memory):
        if memory == 3:
            raise RuntimeError("no plan\\nat all")
        return np.zeros(4, dtype=np.int64), memory + 1
class Wrong(Late):
    def decide(self, observation, memory):
        return None
"""


@pytest.mark.parametrize(("name", "status"), [("Late", 3), ("Wrong", 2)])
def test_the_command_line_says_it_in_one_line(tmp_path, capsys, name, status):
    (tmp_path / "mine.py").write_text(FILE)
    line = ["run", "paper", "--supervisor", f"{tmp_path}/mine.py:{name}", "--controller", "pd", "--duration", "0.5"]
    with pytest.raises(SystemExit) as stopped:
        main([*line, "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err.strip()
    assert stopped.value.code == status and len(said.splitlines()) == 1
    assert status == 2 or "RuntimeError: no plan at all (mine.py, line 8)" in said
