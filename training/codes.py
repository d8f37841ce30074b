"""Hash codes of states: the signs of A (z - mean z), where z is an auto-encoder's code or the state (Tang et al. 2017)."""

import numpy as np
import torch
from torch import Tensor, nn

CODE = 16
"""Width of the auto-encoder's code."""
HIDDEN = 32
"""Width of the auto-encoder's hidden layers."""
MINIBATCHES = 500
"""Gradient steps of the auto-encoder's training."""
MINIBATCH = 256
"""States per gradient step."""


class StateHash:
    """Maps states to integers below 2^bits; all codes are 0 before :meth:`fit`.

    Args:
        size: S, the size of a state.
        bits: number of bits of a hash code.
        kind: ``"autoencoder"``, or ``"plain"`` to take the state itself as z.
        rng: random generator for the projection A.
    """

    def __init__(self, size: int, bits: int, kind: str, rng: np.random.Generator) -> None:
        self.kind = kind
        self.bits = bits
        width = CODE if kind == "autoencoder" else size
        self.arrays = {
            "projection": rng.standard_normal((width, bits)).astype(np.float32),
            "mean": np.zeros(width, dtype=np.float32),
            "weight1": np.zeros((size, HIDDEN), dtype=np.float32),
            "bias1": np.zeros(HIDDEN, dtype=np.float32),
            "weight2": np.zeros((HIDDEN, CODE), dtype=np.float32),
            "bias2": np.zeros(CODE, dtype=np.float32),
            "fitted": np.zeros(1, dtype=np.float32),
        }

    @property
    def fitted(self) -> bool:
        """Whether :meth:`fit` was called; before that, all states have the same code."""
        return bool(self.arrays["fitted"][0])

    def fit(self, states: np.ndarray, generator: torch.Generator) -> float:
        """Fit the hash, training the auto-encoder if there is one; returns its last mean squared reconstruction error, else 0.

        Args:
            states: (M, S) float32, scaled.
            generator: random generator for the initial weights and the minibatches.
        """
        error = 0.0
        if self.kind == "autoencoder":
            error = self._train(torch.from_numpy(states), generator)
        self.arrays["mean"] = self._encode(states).mean(axis=0)
        self.arrays["fitted"][:] = 1.0
        return error

    def _train(self, states: Tensor, generator: torch.Generator) -> float:
        size = states.shape[1]
        first, second = nn.Linear(size, HIDDEN), nn.Linear(HIDDEN, CODE)
        decoder = nn.Linear(CODE, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, size)
        coder = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), *decoder)
        for parameter in coder.parameters():
            bound = 1.0 / np.sqrt(parameter.shape[-1])
            parameter.data = (2.0 * torch.rand(parameter.shape, generator=generator) - 1.0) * bound
        optimiser = torch.optim.Adam(coder.parameters(), lr=3e-3)
        error = torch.zeros(())
        for _ in range(MINIBATCHES):
            batch = states[torch.randint(len(states), (MINIBATCH,), generator=generator)]
            error = nn.functional.mse_loss(coder(batch), batch)
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
        for k, layer in ((1, first), (2, second)):
            self.arrays[f"weight{k}"] = layer.weight.detach().numpy().T.copy()
            self.arrays[f"bias{k}"] = layer.bias.detach().numpy().copy()
        return float(error.detach())

    def _encode(self, states: np.ndarray) -> np.ndarray:
        """Codes z (M, CODE) of states (M, S)."""
        if self.kind == "plain":
            return states
        a = self.arrays
        hidden = np.tanh(states @ a["weight1"] + a["bias1"])
        return np.asarray(np.tanh(hidden @ a["weight2"] + a["bias2"]))

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """(B,) int64 codes of scaled states (B, S)."""
        if not self.fitted:
            return np.zeros(len(states), dtype=np.int64)
        signs = (self._encode(states) - self.arrays["mean"]) @ self.arrays["projection"] > 0
        return np.asarray(signs @ (1 << np.arange(self.bits)))
