"""Export of a trained policy as an ONNX file, for computers with an ONNX runtime but no Python; needs the ``onnx`` extra.

torch writes the graph from the network class used in training, so networks are defined once only. The general policy's pooling
of received messages is implemented twice, in NumPy for the supervisor and in torch here; a test checks that they agree.
"""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.checkpoint import read_policy
from marlbc_mj.policies.general import (
    COLUMN_ACTION,
    FORMATION,
    INTERVAL,
    MOTIONS,
    GeneralPolicy,
    is_general,
    may_change,
    must_return,
    read_general,
)
from marlbc_mj.policies.general_inputs import AGE_ENTRIES, COARSE, ENDING, FEATURES, INPUT_LAYOUT, MOST_BEYOND, SENT, WAYS
from marlbc_mj.policies.greedy import Policy, takes_best
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.training.general.rivals import by_motion
from marlbc_mj.training.networks import NetworkSize, TeamNetwork, mask_risky
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import check_target, staged_file

OPSET = 18
"""Version of the ONNX operator set: ONNX 1.13 (2022) and later support it. torch's exporter writes no older one."""
IR = 8
"""Version of the ONNX file format that belongs to ``OPSET``."""


def export_policy(checkpoint: Path, out: Path, *, overwrite: bool = False) -> str:
    """Write a checkpoint's policy as ONNX; returns one line that describes the inputs and outputs.

    The policy of one team: inputs are ``state`` (batch, S) float32, of the kind that the signature names, and ``last`` (batch, N)
    int64, the actions in force; a negative entry in a row means that there are none. Outputs are ``values`` (batch, N, A) float32
    as returned by ``Policy.values``, minus infinity for actions that are too risky, and ``orders`` (batch, N) int64 as chosen by
    :func:`marlbc_mj.policies.greedy.greedy`: indices into the action set, the last action unless the best action's value is
    higher by more than the margin. A network over joint actions has ``values`` (batch, 1, A^N). The metadata are texts:
    ``signature`` (JSON: the team, state and actions that the policy was trained for), ``actions`` (JSON: the order that each
    index stands for), ``margin`` and ``risk``.

    The general policy, for one agent: inputs are ``features`` (batch, F) float32, sensed by the agent itself; ``heard``
    (batch, agents, M) float32, the last vector received from each agent (the first M of its F features), including the agent's
    own; ``age`` (batch, agents) float32, the age of these vectors in settling times, infinite where none was received; ``last``
    (batch,) int64, the action in force, negative for none. Outputs are ``values`` (batch, A) and ``action`` (batch,):
    0 formation, 1 column; for a policy that also decides about avoidance, 2 and 3 are the same with avoidance on top. The
    metadata are ``layout`` (JSON: the meaning of a vector's entries), ``interval`` (between decisions, in settling times),
    ``actions``, ``margin``, ``dwell`` (decisions for which an agent keeps a new order, measured by the order's age among its
    features) and ``deadline``, see :class:`~marlbc_mj.policies.general.GeneralPolicy`.

    Args:
        checkpoint: file of the checkpoint.
        out: ONNX file to write.
        overwrite: whether an existing file may be replaced.

    Raises:
        ConfigurationError: the ``onnx`` extra is not installed, there is no valid checkpoint, or ``out`` exists already.
    """
    _need_packages()
    check_target(out, overwrite=overwrite)
    model, says = _general_model(checkpoint) if is_general(checkpoint) else _team_model(checkpoint)
    with staged_file(out, overwrite=overwrite) as staging:
        staging.write_bytes(model.SerializeToString())
    return f"{out}: {says}"


def _team_model(checkpoint: Path) -> tuple[Any, str]:
    """The ONNX model of one team's policy, and a description of its inputs and outputs."""
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
    networks, values = policy.weights[-1].shape[0], policy.columns
    return build(policy, agents, metadata), (
        f"state (batch, {len(policy.scale)}) and last (batch, {agents}) give "
        f"values (batch, {networks}, {values}) and orders (batch, {agents})"
    )


