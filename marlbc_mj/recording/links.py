"""Communication links between agents to draw at one time; stale links are faded."""

from typing import NamedTuple

import numpy as np

from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.util.palette import LINK_COLOR, rgba

HALF_LIFE = 0.5  # age at which a link has half the opacity of a fresh one [s]
MAX_OPACITY, MIN_OPACITY = 0.9, 0.12  # opacity of a fresh link, and least opacity
MOST_LINKS = 400  # largest number of links drawn; if there are more, the shortest are drawn


class DrawnLinks(NamedTuple):
    """The links to draw at one time, one per pair of agents."""

    ends: np.ndarray  # (L, 2) int64, the two agents
    opacity: np.ndarray  # (L,)

    def colors(self) -> np.ndarray:
        """(L, 4) RGBA in [0, 1]."""
        return np.array([rgba(LINK_COLOR, float(opacity)) for opacity in self.opacity]).reshape(-1, 4)


def drawn_links(position: np.ndarray, link: np.ndarray, age: np.ndarray) -> DrawnLinks:
    """Links of pairs in which at least one agent hears the other; the older of their ages sets the opacity.

    Args:
        position: (N, 2) [m].
        link, age: (N, N) fields of :class:`~marlbc_mj.supervisors.communication.Hearing`, or (0, 0) without communication.
    """
    ends = np.argwhere(np.triu(link | link.T, 1))
    if len(ends) > MOST_LINKS:
        length = np.linalg.norm(position[ends[:, 0]] - position[ends[:, 1]], axis=1)
        ends = ends[np.sort(np.argsort(length, kind="stable")[:MOST_LINKS])]
    older = np.maximum(age, age.T)[ends[:, 0], ends[:, 1]]
    return DrawnLinks(ends, np.maximum(MAX_OPACITY * 0.5 ** (older / HALF_LIFE), MIN_OPACITY))


def links_of_log(log: EpisodeLog, step: int) -> DrawnLinks:
    """The links to draw for a mission step of a log."""
    return drawn_links(log.position[step], log.link[step], log.age[step])
