"""Policy checkpoints are read back as they were written; unusable ones are refused with a one-line error."""

import itertools
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save_file

from marlbc_mj.policies.checkpoint import FORMAT, read_arrays, read_policy, signature, write_arrays, write_policy
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.policies.states import make_state
from marlbc_mj.scenarios import Perturbation, paper
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.util.errors import ConfigurationError

SIZE = make_state("extended", paper()).size


def policy_of(networks=4, actions=4, size=SIZE, hidden=(3,), dueling=True, risk=0.4):
    rng = np.random.default_rng(0)
    sizes = [size, *hidden, dueling + actions * (2 if risk else 1)]
    weights = tuple(rng.normal(size=(networks, a, b)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    biases = tuple(rng.normal(size=(networks, 1, b)).astype(np.float32) for b in sizes[1:])
    return Policy(weights, biases, np.ones(size, np.float32), dueling, 0.1, risk)


def signed(**changes):
    return {"signature": {**signature(paper(), "extended", "commands", 10), **changes}}


def refusal(use):
    with pytest.raises(ConfigurationError) as error:
        use()
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_policy_is_read_as_it_was_written(tmp_path):
    path, policy = tmp_path / "p.safetensors", policy_of()
    write_policy(path, policy, signed())
    found, description = read_policy(path)
    for a, b in zip((*policy.weights, *policy.biases, policy.scale), (*found.weights, *found.biases, found.scale), strict=True):
        assert a.dtype == b.dtype and np.array_equal(a, b)
    assert found[3:] == policy[3:]
    assert description["signature"] == signed()["signature"] and description["format"] == FORMAT
    Learned.load(path).start(paper(), 1)


@pytest.mark.parametrize("folded", [False, True])
def test_a_changed_bit_is_refused_anywhere(tmp_path, folded):
    """The bit may be in the arrays or in the header, even if it only changes a letter's case (``folded``)."""
    path = tmp_path / "p.safetensors"
    write_arrays(
        path, {"x": np.arange(3, dtype=np.float32)}, {"margin": 1e-7, "name": "\u00e9", "rows": [1.5e300, -2, True, None]}
    )
    content = path.read_bytes()
    read_arrays(path)
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 0x20 if folded else 1 << (place % 8)
        path.write_bytes(changed)
        assert str(path) in refusal(lambda: read_arrays(path)), place


def arrays_of(policy):
    named = {f"weight{k}": w for k, w in enumerate(policy.weights)} | {f"bias{k}": b for k, b in enumerate(policy.biases)}
    return {**named, "scale": policy.scale}


SAID = {"dueling": True, "margin": 0.1, "risk": 0.4}
ARRAYS = {
    "float64": (lambda a: {**a, "weight0": a["weight0"].astype(np.float64)}, "weight0 is float64"),
    "complex": (lambda a: {**a, "scale": a["scale"].astype(np.complex64)}, "scale is complex64"),
    "whole numbers": (lambda a: {**a, "bias1": a["bias1"].astype(np.int32)}, "bias1 is int32"),
    "not finite": (lambda a: {**a, "bias0": np.inf * a["bias0"]}, "bias0 is not finite"),
    "no chain": (lambda a: {**a, "weight1": a["weight1"][:, :2]}, "do not chain"),
    "other networks": (lambda a: {**a, "weight1": a["weight1"][:3], "bias1": a["bias1"][:3]}, "do not chain"),
    "short scale": (lambda a: {**a, "scale": a["scale"][:-1]}, "do not chain"),
    "no scale": (lambda a: {name: x for name, x in a.items() if name != "scale"}, "networks of a policy"),
    "zero scale": (lambda a: {**a, "scale": 0 * a["scale"]}, "scale is not positive"),
    "bias": (lambda a: {**a, "bias0": a["bias0"][:, 0]}, "biases"),
    "flat": (lambda a: {**a, "weight0": a["weight0"][0]}, "weights"),
    "odd outputs": (lambda a: {**a, "weight1": a["weight1"][..., :-1], "bias1": a["bias1"][..., :-1]}, "8 outputs"),
    "more": (lambda a: {**a, "table": np.zeros(3)}, "table"),
    "gap": (lambda a: {("weight2" if n == "weight1" else n): x for n, x in a.items()}, "networks of a policy"),
    "nothing": (lambda a: {"scale": a["scale"]}, "arrays scale"),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_that_are_no_policy_are_named(kind, tmp_path):
    path, (change, fragment) = tmp_path / "p.safetensors", ARRAYS[kind]
    write_arrays(path, change(arrays_of(policy_of())), {**SAID, **signed()})
    assert fragment in refusal(lambda: read_policy(path))


def test_types_that_numpy_does_not_have_are_one_line(tmp_path):
    path = tmp_path / "p.safetensors"
    header = json.dumps({"x": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    assert str(path) in refusal(lambda: read_policy(path))


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5_000, "[]", "null", '{"format": 2}', '{"format": 1, "sha256": ""}'])
def test_headers_of_another_kind_are_one_line(text, tmp_path):
    path = tmp_path / "p.safetensors"
    save_file({"x": np.zeros(3, np.float32)}, path, {"marlbc_mj": text})
    assert str(path) in refusal(lambda: read_policy(path))


@pytest.mark.parametrize(
    ("description", "fragment"),
    [
        ({**SAID}, "no signature"),
        ({**SAID, "signature": []}, "no signature"),
        ({**SAID, **signed(interval=0)}, "interval = 0"),
        ({**SAID, **signed(interval=True)}, "interval = True"),
        ({**SAID, **signed(interval="10")}, "interval = '10'"),
        ({**SAID, **signed(state="pixels")}, "state = 'pixels', not one of published, extended"),
        ({**SAID, **signed(actions="all")}, "actions = 'all', not one of commands"),
        ({**SAID, **signed(agents=None)}, "agents = None"),
        ({**SAID, **signed(safe_distance=None)}, "safe_distance = None"),
        ({**SAID, "risk": 2.0, **signed()}, "risk 2.0"),
        ({**SAID, "margin": "wide", **signed()}, "networks of a policy"),
        ({**SAID, "margin": "nan", **signed()}, "margin is nan"),
        ({**SAID, "margin": 10**400, **signed()}, "networks of a policy"),
        ({**SAID, "dueling": False, **signed()}, "9 outputs"),
    ],
)
def test_descriptions_of_another_kind_are_named(description, fragment, tmp_path):
    path = tmp_path / "p.safetensors"
    write_arrays(path, arrays_of(policy_of()), description)
    assert fragment in refusal(lambda: read_policy(path))


def test_a_signature_says_all_or_it_is_refused(tmp_path):
    """Each entry of the signature is required."""
    whole = signed()["signature"]
    for name in whole:
        path = tmp_path / "p.safetensors"
        write_policy(path, policy_of(), {"signature": {key: value for key, value in whole.items() if key != name}})
        assert f"{name} = None" in refusal(lambda: read_policy(path))  # noqa: B023  # called at once


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"mission_step": 0.1}, "mission_step = 0.05"),
        ({"path_velocity": (2.0, 0.0)}, "path_velocity = [1.0, 0.0]"),
        ({"safe_distance": 1.5}, "safe_distance = 2.0"),
        ({"formation_tolerance": 0.6}, "formation_tolerance = 0.5"),
        ({"reference": "actual"}, "reference = virtual"),
    ],
)
def test_what_a_policy_depends_on_must_be_the_same(changes, name, tmp_path):
    write_policy(tmp_path / "p.safetensors", policy_of(), signed())
    learned = Learned.load(tmp_path / "p.safetensors")
    assert name in refusal(lambda: learned.start(replace(paper(), **changes), 1))


