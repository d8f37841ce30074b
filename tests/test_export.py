"""Exported policies: an ONNX runtime computes what NumPy does."""

import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from test_general import random_policy as random_general

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import read_policy, signature, write_policy
from marlbc_mj.policies.general import Sensed, agree, lead_of_column, mean_policy, write_general
from marlbc_mj.policies.general_inputs import FEATURES, INPUT_LAYOUT, SENT, WAYS
from marlbc_mj.policies.greedy import Policy, greedy
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.policies.states import make_state
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import LEARNED
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.export import IR, OPSET

AGENTS, ACTIONS = 4, 4
SIZE = make_state("extended", paper()).size


@pytest.fixture(scope="module", autouse=True)
def libraries():
    """Loaded where these tests run, instead of in every process that collects them."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)


def session_of(path):
    """An exported policy as a runtime on one thread has it."""
    runtime = pytest.importorskip("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def random_policy(dueling, risk, margin=1.1, networks=AGENTS, actions=ACTIONS, hidden=(16, 12), seed=0):
    rng = np.random.default_rng(seed)
    sizes = [SIZE, *hidden, dueling + actions * (2 if risk else 1)]
    weights = tuple(rng.normal(0, 1.5 / np.sqrt(a), (networks, a, b)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    biases = tuple(rng.normal(0, 0.5, (networks, 1, b)).astype(np.float32) for b in sizes[1:])
    return Policy(weights, biases, rng.uniform(0.5, 2.0, SIZE).astype(np.float32), dueling, margin, risk)


def export(policy, folder, actions="commands"):
    checkpoint, out = folder / "policy.safetensors", folder / "policy.onnx"
    write_policy(checkpoint, policy, {"signature": signature(paper(), "extended", actions, 10), "train": TrainConfig()})
    main(["export", str(checkpoint), str(out)])
    return session_of(out)


@pytest.mark.slow
@pytest.mark.parametrize(  # any two of the three in all four ways
    ("dueling", "risk", "joint"), [(False, 0.0, False), (False, 0.3, True), (True, 0.0, True), (True, 0.3, False)]
)
def test_a_runtime_gives_the_policys_values_and_orders(dueling, risk, joint, tmp_path):
    """For one team, and for more teams at once than the graph was traced with."""
    networks, actions = (1, ACTIONS**AGENTS) if joint else (AGENTS, ACTIONS)
    policy = random_policy(dueling, risk, networks=networks, actions=actions)
    session = export(policy, tmp_path)
    for worlds in (1, 200):
        rng = np.random.default_rng(1)
        states = rng.normal(size=(worlds, SIZE)).astype(np.float32)
        last, fresh = rng.integers(ACTIONS, size=(worlds, AGENTS)), np.arange(worlds) % 5 == 4
        values, orders = session.run(["values", "orders"], {"state": states, "last": np.where(fresh[:, None], -1, last)})
        expected = policy.values(states)
        assert values.shape == expected.shape and values.dtype == np.float32
        np.testing.assert_array_equal(np.isneginf(values), np.isneginf(expected))
        np.testing.assert_allclose(values, expected, atol=1e-5)
        assert orders.dtype == np.int64
        np.testing.assert_array_equal(orders, greedy(expected, last, fresh, policy.margin))
        assert np.isneginf(values).any() == (risk > 0)
        if worlds > 1:
            assert (orders != greedy(expected, last, fresh, 0.0)).any() and (orders[~fresh] != last[~fresh]).any()


@pytest.mark.parametrize("name", LEARNED)
def test_a_shipped_policy_is_exported_as_it_flies(name, tmp_path):
    """Every kind of checkpoint that comes with the package, on states of flight."""
    policy, _ = read_policy(shipped(name))
    out = tmp_path / "policy.onnx"
    main(["export", str(shipped(name)), str(out)])
    session = session_of(out)
    rng = np.random.default_rng(2)
    states = rng.uniform(-1.0, 1.0, (500, len(policy.scale))).astype(np.float32)
    last, fresh = rng.integers(policy.columns, size=(500, AGENTS)), rng.random(500) < 0.1
    values, orders = session.run(["values", "orders"], {"state": states, "last": np.where(fresh[:, None], -1, last)})
    expected = policy.values(states)
    finite = np.isfinite(expected)
    assert (finite == np.isfinite(values)).mean() > 0.999  # risks at the limit may round either way
    both = finite & np.isfinite(values)
    np.testing.assert_allclose(values[both], expected[both], rtol=1e-4, atol=1e-4)
    assert (orders == greedy(expected, last, fresh, policy.margin)).mean() > 0.999


@pytest.mark.parametrize(
    ("flown", "networks", "actions"),
    [
        ({"dwell": 1, "consensus": False}, 1, 2),
        ({"dwell": 3, "deadline": 1.0, "consensus": True}, 5, 2),
        ({"consensus": True}, 2, 4),
    ],
)
def test_the_general_policy_is_exported_as_it_decides(flown, networks, actions, tmp_path):
    """One graph for every team size, of one network and of a mean; some agents have not heard others, some are alone."""
    policy = mean_policy([random_general(k, actions=actions) for k in range(networks)], 0.1)._replace(**flown)
    checkpoint, out, rng = tmp_path / "agent.safetensors", tmp_path / "agent.onnx", np.random.default_rng(3)
    write_general(checkpoint, policy, {})
    main(["export", str(checkpoint), str(out)])
    session = session_of(out)
    assert json.loads(session.get_modelmeta().custom_metadata_map["layout"]) == INPUT_LAYOUT
    for teams, agents in ((1, 4), (7, 9), (2, 1)):
        features = rng.normal(size=(teams, agents, FEATURES)).astype(np.float32)
        features[..., WAYS:] = rng.uniform(0.0, 1.0, size=features[..., WAYS:].shape)
        heard = rng.normal(size=(teams, agents, agents, SENT)).astype(np.float32)
        age = np.where(rng.random((teams, agents, agents)) < 0.3, np.inf, rng.uniform(0.0, 5.0, (teams, agents, agents)))
        last, fresh = rng.integers(actions, size=(teams, agents)), np.arange(teams) % 2 == 1
        rows, itself = teams * agents, np.eye(agents, dtype=bool)
        leads, lead_age = 9.0 * rng.normal(size=age.shape).astype(np.float32), rng.uniform(0.0, 2.0, age.shape).astype(np.float32)
        given = {
            "features": features.reshape(rows, -1),
            "heard": heard.reshape(rows, agents, -1),
            "age": age.reshape(rows, agents).astype(np.float32),
            "lead": leads.reshape(rows, agents),
            "lead_age": np.where(itself, np.inf, lead_age).astype(np.float32).reshape(rows, agents),
            "last": np.where(fresh[:, None], -1, last).reshape(rows),
        }
        values, own, action = session.run(["values", "own_lead", "action"], given)
        expected = policy.evaluate(features, heard, age)
        np.testing.assert_allclose(values, expected.reshape(rows, -1), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(own, lead_of_column(expected).reshape(rows), rtol=1e-4, atol=1e-3)
        known = np.where(itself, lead_of_column(expected)[:, :, None], leads).astype(np.float32)
        agreed = agree(expected, known, np.where(itself, 0.0, lead_age)) if policy.consensus else expected
        decided = policy.decide(Sensed(features, last, fresh), agreed)
        np.testing.assert_array_equal(action.reshape(teams, agents), decided)


def test_the_file_says_what_it_is_for(tmp_path, capsys):
    session = export(random_policy(True, 0.1), tmp_path, actions="avoidance")
    said = session.get_modelmeta().custom_metadata_map
    assert json.loads(said["signature"]) == signature(paper(), "extended", "avoidance", 10)
    assert [name.split(">")[0] for name in json.loads(said["actions"])] == ["FM", "OA"]
    assert float(said["margin"]) == 1.1 and float(said["risk"]) == 0.1
    model = pytest.importorskip("onnx").load(tmp_path / "policy.onnx")
    assert (model.ir_version, [one.version for one in model.opset_import]) == (IR, [OPSET])
    assert str(Path(__file__).parents[1]).encode() not in model.SerializeToString()  # nor any other path of this computer
    line = capsys.readouterr().out
    assert line.count("\n") == 1 and f"state (batch, {SIZE})" in line and "orders (batch, 4)" in line


@pytest.mark.parametrize("case", ["no onnx", "no checkpoint", "file there", "no scenario"])
def test_what_cannot_be_exported_is_one_line(case, tmp_path, monkeypatch, capsys):
    checkpoint, out = tmp_path / "policy.safetensors", tmp_path / "policy.onnx"
    found = {"signature": signature(paper(), "extended", "commands", 10), "train": TrainConfig()}
    if case != "no checkpoint":
        write_policy(checkpoint, random_policy(True, 0.0), found if case != "no scenario" else {"signature": found["signature"]})
    if case == "file there":
        out.write_bytes(b"mine")
    if case == "no onnx":
        monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(SystemExit) as stopped:
        main(["export", str(checkpoint), str(out)])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    fragment = {"no onnx": "marlbc-mj[onnx]", "no checkpoint": "policy.safetensors", "file there": "--overwrite"}
    assert said.count("\n") == 1 and fragment.get(case, "trained for") in said
    assert out.exists() == (case == "file there")
