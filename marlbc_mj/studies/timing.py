"""Timing on a machine that is not quiet: variants take turns within one process, so that their ratios hold."""

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

from marlbc_mj.util.errors import ConfigurationError

LEAST_ROUNDS = 5


def check_rounds(rounds: int) -> None:
    """Raise ConfigurationError for too few rounds."""
    if rounds < LEAST_ROUNDS:
        raise ConfigurationError(f"rounds must be at least {LEAST_ROUNDS} for a median to mean something, got {rounds}")


def _seconds(action: Callable[[], Any], clock: Callable[[], float]) -> float:
    start = clock()
    action()
    return clock() - start


def interleaved(
    variants: dict[Any, Callable[[], None]], rounds: int, clock: Callable[[], float] = perf_counter
) -> dict[Any, list[float]]:
    """Seconds of each variant in every round, variants in turn; one round before does not count.

    Of work on one thread, ``process_time`` as the clock leaves out the time for which other programs had the processor.
    """
    taken: dict[Any, list[float]] = {name: [] for name in variants}
    for round_ in range(rounds + 1):
        for name, action in variants.items():
            seconds = _seconds(action, clock)
            if round_:
                taken[name].append(seconds)
    return taken


def ratio(above: list[float], below: list[float]) -> float:
    """Median of the ratios in each round."""
    return median(a / b for a, b in zip(above, below, strict=True))
