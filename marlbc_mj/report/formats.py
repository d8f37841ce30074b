"""Formatting of numbers and text in all tables."""

import math
from collections.abc import Sequence

from marlbc_mj.report.table import Column
from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.statistics import Estimate

DASH = "–"
FAILED = "failed"


def score_column(name: str) -> Column:
    """Column header of a score: quantity, aggregation and unit."""
    return Column(*SCORES[name][:3])


def score_cell(name: str, metrics: Metrics) -> str:
    """A score of one episode, in the unit and with the decimals of its column."""
    score = SCORES[name]
    return fixed(score.factor * score.read(metrics), score.digits)


def score_interval(name: str, estimate: Estimate) -> str:
    """An estimate of a score, in the unit and with the decimals of its column."""
    score = SCORES[name]
    return interval(scaled(estimate, score.factor), score.digits)


def fixed(value: float, digits: int) -> str:
    """A number with this many decimals and a true minus sign; a dash if it is not finite."""
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else DASH


def significant(value: float, digits: int = 3) -> str:
    """A number with this many significant digits, never in exponent notation."""
    if not math.isfinite(value) or value == 0:
        return DASH if value else "0"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):.{max(0, decimals)}f}"


def grouped(value: float) -> str:
    """A number rounded to an integer, with spaces between thousands."""
    return f"{value:,.0f}".replace(",", " ").replace("-", "−")


def interval(estimate: Estimate, digits: int) -> str:
    """``value [low, high]``; a dash if no run finished, and no interval for a single run."""
    if not math.isfinite(estimate.value):
        return DASH
    value, low, high = (fixed(number, digits) for number in estimate)
    return value if math.isnan(estimate.low) else f"{value} [{low}, {high}]"


def loose_interval(estimate: Estimate) -> str:
    """``value [low, high]`` with three significant digits."""
    if not math.isfinite(estimate.value):
        return DASH
    ends = f" [{significant(estimate.low)}, {significant(estimate.high)}]"
    return significant(estimate.value) + ("" if math.isnan(estimate.low) else ends)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """An estimate in another unit."""
    return Estimate(*(factor * value for value in estimate))


def percent(estimate: Estimate) -> Estimate:
    """An estimated share in percent."""
    return scaled(estimate, 100.0)


def spans(numbers: Sequence[int]) -> str:
    """Integers as text, with three or more consecutive ones as a span: ``0, 2 to 4, 6, 7``."""
    numbers = sorted(numbers)
    starts = [k for k, n in enumerate(numbers) if k == 0 or n != numbers[k - 1] + 1]
    pieces = [numbers[a:b] for a, b in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    return ", ".join(f"{piece[0]} to {piece[-1]}" if len(piece) > 2 else ", ".join(map(str, piece)) for piece in pieces)


def listed(names: list[str]) -> str:
    """Names joined as ``a``, ``a and b`` or ``a, b and c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""