def _general_model(checkpoint: Path) -> tuple[Any, str]:
    """The ONNX model of one agent's general policy, and a description of its inputs and outputs."""
    policy, _ = read_general(checkpoint)
    metadata = {
        "layout": json.dumps(INPUT_LAYOUT),
        "interval": repr(INTERVAL),
        "actions": json.dumps(["formation", "column", "avoid, formation", "avoid, column"][: policy.actions]),
        "margin": repr(policy.network.margin),
        "dwell": repr(policy.dwell),
        "deadline": repr(policy.deadline),
        "consensus": json.dumps(policy.consensus),
    }
    return build_general(policy, metadata), (
        f"features (batch, {FEATURES}), heard (batch, agents, {SENT}), age, lead and lead_age (batch, agents) and last (batch,) "
        f"give values (batch, {policy.actions}), own_lead (batch,) and action (batch,)"
    )


def _need_packages() -> None:
    """Raise ConfigurationError if an optional package is not installed."""
    for name in ("onnx", "onnxscript"):
        try:
            import_module(name)
        except ImportError:
            raise ConfigurationError(f"marlbc export needs the {name} package: pip install 'marlbc-mj[onnx]'") from None


def _as_modules(policy: Policy) -> TeamNetwork:
    """The networks of a policy as a torch module."""
    size = NetworkSize(len(policy.weights[0]), len(policy.scale), policy.columns, tuple(b.shape[2] for b in policy.biases[:-1]))
    network = TeamNetwork(size, torch.tensor(policy.scale), dueling=policy.dueling, risk=policy.risk > 0).requires_grad_(False)
    for own, trained in ((network.weights, policy.weights), (network.biases, policy.biases)):
        for parameter, array in zip(own, trained, strict=True):
            parameter.copy_(torch.tensor(array))
    return network


def _choose(values: Tensor, kept: Tensor, fresh: Tensor, margin: float) -> Tensor:
    """Actions (...,) for values (..., A), chosen as by :func:`~marlbc_mj.policies.greedy.greedy`; ``kept`` are in force."""
    best = values.argmax(dim=-1)
    lead = values.gather(-1, best[..., None]) - values.gather(-1, kept[..., None])
    return torch.where(takes_best(lead[..., 0], fresh, margin), best, kept)


