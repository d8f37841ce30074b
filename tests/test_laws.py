"""Names of gains and state: a law gives the same results on every path, and wrong names are refused with the valid ones."""

import json
import pickle
import subprocess
import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import NamedTuple

import numba
import numpy as np
import pytest

from marlbc_mj.controllers import CONTROLLERS, PD, make_controller
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import Formation
from marlbc_mj.core.compiling import Index
from marlbc_mj.core.disturbances import DISTURBANCES, make_disturbance
from marlbc_mj.engine.world import World
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import paper
from marlbc_mj.util.errors import ConfigurationError

compiled_only = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="laws are plain Python")


@laws.controller(gains={"limit": (), "pull": 2}, state={"count": (), "memory": (2, 3)})
def named(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """Reads and writes numbers, arrays and rows of arrays by name."""
    state.count += 1.0
    for axis in range(2):
        row = state.memory[axis]
        row[2] = p[axis]
        state.memory[axis, 1] += h
        force_out[axis] = laws.clip(gains.pull[axis] * row[2] + state.memory[axis, 1], gains.limit)


@laws.controller(gains=("position_gain", "limit"), state="count")
def misspelled(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """Reads a gain that it does not declare."""
    for axis in range(2):
        force_out[axis] = laws.clip(-gains.positon_gain * p[axis], gains.limit)


@laws.controller(gains=("position_gain", "limit"), state="count")
def forgetful(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """Writes to a state that it does not declare."""
    state.cuont = gains.position_gain
    for axis in range(2):
        force_out[axis] = 0.0


@laws.behavior(gains="gain")
def misspelled_behavior(gains, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """Reads a gain that it does not declare."""
    velocity_out[0] = gains.gian
    return 0


@laws.disturbance(gains=("scale", "strength"))
def misspelled_disturbance(gains, t, p, v, force_out):
    """Reads a gain that it does not declare."""
    force_out[0] = force_out[1] = gains.strenght


@dataclass(frozen=True)
class Own:
    """A user's controller, disturbance or behavior around a law."""

    law: laws.Law
    numbers: laws.Numbers
    limited: bool = True
    linear_gains = None
    name: str = "OWN"
    complete = False

    def params(self, *_):
        return self.numbers

    def initial_state(self, agent):
        return {}


GAINS = {"limit": 100.0, "pull": (2.0, -3.0)}


def run(law, rows=4):
    """Call a controller's team form three times, on rows that are longer than needed; return state and force."""
    gains = np.tile(np.append(laws.pack_gains(named, GAINS), 9.0), (rows, 1))
    state, force = np.full((rows, 8), 0.5), np.full((rows, 2), np.nan)
    places = np.arange(2.0 * rows).reshape(rows, 2)
    for _ in range(3):
        law(gains, state, places, places, places, places, places, 0.1, force)
    return state, force


def test_a_named_law_writes_to_its_row_and_is_the_same_compiled_and_in_python():
    """Numbers, arrays and rows of arrays are written in place; entries beyond the law's own are not changed."""
    results = [run(laws.for_team(law, laws.CONTROLLER)) for law in (named, laws.plain(named))]
    if laws.is_compiled(named):
        results.append(run(named.entry))
    for state, force in results:
        places = np.arange(8.0).reshape(4, 2)
        np.testing.assert_array_equal(state[:, 0], 3.5)
        np.testing.assert_allclose(state[:, 1:7].reshape(4, 2, 3)[..., 1], 0.8, rtol=1e-15)
        np.testing.assert_array_equal(state[:, 1:7].reshape(4, 2, 3)[..., 2], places)
        assert (state[:, 7] == 0.5).all()
        np.testing.assert_allclose(force, places * [2.0, -3.0] + 0.8, rtol=1e-15)
        assert state.tobytes() == results[0][0].tobytes() and force.tobytes() == results[0][1].tobytes()


@compiled_only
def test_names_cost_no_reference_counting_and_leave_the_loops_signature_as_it_is():
    """The team form takes rows of float64, whatever the names."""
    assert laws.address(named, laws.CONTROLLER) != 0
    assert named.entry.signatures == [laws.TEAM_CONTROLLER.args]
    assert named.targetoptions["_nrt"] is named.entry.targetoptions["_nrt"] is False


def test_a_record_is_its_row_and_its_names_travel():
    """Numbers and arrays are written in place, other names are refused, and names can be pickled."""
    names, row = laws.Names.of({"limit": (), "memory": (2, 2)}), np.arange(7.0)
    record = names.view(row)
    record.limit = 8.0
    record.memory[1, 0] += 0.5
    assert row.tolist() == [8.0, 1.0, 2.0, 3.5, 4.0, 5.0, 6.0] and record.memory.shape == (2, 2)
    with pytest.raises(AttributeError, match="'record' object has no attribute 'weight'"):
        _ = record.weight
    with pytest.raises(AttributeError, match="'record' object has no attribute 'weight'"):
        record.weight = 1.0
    assert pickle.loads(pickle.dumps(names)) == names and pickle.loads(pickle.dumps(names)).view(row).limit == 8.0


def test_gains_are_packed_in_the_order_of_their_names():
    """Gains come from a mapping, a NamedTuple, or the fields of an object; a single number fills an array."""

    class Given(NamedTuple):
        pull: tuple[float, float]
        limit: float

    for numbers in (GAINS, Given((2.0, -3.0), 100.0), laws.gains_of(Own(named, ()), limit=100.0, pull=[2.0, -3.0])):
        assert laws.pack_gains(named, numbers).tolist() == [100.0, 2.0, -3.0]
    assert laws.pack_gains(named, {"limit": 1.0, "pull": 7.0}).tolist() == [1.0, 7.0, 7.0]
    assert laws.pack_state(named, {"memory": 2.0}).tolist() == [0.0] + [2.0] * 6
    state = laws.as_state(named, {"memory": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]})
    assert state.memory[1, 0] == 4.0 and state.count == 0.0


@pytest.mark.parametrize(
    ("pack", "numbers", "message"),
    [
        (laws.pack_gains, {"limit": 1.0, "pul": 2.0}, "law 'named' has no gain named 'pul'; its names: limit, pull"),
        (laws.pack_gains, {"limit": 1.0}, "law 'named' lacks the gain 'pull'; its names: limit, pull"),
        (laws.pack_gains, (1.0, 2.0, 3.0), r"law 'named' takes its gains by name, got \(1.0, 2.0, 3.0\); its names: limit, pull"),
        (laws.pack_gains, {"limit": 1.0, "pull": (1, 2, 3)}, r"gain 'pull' of law 'named' has shape \(2,\), got \(3,\)"),
        (laws.pack_state, {"cuont": 1.0}, "law 'named' has no state named 'cuont'; its names: count, memory"),
    ],
)
def test_numbers_that_do_not_fit_the_names_are_refused(pack, numbers, message):
    """Missing, unknown, unnamed, or of the wrong shape; the message has the law, the name and the valid names."""
    with pytest.raises(ConfigurationError, match=message):
        pack(named, numbers)


def test_wrong_names_are_refused_where_a_world_is_made():
    """This holds for each kind of law."""
    with pytest.raises(ConfigurationError, match="law 'named' has no gain named 'gain'; its names: limit, pull"):
        World(paper(), Own(named, {"gain": 1.0}))
    with pytest.raises(ConfigurationError, match="law 'formation' lacks the gain 'slot'; its names: gain, slot"):
        World(paper(behaviors=(Own(Formation.law, {"gain": 1.0}), *paper().behaviors)))
    with pytest.raises(ConfigurationError, match="law 'wind_gusts' lacks the gain 'steady'"):
        World(paper(disturbance=Own(DISTURBANCES["gusts"][0].law, {"scale": 1.0})))
    with pytest.raises(ConfigurationError, match="law 'omni_drive' has no gain named 'weel'; its names: wheel, arm"):
        replace(make_robot("omni"), params={"weel": 1.0}).params_row()


@pytest.mark.parametrize(
    ("law", "wrong"), [(misspelled, "positon_gain"), (forgetful, "cuont"), (laws.plain(misspelled), "positon_gain")]
)
@pytest.mark.parametrize("native", [None, False])
def test_a_law_that_uses_a_name_it_does_not_declare_is_refused(law, wrong, native):
    """Reading and writing, compiled and in plain Python, give the same message, which lists the declared names."""
    message = f"law '{law.__name__}' uses '{wrong}', which it does not declare; gains: position_gain, limit; state: count"
    with pytest.raises(ConfigurationError, match=message):
        World(paper(), Own(law, {"position_gain": 1.0, "limit": 5.0}), native=native).step(np.zeros((1, 4), dtype=int))


def test_behaviors_and_disturbances_that_use_undeclared_names_are_refused():
    """The message is the same, but lists no state."""
    own = Own(misspelled_behavior, {"gain": 1.0})
    with pytest.raises(ConfigurationError, match="law 'misspelled_behavior' uses 'gian', which it does not declare; gains: gain"):
        World(paper(behaviors=(own, *paper().behaviors))).step(np.zeros((1, 4), dtype=int))
    own = Own(misspelled_disturbance, {"scale": 1.0, "strength": 2.0})
    with pytest.raises(
        ConfigurationError, match="'misspelled_disturbance' uses 'strenght', which it does not declare; gains: scale, strength"
    ):
        World(paper(disturbance=own), PD()).step(np.zeros((1, 4), dtype=int))


def test_an_object_without_a_field_for_a_gain_is_refused():
    """``gains_of`` names the missing field."""
    with pytest.raises(
        ConfigurationError, match="law 'named' has a gain 'pull', for which Own has no field; its names: limit, pull"
    ):
        laws.gains_of(Own(named, ()), limit=1.0)


@pytest.mark.parametrize("names", [("twice", "twice"), "two words", ("limit", "size"), {"T": 2}])
def test_names_that_cannot_be_attributes_are_refused(names):
    """Names must be different, valid identifiers, and not attributes of NumPy's records."""
    with pytest.raises(ConfigurationError, match="law"):
        laws.Names.of(names)


def test_a_disturbance_begins_with_its_scale():
    """The first gain must be the scale, which random draws multiply."""
    with pytest.raises(ConfigurationError, match="first gain of a disturbance must be the number 'scale', got strength, scale"):
        laws.disturbance(gains=("strength", "scale"))


def test_a_law_without_names_gets_the_rows():
    """Such a law refuses gains by name, with advice to declare them."""

    @laws.controller
    def bare(params, state, p, v, p_r, v_r, drag, h, force_out):
        force_out[0], force_out[1] = params[0], params[1]

    assert laws.pack_gains(bare, (1.0, 2.0)).tolist() == laws.as_gains(bare, [1.0, 2.0]).tolist() == [1.0, 2.0]
    with pytest.raises(ConfigurationError, match="law 'bare' has no gain named 'x'; its names: none; declare them"):
        laws.pack_gains(bare, {"x": 1.0})
    force = np.zeros((1, 2))
    zero = np.zeros((1, 2))
    laws.for_team(bare, laws.CONTROLLER)(np.array([[1.0, 2.0]]), np.zeros((1, 0)), zero, zero, zero, zero, zero, 0.1, force)
    assert force.tolist() == [[1.0, 2.0]]


def test_laws_made_in_one_place_are_kept_apart():
    """Laws with the same file, line and function name differ by the values in their closures and the names of their gains."""

    def make(value, names):
        @laws.disturbance(gains=names)
        def made(gains, t, p, v, force_out):
            force_out[0] = force_out[1] = value * gains.strength

        return made

    zero, out = np.zeros((1, 2)), np.zeros((1, 2))
    for value, names in ((1.0, ("scale", "strength")), (2.0, ("scale", "strength")), (1.0, ("scale", "other", "strength"))):
        law = make(value, names)
        laws.for_team(law, laws.DISTURBANCE)(np.arange(3.0), 0.0, zero, zero, out)
        assert out[0, 0] == value * names.index("strength")
        if laws.is_compiled(law):
            laws.address(law, laws.DISTURBANCE)
            law.entry(np.arange(3.0), 0.0, zero, zero, out)
            assert out[0, 0] == value * names.index("strength")


@pytest.mark.parametrize("name", CONTROLLERS)
def test_shipped_controllers_give_exactly_the_names_of_their_laws(name):
    """It suffices to pack them, as packing refuses anything else."""
    controller = make_controller(name)
    row = laws.pack_gains(controller.law, controller.params(0, 200.0), laws.CONTROLLER)
    assert row.shape == (laws.interface(controller.law).gains.size,)
    assert laws.pack_state(controller.law, controller.initial_state(0)).shape == (laws.interface(controller.law).state.size,)


@pytest.mark.parametrize("name", DISTURBANCES)
def test_shipped_disturbances_give_exactly_the_names_of_their_laws(name):
    """Their first number is the scale."""
    disturbance = make_disturbance(name, 0.5)
    assert laws.pack_gains(disturbance.law, disturbance.params(), laws.DISTURBANCE)[0] == 0.5


def test_drive_and_reading_of_a_robot_share_their_names():
    """Both use the same rows of gains and state."""
    omni, other = make_robot("omni"), make_robot("diff_drive")
    with pytest.raises(ConfigurationError, match="must declare the same names"):
        replace(omni, reading=other.reading)


SCRIPT = """
import json, sys
import numpy as np
from marlbc_mj.controllers import PD
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import Formation
sys.path.insert(0, sys.argv[1])
import own_law
found = {}
for law, kind in ((PD.law, laws.CONTROLLER), (Formation.law, laws.BEHAVIOR), (own_law.law, laws.CONTROLLER)):
    laws.address(law, kind)
    for name, function in ((law.__name__, law), (law.__name__ + " entry", law.entry)):
        found[name] = sum(function.stats.cache_misses.values())
print(json.dumps(found))
"""
OWN_LAW = """
from marlbc_mj.core import laws

@laws.controller(gains=("gain", "limit"), state={"z": 2})
def law(gains, state, p, v, p_r, v_r, drag, h, force_out):
    for axis in range(2):
        state.z[axis] += h * p[axis]
        force_out[axis] = laws.clip(-gains.gain * state.z[axis], gains.limit)
"""


@compiled_only
def test_a_second_process_compiles_no_law(tmp_path):
    """A shipped controller, a behavior and a user's law come from the cache on disk, as do their entries for the loop."""
    (tmp_path / "own_law.py").write_text(OWN_LAW)
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": ":".join(p for p in sys.path if p)}
    misses = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, env=environment, check=True
        )
        misses.append(json.loads(done.stdout))
    assert set(misses[0].values()) == {1}
    assert set(misses[1].values()) == {0}


def test_a_signature_of_a_type_that_is_gone_hides_no_other(tmp_path, monkeypatch):
    """If a signature has a type of a script, other processes still find their entries, and the script finds its own."""
    index, module = Index(str(tmp_path), "law", 1), ModuleType("a_script")
    monkeypatch.setitem(sys.modules, "a_script", module)
    module.Pair = type("Pair", (), {"__module__": "a_script"})
    index.save((int,), "of int")
    index.save((module.Pair,), "of the script")
    monkeypatch.delitem(sys.modules, "a_script")
    assert index.load((int,)) == "of int" and index.load((module.Pair,)) is None
    index.save((float,), "of float")
    assert [index.load((kind,)) for kind in (int, float)] == ["of int", "of float"]
    monkeypatch.setitem(sys.modules, "a_script", module)
    assert [index.load((kind,)) for kind in (int, module.Pair, float)] == ["of int", "of the script", "of float"]


def test_a_torn_index_begins_anew(tmp_path):
    """A truncated index counts as empty, and new entries are stored."""
    index = Index(str(tmp_path), "law", 1)
    index.save((int,), "of int")
    (tmp_path / "law.nbi").write_bytes((tmp_path / "law.nbi").read_bytes()[:-5])
    assert index.load((int,)) is None
    index.save((int,), "again")
    assert index.load((int,)) == "again"
