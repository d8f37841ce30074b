"""The interface of controllers, and the checks that they share."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.util.errors import ConfigurationError, unknown


@runtime_checkable
class Controller(Protocol):
    """A force law with its gains. Implementations are frozen dataclasses; the law itself holds no state.

    ``limited`` states whether the actuators enforce the scenario's force limit. The paper reads its baselines as unlimited
    laws; their actuators have no range. A law with decaying internal states may define ``decay_rates`` [1/s], which are then
    also checked against the substep.
    """

    @property
    def law(self) -> laws.Law: ...
    @property
    def limited(self) -> bool: ...
    @property
    def linear_gains(self) -> tuple[float, float] | None:
        """Largest position and velocity gain [1/s^2, 1/s] per unit mass, for the step-size check; None if unbounded."""
        ...

    def params(self, agent: int, limit: float) -> laws.Numbers:
        """The law's gains by name; ``limit`` [N] is the force limit, infinite if there is none. See :func:`laws.gains_of`."""
        ...

    def initial_state(self, agent: int) -> laws.Numbers:
        """Initial values of the law's state by name, for example weights; omitted entries start at 0."""
        ...


def require_gains(owner: object, names: Sequence[str], allow_zero: bool = False) -> None:
    """Raise ConfigurationError unless each named attribute is finite and positive (or zero where allowed)."""
    for name in names:
        value = getattr(owner, name)
        if not np.isfinite(value) or value < 0 or (value == 0 and not allow_zero):
            kind = "non-negative" if allow_zero else "positive"
            raise ConfigurationError(f"{type(owner).__name__}.{name} must be {kind} and finite, got {value}")


def largest_stable_substep(position_gain: float, velocity_gain: float) -> float:
    """Largest h [s] for which v += h(-k_p e - k_v v), p += h v is stable: 2 h k_v + h^2 k_p < 4 (Jury's test).

    For the paper's gains of 100 and 100 it is 19.8 ms, so a control law held for a mission step of 50 ms would diverge.
    """
    inverse = 0.25 * (velocity_gain + np.sqrt(velocity_gain**2 + 4.0 * position_gain))  # form without cancellation
    return float(1.0 / inverse) if inverse > 0.0 else np.inf


def model_weight(model: str) -> float:
    """Weight of the drag in a law: 1 if the law receives the true f (``exact``), 0 if it receives none (``none``).

    Raises:
        ConfigurationError: unknown ``model``.
    """
    weights = {"exact": 1.0, "none": 0.0}
    if model not in weights:
        raise unknown("model of the drag", model, weights)
    return weights[model]