def test_policy_accepts_scenario_changes(tmp_path):
    """Obstacles, starts, drag and duration may differ from those of training."""
    write_policy(tmp_path / "p.safetensors", policy_of(), signed())
    learned = Learned.load(tmp_path / "p.safetensors")
    for changes in ({"obstacles": ((5.0, 0.0, 1.0),)}, {"perturbation": Perturbation(1.0, 0.5, (0.0, 5.0))}, {"duration": 20.0}):
        assert learned.start(paper(**changes), 1).actions.shape == (1, 4)


@pytest.mark.parametrize(
    ("policy", "changes", "fragment"),
    [
        (policy_of(size=SIZE - 1), {}, f"{SIZE - 1} numbers"),
        (policy_of(networks=3), {}, "3 networks with 4 values"),
        (policy_of(actions=5), {}, "4 networks with 5 values"),
        (policy_of(networks=1), {}, "1 with 256"),
        (policy_of(), {"actions": "orders"}, "6 actions"),
        (policy_of(), {"layout": {"version": 0, "size": SIZE}}, "layout"),
    ],
)
def test_networks_that_do_not_fit_their_signature_are_refused(policy, changes, fragment, tmp_path):
    write_policy(tmp_path / "p.safetensors", policy, signed(**changes))
    learned = Learned.load(tmp_path / "p.safetensors")
    assert fragment in refusal(lambda: learned.start(paper(), 1))


def test_one_network_of_joint_actions_fits(tmp_path):
    write_policy(tmp_path / "p.safetensors", policy_of(networks=1, actions=256, risk=0.0), signed())
    Learned.load(tmp_path / "p.safetensors").start(paper(), 1)
