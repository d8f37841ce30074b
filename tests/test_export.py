"""Exported policies: an ONNX runtime computes what NumPy does."""

import itertools
import json
import sys

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import signature, write_policy
from marlbc_mj.policies.greedy import Policy, greedy
from marlbc_mj.policies.states import make_state
from marlbc_mj.scenarios import paper
from marlbc_mj.training.config import TrainConfig

pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")

AGENTS, ACTIONS = 4, 4
SIZE = make_state("extended", paper()).size


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
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return runtime.InferenceSession(str(out), options, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("worlds", [1, 200])
@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("risk", [0.0, 0.3])
@pytest.mark.parametrize("dueling", [False, True])
def test_a_runtime_gives_the_policys_values_and_orders(dueling, risk, joint, worlds, tmp_path):
    networks, actions = (1, ACTIONS**AGENTS) if joint else (AGENTS, ACTIONS)
    policy = random_policy(dueling, risk, networks=networks, actions=actions)
    session = export(policy, tmp_path)
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


def test_the_file_says_what_it_is_for(tmp_path, capsys):
    session = export(random_policy(True, 0.1), tmp_path, actions="avoidance")
    said = session.get_modelmeta().custom_metadata_map
    assert json.loads(said["signature"]) == signature(paper(), "extended", "avoidance", 10)
    assert [name.split(">")[0] for name in json.loads(said["actions"])] == ["FM", "OA"]
    assert float(said["margin"]) == 1.1 and float(said["risk"]) == 0.1
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
