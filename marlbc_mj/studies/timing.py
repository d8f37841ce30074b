"""Timing on a machine with other load: variants take turns within one process, so that their ratios stay reliable."""

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

from marlbc_mj.util.errors import ConfigurationError

LEAST_ROUNDS = 5


def check_rounds(rounds: int) -> None:
    """Raise ConfigurationError if there are too few rounds for a median."""
    if rounds < LEAST_ROUNDS:
        raise ConfigurationError(f"rounds must be at least {LEAST_ROUNDS} for a meaningful median, got {rounds}")


def _seconds(action: Callable[[], Any], clock: Callable[[], float]) -> float:
    start = clock()
    action()
    return clock() - start


def interleaved(
    variants: dict[Any, Callable[[], None]], rounds: int, clock: Callable[[], float] = perf_counter
) -> dict[Any, list[float]]:
    """Seconds of each variant in every round; variants take turns, after one warm-up round that is not counted.

    For work on one thread, the clock ``process_time`` excludes the time that other programs had the processor.
    """
    taken: dict[Any, list[float]] = {name: [] for name in variants}
    for round_ in range(rounds + 1):
        for name, action in variants.items():
            seconds = _seconds(action, clock)
            if round_:
                taken[name].append(seconds)
    return taken


def ratio(above: list[float], below: list[float]) -> float:
    """Median of the per-round ratios ``above / below``."""
    return median(a / b for a, b in zip(above, below, strict=True))
