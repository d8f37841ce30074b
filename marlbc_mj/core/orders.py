"""Priority orders: the permutations of the behaviors, their names, and which of them command the same motion."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.text import one_line

SEPARATOR = ">"


class Orders:
    """All priority orders of M behaviors, in lexicographic order.

    A behavior is *complete* if its Jacobian has full column rank (FM and FR: J = I). Behaviors of lower priority then have no
    effect. Two orders that agree down to their first complete behavior give the same command and count as equal, so the 6 orders
    of OA, FM and FR make 4 commands (FM, FR, OA>FM, OA>FR).
    """

    def __init__(self, names: Sequence[str], complete: Sequence[bool]) -> None:
        self.behaviors = tuple(names)
        self.table = np.array(list(permutations(range(len(names)))), dtype=np.int64)  # (n_orders, M)
        prefixes = [self._prefix(row, complete) for row in self.table]
        self.commands = tuple(dict.fromkeys(SEPARATOR.join(names[j] for j in prefix) for prefix in prefixes))
        self.command_of = np.array(
            [self.commands.index(SEPARATOR.join(names[j] for j in prefix)) for prefix in prefixes],
            dtype=np.int64,
        )  # (n_orders,)
        self.representative = np.array(
            [int(np.flatnonzero(self.command_of == c)[0]) for c in range(len(self.commands))], dtype=np.int64
        )  # (n_commands,): the first order that gives this command

    @staticmethod
    def _prefix(row: np.ndarray, complete: Sequence[bool]) -> tuple[int, ...]:
        for depth, j in enumerate(row):
            if complete[j]:
                return tuple(int(k) for k in row[: depth + 1])
        return tuple(int(k) for k in row)

    def __len__(self) -> int:
        return len(self.table)

    @property
    def names(self) -> tuple[str, ...]:
        """Full name of every order by index, for example ``"OA>FM>FR"``."""
        return tuple(SEPARATOR.join(self.behaviors[j] for j in row) for row in self.table)

    def read(self, given: Any) -> np.ndarray:
        """Convert a caller's orders to contiguous int64 indices for compiled code; shape and range are not checked.

        Args:
            given: integers, or names that :meth:`index` accepts: an array, nested lists or a tensor in main memory.

        Raises:
            ConfigurationError: any other type, or a name that is not an order.
        """
        try:
            array = np.asarray(given)
        except (TypeError, ValueError, RuntimeError) as error:  # ragged lists; a tensor on a GPU, or one that requires gradients
            raise ConfigurationError(f"orders must be integers, got {type(given).__name__}: {one_line(error)}") from None
        if array.dtype.kind == "U":
            array = np.array([self.index(str(name)) for name in array.ravel()], dtype=np.int64).reshape(array.shape)
        if array.dtype.kind not in "iu":
            raise ConfigurationError(f"orders must be integers, got {array.dtype}")
        return np.ascontiguousarray(array, dtype=np.int64)

    def index(self, name: str) -> int:
        """Index of an order from its full name or from the command it gives (``"OA>FM>FR"`` or ``"OA>FM"``).

        Raises:
            ConfigurationError: there is no such order.
        """
        if name in self.commands:
            return int(self.representative[self.commands.index(name)])
        if name in self.names:
            return self.names.index(name)
        raise unknown("priority order", name, (*self.commands, *self.names))
