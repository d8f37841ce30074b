"""Dueling networks of a whole team as stacked matrices, past weights for averaged targets, and saving of networks and
optimisers.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.policies.greedy import admissible, dueling_value
from marlbc_mj.util.errors import ConfigurationError


class NetworkSize(NamedTuple):
    """Number of networks, and the size of each."""

    agents: int  # N networks
    state: int  # S inputs
    actions: int  # A action values; dueling and risk add further outputs
    hidden: tuple[int, ...]  # widths of the hidden layers


class TeamNetwork(nn.Module):
    """One dueling network per agent, Q_i(s, b) = V_i(s) + B_i(s, b) - mean_b B_i (Wang et al. 2016), all on the same state.

    Args:
        size: number and size of the networks, at least one hidden layer (ReLU).
        scale: (S,) divisor of the state.
        dueling: whether networks are dueling; if not, the last layer computes Q directly.
        risk: whether the last layer also computes the logit of a risk for every action.
        generator: random generator for the initial weights.
        mask: (N, S), 1 for the entries that each agent's network sees, else 0; all entries by default. Weights of unseen
            entries in the first layer are 0 and stay 0.

    Raises:
        ConfigurationError: no hidden layer.
    """

    def __init__(
        self,
        size: NetworkSize,
        scale: Tensor,
        *,
        dueling: bool = True,
        risk: bool = False,
        generator: torch.Generator | None = None,
        mask: Tensor | None = None,
    ) -> None:
        super().__init__()
        agents, state, actions, hidden = size
        if not hidden:
            raise ConfigurationError(f"networks must have at least one hidden layer, got {hidden}")
        self.dueling = dueling
        self.risk = risk
        self.actions = actions
        self.scale: Tensor
        self.register_buffer("scale", scale.to(torch.float32))
        sizes = [state, *hidden, dueling + actions + risk * actions]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for inputs, outputs in itertools.pairwise(sizes):
            bound = 1.0 / math.sqrt(inputs)
            weight = (2.0 * torch.rand(agents, inputs, outputs, generator=generator) - 1.0) * bound
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(agents, 1, outputs)))
        self.mask: Tensor | None
        self.register_buffer("mask", None if mask is None else mask.to(torch.float32)[..., None])
        if self.mask is not None:
            self.weights[0].data *= self.mask

    def forget_unseen(self) -> None:
        """Set the gradient of masked weights to 0; call this between ``backward`` and the optimiser's step."""
        gradient = self.weights[0].grad
        if self.mask is not None and gradient is not None:
            gradient *= self.mask

    def forward(self, state: Tensor) -> Tensor:
        """(N, B, A) action values of states (B, S), or (N, B, S) if each agent has its own."""
        return self.heads(state)[0]

    def heads(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Action values and risk logits, both (N, B, A); without risks, the logits are (N, B, 0)."""
        return self.split(feed_forward(list(self.weights), list(self.biases), state / self.scale))

    def split(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Action values (..., A) and risk logits (..., A) from the outputs (..., O) of the last layer."""
        if not self.dueling:
            return outputs[..., : self.actions], outputs[..., self.actions :]
        value, advantage, risk = outputs[..., :1], outputs[..., 1 : 1 + self.actions], outputs[..., 1 + self.actions :]
        return dueling_value(value, advantage, advantage.mean(dim=-1, keepdim=True)), risk


def as_tensor(array: np.ndarray, device: str) -> Tensor:
    """An array as a float32 tensor on the given device."""
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(device)


def mask_risky(values: Tensor, risks: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Values (..., A) with -inf for actions that are too risky, and the smallest risks (...).

    Args:
        values: (..., A) action values.
        risks: (..., A) risks of the actions in [0, 1].
        limit: largest risk that may be taken.
    """
    least = risks.amin(dim=-1, keepdim=True)
    return torch.where(admissible(risks, least, limit), values, -math.inf), least[..., 0]


def side_by_side(weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """Combine N layers that have the same input into one.

    Args:
        weight: (N, in, out) weights of the layers.
        bias: (N, 1, out) biases of the layers.

    Returns:
        Weight (in, N out) and bias (N out,) of the combined layer.
    """
    networks, inputs, width = weight.shape
    return weight.permute(1, 0, 2).reshape(inputs, networks * width), bias.reshape(-1)


def feed_forward(weights: list[Tensor], biases: list[Tensor], x: Tensor, first: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """(N, B, O) outputs of N networks of two or more layers, with ReLU in between.

    Args:
        weights: (N, in, out) weights of each layer.
        biases: (N, 1, out) biases of each layer.
        x: (B, in) input of all networks, or (N, B, in) with one per network.
        first: the combined first layer from :func:`side_by_side`, if the caller has it; it saves time for inputs (B, in).
    """
    if x.ndim == 3:
        y = torch.baddbmm(biases[0], x, weights[0]).relu_()
    else:
        weight, bias = first or side_by_side(weights[0], biases[0])
        y = torch.addmm(bias, x, weight).relu_().view(x.shape[0], len(weights[0]), -1).transpose(0, 1)
    for weight, bias in zip(weights[1:-1], biases[1:-1], strict=True):
        y = torch.baddbmm(bias, y, weight).relu_()
    return torch.baddbmm(biases[-1], y, weights[-1])


class TargetRing:
    """Ring of the last ``copies`` weights of a network, over which values and risks are averaged (Anschel et al. 2017).

    Args:
        network: the network whose weights are copied.
        copies: number of copies; at first all hold the current weights.
    """

    def __init__(self, network: TeamNetwork, copies: int) -> None:
        self.network = network
        self.copies = copies
        self.agents = network.weights[0].shape[0]
        self.tensors = [p.detach().repeat(copies, 1, 1) for p in self._parameters()]  # (copies N, ., .)
        self.next = 0  # index of the copy to replace next
        self.first_layer: tuple[Tensor, Tensor] | None = None  # combined first layer of all copies; None after a change

    def _parameters(self) -> Iterator[Tensor]:
        yield from self.network.weights
        yield from self.network.biases

    def push(self) -> None:
        """Replace the oldest copy by the network's current weights."""
        rows = slice(self.next * self.agents, (self.next + 1) * self.agents)
        for copy, parameter in zip(self.tensors, self._parameters(), strict=True):
            copy[rows] = parameter.detach()
        self.next = (self.next + 1) % self.copies
        self.first_layer = None

    def restore(self, tensors: Sequence[Tensor]) -> None:
        """Copy the ``tensors`` of another ring; set ``next`` separately."""
        for copy, tensor in zip(self.tensors, tensors, strict=True):
            copy.copy_(tensor)
        self.first_layer = None

    @torch.no_grad()
    def heads(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Averaged action values and averaged risks in [0, 1], both (N, B, A); without risks, these are (N, B, 0).

        Args:
            state: (B, S), or (N, B, S) if each agent has its own.
        """
        layers = len(self.network.weights)
        if state.ndim == 3:
            state = state.repeat(self.copies, 1, 1)
        weights, biases = self.tensors[:layers], self.tensors[layers:]
        if self.first_layer is None and state.ndim == 2:
            self.first_layer = side_by_side(weights[0], biases[0])
        outputs = feed_forward(weights, biases, state / self.network.scale, self.first_layer)
        values, risks = self.network.split(outputs.view(self.copies, self.agents, *outputs.shape[1:]))
        return values.mean(dim=0), torch.sigmoid(risks).mean(dim=0)


def with_moments(optimiser: torch.optim.Optimizer) -> torch.optim.Optimizer:
    """The optimiser with its moments allocated before the first step, so that its saved state is always complete."""
    for parameter in (p for group in optimiser.param_groups for p in group["params"]):
        parameter.grad = torch.zeros_like(parameter)
    optimiser.step()  # gradients are 0: no parameter changes
    for moments in optimiser.state.values():
        moments["step"].zero_()
    optimiser.zero_grad()
    return optimiser


def saved(parameters: Sequence[nn.Parameter], optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Parameters and the optimiser's moments by name, not copied; names of moments begin with ``adam`` for any optimiser."""
    tensors = {f"network{k}": p.detach() for k, p in enumerate(parameters)}
    for k, p in enumerate(parameters):
        tensors |= {f"adam{k}.{name}": value for name, value in optimiser.state[p].items()}
    return tensors


def restore(arrays: Mapping[str, np.ndarray], parameters: Sequence[nn.Parameter], optimiser: torch.optim.Optimizer) -> None:
    """Set parameters and moments in place to the values that :func:`saved` returned."""
    for k, p in enumerate(parameters):
        p.data.copy_(torch.from_numpy(arrays[f"network{k}"]))
        prefix = f"adam{k}."
        moments = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        for name, array in moments.items():
            optimiser.state[p][name].copy_(torch.from_numpy(array))