class TeamPolicy(nn.Module):
    """``Policy.values`` and ``greedy`` of N agents as a torch module.

    Args:
        policy: the policy to copy the networks from.
        agents: N; if there is one network for all agents, its actions are joint actions in C order.
    """

    def __init__(self, policy: Policy, agents: int) -> None:
        super().__init__()
        networks = len(policy.weights[0])
        self.network = _as_modules(policy)
        self.margin, self.risk = policy.margin, policy.risk
        self.each = policy.columns if networks == agents else round(policy.columns ** (1 / agents))
        self.strides: Tensor | None  # of each agent's action in the index of a joint action
        strides = torch.tensor([self.each ** (agents - 1 - i) for i in range(agents)])
        self.register_buffer("strides", None if networks == agents else strides)

    def forward(self, state: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        """Values (B, N, A), or (B, 1, A^N), and chosen actions (B, N), from states (B, S) and last actions (B, N), which are
        negative if there are none.
        """
        values, logits = self.network.heads(state)
        if self.risk:
            values, _ = mask_risky(values, torch.sigmoid(logits), self.risk)
        values = values.transpose(0, 1)
        fresh = last.amin(dim=-1, keepdim=True) < 0
        kept = last.clamp(min=0)
        if self.strides is not None:
            kept = (kept * self.strides).sum(dim=-1, keepdim=True)
        chosen = _choose(values, kept, fresh, self.margin)
        return values, chosen if self.strides is None else chosen.div(self.strides, rounding_mode="floor") % self.each


class AgentPolicy(nn.Module):
    """``GeneralPolicy.decide`` of one agent as a torch module; received vectors are pooled as by
    :func:`~marlbc_mj.policies.general_inputs.pool_heard`, leads as by :func:`~marlbc_mj.policies.general.mean_lead`.
    """

    def __init__(self, policy: GeneralPolicy) -> None:
        super().__init__()
        self.network, self.margin = _as_modules(policy.network), policy.network.margin
        self.dwell, self.deadline, self.consensus = policy.dwell, policy.deadline, policy.consensus

    def forward(
        self, features: Tensor, heard: Tensor, age: Tensor, lead: Tensor, lead_age: Tensor, last: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Values (B, A), the agent's own lead (B,) for the others, and chosen actions (B,).

        The arguments are features (B, F), received vectors (B, N, M) and their ages (B, N), received leads (B, N) and their ages
        (B, N), infinite for the agent itself, and last actions (B,), which are negative if there are none.
        """
        values, _ = self.network.heads(torch.cat([features, pool(heard, age)], dim=-1))
        mean = values.mean(dim=0)
        best = by_motion(mean)
        own = best[:, COLUMN_ACTION] - best[:, FORMATION]
        counts = (lead_age <= INTERVAL).to(lead.dtype) * float(self.consensus)
        ahead = (own + torch.where(counts > 0, lead, 0.0).sum(dim=1)) / (1.0 + counts.sum(dim=1))
        shift = torch.stack([torch.zeros_like(ahead), ahead], dim=-1) - best
        used = mean + shift.repeat(1, mean.shape[-1] // len(MOTIONS))
        kept, fresh = last.clamp(min=0), last < 0
        free = may_change(features[..., AGE_ENTRIES], fresh, self.dwell)
        chosen = torch.where(free, _choose(used, kept, fresh, self.margin), kept)
        if self.deadline:
            back = must_return(features[..., WAYS + 1], features[..., ENDING + 1], self.deadline)
            chosen = torch.where(back, chosen - chosen % len(MOTIONS), chosen)
        return mean, own, chosen


def pool(heard: Tensor, age: Tensor) -> Tensor:
    """(B, P) pooled inputs from received vectors (B, N, M) and their ages (B, N)."""
    known = torch.isfinite(age)[..., None]
    count = known.sum(dim=1).clamp(min=1)
    counted = torch.cat([(heard[..., :WAYS] < 0.0).to(heard.dtype), heard[..., WAYS:]], dim=-1)
    nothing, changing = torch.zeros_like(heard), slice(WAYS, AGE_ENTRIES + 2)
    parts = (
        torch.where(known, heard, nothing + MOST_BEYOND).amin(dim=1),
        torch.where(known, counted, nothing).sum(dim=1) / count,
        torch.where(known, heard, nothing)[..., changing].amax(dim=1),
        count / heard.shape[1],
        1.0 - torch.exp(-torch.where(known, age[..., None], 0.0).amax(dim=1) / COARSE),
    )
    return torch.cat(parts, dim=-1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's log messages and warnings, about itself and about packages that are not needed here."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def build(policy: Policy, agents: int, metadata: dict[str, str]) -> Any:
    """The checked ``onnx.ModelProto`` of a policy of ``agents`` agents; see :func:`export_policy`."""
    inputs = {"state": torch.zeros(2, len(policy.scale)), "last": torch.zeros(2, agents, dtype=torch.int64)}
    batch = torch.export.Dim("batch")
    return _graph(TeamPolicy(policy, agents), inputs, ["values", "orders"], ({0: batch}, {0: batch}), metadata)


def build_general(policy: GeneralPolicy, metadata: dict[str, str]) -> Any:
    """The checked ``onnx.ModelProto`` of a general policy for one agent; see :func:`export_policy`."""
    inputs = {
        "features": torch.zeros(2, FEATURES),
        "heard": torch.zeros(2, 3, SENT),
        "age": torch.zeros(2, 3),
        "lead": torch.zeros(2, 3),
        "lead_age": torch.zeros(2, 3),
        "last": torch.zeros(2, dtype=torch.int64),
    }
    batch, agents = torch.export.Dim("batch"), torch.export.Dim("agents")
    shapes = ({0: batch}, *({0: batch, 1: agents} for _ in range(4)), {0: batch})
    return _graph(AgentPolicy(policy), inputs, ["values", "own_lead", "action"], shapes, metadata)


def _graph(module: nn.Module, inputs: dict[str, Tensor], outputs: list[str], shapes: Any, metadata: dict[str, str]) -> Any:
    """The checked ``onnx.ModelProto`` of a module, with ``shapes`` naming the inputs' dynamic axes."""
    onnx: Any = import_module("onnx")
    with _quiet():
        program = torch.onnx.export(
            module,
            tuple(inputs.values()),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=shapes,
        )
    assert program is not None
    model = program.model_proto
    model.ir_version = IR
    for entry in (model.graph, *model.graph.node, *model.graph.input, *model.graph.output, *model.graph.value_info):
        entry.ClearField("metadata_props")  # source traces with local paths; the field is newer than IR
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model, full_check=True)
    return model
