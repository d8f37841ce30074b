"""Numbers published in Tables 3 to 6 of Zhang, Huang and Pan (FITEE 2024), and the errata that are needed to read them."""

from collections.abc import Mapping
from typing import NamedTuple

_TITLE = "Multi-agent reinforcement learning behavioral control for nonlinear second-order systems"
CITATION = f"Zhang, Huang, Pan: {_TITLE}. FITEE, 2024."
DOI = "https://doi.org/10.1631/FITEE.2300394"
SCENARIO = "paper"
"""The scenario that the published numbers belong to."""

PAPER_SUPERVISORS = {"marlms": "MARLMS", "fsams": "FSAMS", "mpcms": "MPCMS", "rlms": "RLMS"}
"""Our name -> name in Tables 3 and 4."""
PAPER_CONTROLLERS = {"sorlc": "MARLBC", "finite-time": "finite-time", "fixed-time": "fixed-time"}
"""Our name -> name in Tables 5 and 6, whose rows are whole frameworks; the baselines there have no force limit."""


class Published(NamedTuple):
    """A published quantity: its values for the four agents, by our name of the method."""

    values: Mapping[str, tuple[float, ...]]
    comparable: bool = True  # False if, because of an erratum, only the order of methods can be compared


PUBLISHED_SWITCHES = Published({"marlms": (4, 2, 2, 4), "fsams": (118, 86, 86, 118), "mpcms": (4, 2, 2, 4), "rlms": (6, 4, 4, 6)})
"""Switches of each agent, Table 3."""
PUBLISHED_DECISION_MS = Published(
    {
        "marlms": (1.4, 1.1, 1.3, 1.5),
        "fsams": (1.0, 0.8, 0.9, 1.3),
        "mpcms": (597.2, 530.8, 663.5, 796.2),
        "rlms": (1.0, 0.7, 0.8, 1.1),
    }
)
"""Decision time of one agent at a time, Table 4 [ms]."""
PUBLISHED_COST_MAX = Published({"sorlc": (9, 9, 9, 9), "finite-time": (17, 17, 60, 60), "fixed-time": (103, 115, 372, 372)})
"""Largest control cost, Table 5, in units of 1e4."""
PUBLISHED_COST_TOTAL = Published(
    {"sorlc": (382, 364, 570, 609), "finite-time": (435, 404, 1384, 1391), "fixed-time": (518, 790, 1813, 1868)},
    comparable=False,
)
"""Total control cost, Table 5, in units of 1e4 (erratum 16)."""
PUBLISHED_INPUT_MAX = Published(
    {"sorlc": (200, 200, 200, 200), "finite-time": (384, 384, 768, 768), "fixed-time": (960, 1061, 1920, 1920)}
)
"""Largest control input, Table 6 [N]."""
PUBLISHED_INPUT_TOTAL = Published(
    {
        "sorlc": (2210, 2341, 4118, 4285),
        "finite-time": (2756, 2883, 5274, 5466),
        "fixed-time": (9127, 13370, 16112, 16646),
    }
)
"""Total control input, Table 6, a sum over samples [N]."""
PUBLISHED_CONVERGENCE = {"sorlc": 0.7, "rlc": 3.4}
"""Time in which the velocity error converges, Figs. 6c and 7c [s]."""

ERRATA = {
    2: "The compensator enters the force with a sign that pushes further into the limit while the force is saturated. "
    "The published sign is the default; the other one is an option.",
    4: "Two of the four column offsets are published with a negative sign, which would put two pairs of agents in the same "
    "place. Positive ones give an even column, and only they explain the published cost of agents 3 and 4.",
    6: "Obstacle avoidance, read as an equality, pulls an agent towards an obstacle and leaves it on the safe distance, "
    "where the reward still punishes it. Here it acts only inside the safe distance.",
    8: "The switching rules given for the learned supervisor are those of the finite state automaton. In the middle of "
    "the gate the clearance equals their upper threshold exactly.",
    13: "The networks' centres span -6 to 6 while positions reach 100: after some 10 s the basis vanishes, and SORLC is a "
    "saturated PD law.",
    15: "A largest input of 200 N on both axes can only be the infinity norm; the Euclidean one reaches 283 N.",
    16: "The published totals of cost and of input contradict each other if they share a unit; an integral and a sum "
    "over samples differ by a factor of 20. Totals of cost are compared by their order only.",
    17: "The input limit is published in N m; it acts on a point mass and is read as N.",
}
"""Errata that change how these tables read, by the number used in code and documentation."""


def order_matches(ours: Mapping[str, float], published: Mapping[str, float]) -> tuple[int, int]:
    """The number of pairs of methods that are in the published order, and the number of all pairs.

    Pairs consist of methods that have both numbers. A published tie has no order and is not counted; a tie of ours
    is a mismatch if the published numbers differ.
    """
    names = [name for name in published if name in ours]
    pairs = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :] if published[a] != published[b]]
    same = sum((ours[a] - ours[b]) * (published[a] - published[b]) > 0 for a, b in pairs)
    return same, len(pairs)


def order_mark(ours: Mapping[str, float], published: Mapping[str, float]) -> str:
    """``"yes"``, ``"no (1 of 3)"`` with the number of pairs that differ, or ``"–"`` if there is no pair to compare."""
    same, pairs = order_matches(ours, published)
    if not pairs:
        return "–"
    return "yes" if same == pairs else f"no ({pairs - same} of {pairs})"
