"""Independent deep Q-learning of a team: dueling networks, averaged targets, lenient (17) or hysteretic weights of errors."""

import copy
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from marlbc_mj.training.base import prefixed, unprefixed
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.networks import NetworkSize, TargetRing, TeamNetwork, as_tensor, mask_risky, restore, saved, with_moments
from marlbc_mj.training.replay import Batch, Replay

HYSTERESIS = 0.5
"""Weight of negative TD errors in hysteretic learning (Omidshafiei et al. 2017)."""
LARGEST_GRADIENT = 10.0
"""Largest norm of a gradient, to which larger ones are scaled down: per network where networks learn independently, over all
parameters where one loss trains all of them."""


class Learner:
    """The networks of N agents with their target networks and optimiser.

    Args:
        config: configuration of the run.
        agents: N.
        actions: A, number of actions per agent.
        scale: (S,) divisor of a state.
        generator: random generator for the initial weights and the draws x of (17).
        mask: (N, S), 1 for the entries of the state that each agent's network sees, else 0; all entries by default.
    """

    joint = False  # whether one loss trains all networks
    own_state = False  # whether each agent's network sees only the agent's own entries of the state
    prioritised = False  # whether transitions with larger TD errors are drawn more often

    def __init__(
        self,
        config: TrainConfig,
        agents: int,
        actions: int,
        scale: np.ndarray,
        generator: torch.Generator,
        mask: np.ndarray | None = None,
    ) -> None:
        self.config = config
        self.treatment = config.learner  # of negative TD errors, see td_weight
        self.generator = generator
        networks, outputs = self.shape(agents, actions)
        self.network = TeamNetwork(
            NetworkSize(networks, len(scale), outputs, config.hidden),
            torch.from_numpy(scale),
            dueling=config.dueling,
            risk=config.risk_gamma > 0,
            generator=generator,
            mask=None if mask is None else torch.from_numpy(mask),
        ).to(config.device)
        self.smooth = copy.deepcopy(self.network).requires_grad_(False)  # holds the running mean of the weights
        self.targets = TargetRing(self.network, config.copies)
        self.optimise([*self.network.parameters(), *self.further(agents, scale, generator)])
        self.updates = 0
        self.errors = np.zeros((0, 0), dtype=np.float32)  # (K, M) absolute TD errors of the last update

    def shape(self, agents: int, actions: int) -> tuple[int, int]:
        """Number of networks, and number of action values per network."""
        return agents, actions

    def further(self, agents: int, scale: np.ndarray, generator: torch.Generator) -> list[nn.Parameter]:
        """Create other trained modules, such as a mixer, and return their parameters; arguments as for the class."""
        return []

    def optimise(self, parameters: Iterable[nn.Parameter]) -> None:
        """Create an optimiser for these parameters; later updates train them."""
        self.parameters = list(parameters)
        self.optimiser = with_moments(self.make_optimiser())

    def make_optimiser(self) -> torch.optim.Optimizer:
        """The optimiser for ``parameters``: Adam."""
        return torch.optim.Adam(self.parameters, lr=self.config.learning_rate, eps=1e-5, fused=True)

    @torch.no_grad()
    def values(self, state: np.ndarray) -> np.ndarray:
        """(B, N, A) action values in states (B, S); -inf for actions that are too risky."""
        q, logits = self.network.heads(self.tensor(state))
        q = self._masked(q, torch.sigmoid(logits))[0]
        return np.ascontiguousarray(q.transpose(0, 1).cpu().numpy())

    def update(self, batch: Batch, learning_rate: float) -> float:
        """Make one gradient step on :meth:`loss` and return the mean absolute error."""
        return self.descend(*self.loss(batch), learning_rate)

    def descend(self, loss: Tensor, error: Tensor, learning_rate: float) -> float:
        """Make one gradient step on ``loss`` and return the mean absolute ``error`` (K, M)."""
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        self.optimiser.zero_grad()
        loss.backward()
        self.network.forget_unseen()
        self._clip()
        self.optimiser.step()
        self.updates += 1
        self._smooth()
        if self.updates % self.config.push_every == 0:
            self.push()
        self.errors = error.abs().cpu().numpy()
        return float(error.abs().mean())

    def loss(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The loss and the TD errors (K, M). The loss sums over networks the mean Huber loss of the TD errors, each weighted by
        :func:`td_weight`; with risks, :meth:`risk_loss` is added.
        """
        now, logits = self.network.heads(self.tensor(batch.state))
        ahead, least = self._masked(*self.targets.heads(self.tensor(batch.next_state)))
        chosen, target = self.estimates(batch, now, ahead)
        error = (target - chosen).detach()
        weight = td_weight(error, self.tensor(batch.leniency.T), self.treatment, self.generator)
        if batch.weight is not None:
            weight = weight * self.tensor(batch.weight.T)
        errors = nn.functional.huber_loss(chosen, target, reduction="none", delta=self.config.huber)
        loss = (errors * weight).sum(dim=0).mean()
        if self.network.risk:
            loss = loss + self.risk_loss(batch, logits, least)
        return loss, error

    def _clip(self) -> None:
        if self.joint:
            nn.utils.clip_grad_norm_(self.parameters, LARGEST_GRADIENT)
        else:
            clip_each(self.parameters, LARGEST_GRADIENT)

    @torch.no_grad()
    def _smooth(self) -> None:
        share = max(1.0 - self.config.smoothing, 1.0 / self.updates)
        torch._foreach_lerp_(list(self.smooth.parameters()), list(self.network.parameters()), share)

    def _masked(self, values: Tensor, risks: Tensor) -> tuple[Tensor, Tensor]:
        """Values (N, M, A) with -inf for actions that are too risky, and the smallest risks (N, M), 0 without risks."""
        if not self.network.risk:
            return values, torch.zeros(values.shape[:-1], device=values.device)
        return mask_risky(values, risks, self.config.risk_limit)

    def risk_loss(self, batch: Batch, logits: Tensor, least: Tensor) -> Tensor:
        """Cross entropy between the chosen actions' risks and their targets: 1 where the agent was lost, else
        risk_gamma min_b risk(s', b), or 0 where its return ends.

        The risk of an action thus becomes the discounted probability that coming too close can no longer be avoided. Bharadhwaj
        et al. (ICLR 2021) learn a safety critic in this way.

        Args:
            batch: M transitions over one decision each.
            logits: (N, M, A) logits of the risks in ``batch.state``.
            least: (N, M) smallest risks in ``batch.next_state``.
        """
        goes_on = self.tensor(batch.discount.T) > 0
        assert batch.lost is not None
        target = torch.maximum(self.tensor(batch.lost.T), self.config.risk_gamma * goes_on * least)
        chosen = self.chosen(batch, logits)
        return nn.functional.binary_cross_entropy_with_logits(chosen, target, reduction="none").sum(dim=0).mean()

    def push(self) -> None:
        """Add the current networks to the past ones that targets average, replacing the oldest."""
        self.targets.push()

    def estimates(self, batch: Batch, now: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """(K, M) values of the chosen actions, with gradient, and their targets, without gradient; one row per agent here, K = N.

        The target of (17): r + discount max_b Q(s', b), with Q averaged over the past networks.

        Args:
            batch: M transitions.
            now: (N, M, A) values in ``batch.state``.
            ahead: (N, M, A) averaged values in ``batch.next_state``, -inf for actions that are too risky.
        """
        target = self.tensor(batch.reward.T) + self.tensor(batch.discount.T) * ahead.amax(dim=-1)
        return self.chosen(batch, now), target

    def chosen(self, batch: Batch, values: Tensor) -> Tensor:
        """(N, M) entries of ``values`` (N, M, A) for the actions that were taken."""
        actions = torch.from_numpy(np.ascontiguousarray(batch.action.T)).to(self.config.device)
        return values.gather(-1, actions[..., None]).squeeze(-1)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of the networks, their running mean, the past networks and the optimiser's moments, by name."""
        tensors = saved(self.parameters, self.optimiser) | {f"target{k}": t for k, t in enumerate(self.targets.tensors)}
        tensors |= {f"smooth{k}": p for k, p in enumerate(self.smooth.parameters())}
        return {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a :meth:`snapshot`."""
        restore(arrays, self.parameters, self.optimiser)
        self.targets.restore([torch.from_numpy(arrays[f"target{k}"]) for k in range(len(self.targets.tensors))])
        for k, p in enumerate(self.smooth.parameters()):
            p.copy_(torch.from_numpy(arrays[f"smooth{k}"]))

    def tensor(self, array: np.ndarray) -> Tensor:
        """An array as a float32 tensor on the device of the networks."""
        return as_tensor(array, self.config.device)


def snapshot_learning(learner: Learner, replay: Replay) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The state that resumes a learner and its replay buffer bit for bit: arrays, and the remaining values as JSON data."""
    arrays = {**prefixed("learner", learner.snapshot()), **prefixed("replay", replay.arrays)}
    return arrays, {"rows": replay.count, "updates": learner.updates, "next_copy": learner.targets.next}


def restore_learning(learner: Learner, replay: Replay, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
    """Restore a :func:`snapshot_learning`; other entries in ``arrays`` and ``scalars`` are ignored."""
    learner.restore(unprefixed("learner", arrays))
    for name, array in replay.arrays.items():
        array[:] = arrays[f"replay.{name}"]
    replay.count = scalars["rows"]
    learner.updates, learner.targets.next = scalars["updates"], scalars["next_copy"]


@torch.no_grad()
def clip_each(parameters: Iterable[nn.Parameter], largest: float) -> None:
    """Limit the norm of each network's gradient to ``largest``; network i is at index i of the parameters (N, ., .).

    Networks that learn independently stay independent: a large error of one leaves the steps of the others unchanged.
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = torch.stack([g.square().sum(dim=(1, 2)) for g in gradients]).sum(dim=0).sqrt()  # (N,)
    factor = (largest / (norm + 1e-6)).clamp(max=1.0)[:, None, None]
    for gradient in gradients:
        gradient *= factor


def td_weight(error: Tensor, leniency: Tensor, kind: str, generator: torch.Generator) -> Tensor:
    """(N, M) weights of TD errors in the loss (17): 1 where the error is positive or x > L, else 0, x uniform in (0, 1).

    Args:
        error: (N, M) TD errors.
        leniency: (N, M) leniency L.
        kind: ``lenient`` as above; ``hysteretic`` (``HYSTERESIS`` for negative errors) and ``plain`` (1 for all) ignore L.
        generator: random generator for x.
    """
    if kind == "plain":
        return torch.ones_like(error)
    if kind == "hysteretic":
        return torch.where(error > 0, 1.0, HYSTERESIS)
    x = torch.rand(error.shape, generator=generator).to(error.device)
    return ((error > 0) | (x > leniency)).to(error.dtype)
