"""A trained team as an ONNX file, for computers that have an ONNX runtime and no Python; needs the ``onnx`` extra."""

import json
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.checkpoint import read_policy
from marlbc_mj.policies.greedy import SLACK, Policy
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import staged_file

OPSET = 17
"""Of the operators: ONNX 1.12 (2022) and everything since run it."""
IR = 8
"""Version of the file format that goes with it."""


def export_policy(checkpoint: Path, out: Path, *, overwrite: bool = False) -> str:
    """Write a checkpoint's policy as ONNX; returns one line that says what goes in and what comes out.

    Inputs are ``state`` (batch, S) float32, of the kind that the signature names, and ``last`` (batch, N) int64, the actions in
    force; a row with a negative entry has none. Outputs are ``values`` (batch, N, A) float32 as ``Policy.values`` gives them,
    minus infinity for actions that are too risky, and ``orders`` (batch, N) int64 as ``policy.greedy`` chooses: indices into the
    action set, the last action unless the best is better by more than the margin. A network over joint actions has ``values``
    (batch, 1, A^N).

    The file's metadata are texts: ``signature`` (JSON, what the policy is tied to), ``actions`` (JSON, the order that each index
    stands for), ``margin`` and ``risk``.

    Raises:
        ConfigurationError: no ``onnx`` package, no checkpoint, or ``out`` is there already.
    """
    onnx = _onnx()
    policy, description = read_policy(checkpoint)
    try:
        signature, scenario = description["signature"], make_scenario(description["train"]["scenario"])
        agents, names = int(signature["agents"]), scenario.orders.names
        actions = [names[k] for k in order_of(scenario, signature["actions"])]
    except (KeyError, TypeError) as error:
        raise ConfigurationError(f"checkpoint {checkpoint} does not say what it was trained for: no {error}") from None
    metadata = {
        "signature": json.dumps(signature),
        "actions": json.dumps(actions),
        "margin": repr(policy.margin),
        "risk": repr(policy.risk),
    }
    model = build(policy, agents, metadata, onnx)
    with staged_file(out, overwrite=overwrite) as staging:
        staging.write_bytes(model.SerializeToString())
    networks, values = policy.weights[-1].shape[0], policy.columns
    return (
        f"{out}: state (batch, {len(policy.scale)}) and last (batch, {agents}) give "
        f"values (batch, {networks}, {values}) and orders (batch, {agents})"
    )


def _onnx() -> ModuleType:
    """The optional package.

    Raises:
        ConfigurationError: it is not installed.
    """
    try:
        return import_module("onnx")
    except ImportError:
        raise ConfigurationError("marlbc export needs the onnx package: pip install 'marlbc-mj[onnx]'") from None


class _Graph:
    """Nodes and constants in the making; every method returns the name of a result."""

    def __init__(self, onnx: ModuleType) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, kind: type = np.float32) -> str:
        name = f"constant{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(value, dtype=kind), name))
        return name

    def whole(self, *value: int) -> str:
        return self.constant(np.array(value), np.int64)

    def add(self, operator: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        name = name or f"{operator.lower()}{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, list(inputs), [name], name=f"node_{name}", **attributes))
        return name

    def columns(self, x: str, first: int, end: int) -> str:
        return self.add("Slice", x, self.whole(first), self.whole(end), self.whole(-1))


def build(policy: Policy, agents: int, metadata: dict[str, str], onnx: ModuleType) -> Any:
    """The ``onnx.ModelProto`` of a policy of ``agents``, checked; see :func:`export_policy`."""
    graph, helper, kinds = _Graph(onnx), onnx.helper, onnx.TensorProto
    values = _values(graph, policy)
    _greedy(graph, policy, values, agents)
    networks = policy.weights[-1].shape[0]
    made = helper.make_graph(
        graph.nodes,
        "policy",
        [
            helper.make_tensor_value_info("state", kinds.FLOAT, ["batch", len(policy.scale)]),
            helper.make_tensor_value_info("last", kinds.INT64, ["batch", agents]),
        ],
        [
            helper.make_tensor_value_info("values", kinds.FLOAT, ["batch", networks, policy.columns]),
            helper.make_tensor_value_info("orders", kinds.INT64, ["batch", agents]),
        ],
        graph.constants,
    )
    model = helper.make_model(made, producer_name="marlbc_mj", opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    return model


def _values(graph: _Graph, policy: Policy) -> str:
    """:meth:`Policy.values`: (batch, N, A)."""
    y = graph.add("Unsqueeze", graph.add("Div", "state", graph.constant(policy.scale)), graph.whole(0))
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        y = graph.add("Relu", y) if k else y
        y = graph.add("Add", graph.add("MatMul", y, graph.constant(weight)), graph.constant(bias))
    y = graph.add("Transpose", y, perm=[1, 0, 2])
    actions, first = policy.columns, int(policy.dueling)
    end = first + actions
    values = graph.columns(y, first, end)
    if policy.dueling:
        mean = graph.add("ReduceMean", values, axes=[-1], keepdims=1)
        values = graph.add("Sub", graph.add("Add", graph.columns(y, 0, 1), values), mean)
    if not policy.risk:
        return graph.add("Identity", values, name="values")
    risks = graph.add("Sigmoid", graph.columns(y, end, end + actions))
    least = graph.add("ReduceMin", risks, axes=[-1], keepdims=1)
    low = graph.add("LessOrEqual", risks, graph.constant(policy.risk))
    lowest = graph.add("LessOrEqual", risks, graph.add("Add", least, graph.constant(SLACK)))
    return graph.add("Where", graph.add("Or", low, lowest), values, graph.constant(-np.inf), name="values")


def _greedy(graph: _Graph, policy: Policy, values: str, agents: int) -> None:
    """:func:`marlbc_mj.policies.greedy.greedy`: (batch, N) ``orders`` from ``values`` and ``last``."""
    joint = policy.weights[-1].shape[0] != agents
    fresh = graph.add("Less", graph.add("ReduceMin", "last", axes=[-1], keepdims=1), graph.whole(0))
    kept = graph.add("Max", "last", graph.whole(0))
    if joint:  # actions of the agents are digits of the joint one
        each = round(policy.columns ** (1 / agents))
        strides = graph.whole(*(each ** (agents - 1 - i) for i in range(agents)))
        kept = graph.add("ReduceSum", graph.add("Mul", kept, strides), graph.whole(-1), keepdims=1)
    best = graph.add("ArgMax", values, axis=-1, keepdims=1)
    lead = graph.add(
        "Sub",
        graph.add("GatherElements", values, best, axis=2),
        graph.add("GatherElements", values, graph.add("Unsqueeze", kept, graph.whole(2)), axis=2),
    )
    ahead = graph.add("Greater", graph.add("Squeeze", lead, graph.whole(2)), graph.constant(policy.margin))
    chosen = graph.add("Squeeze", best, graph.whole(2))
    chosen = graph.add("Where", graph.add("Or", ahead, fresh), chosen, kept)
    if joint:
        chosen = graph.add("Mod", graph.add("Div", chosen, strides), graph.whole(each))
    graph.add("Identity", chosen, name="orders")
