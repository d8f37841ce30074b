"""Links between agents to draw at one moment; stale links are faded."""

from typing import NamedTuple

import numpy as np

from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.util.palette import LINK_COLOR, rgba

HALF_LIFE = 0.5  # age at which a link is drawn half as clearly as a fresh one [s]
CLEAREST, FAINTEST = 0.9, 0.12  # opacity of a fresh link, and of one over which nothing has come
MOST_LINKS = 400  # that are drawn; of more, the shortest


class DrawnLinks(NamedTuple):
    """Links at one moment, each once."""

    ends: np.ndarray  # (L, 2) int64, the two agents
    opacity: np.ndarray  # (L,)

    def colors(self) -> np.ndarray:
        """(L, 4) RGBA in [0, 1]."""
        return np.array([rgba(LINK_COLOR, float(opacity)) for opacity in self.opacity]).reshape(-1, 4)


def drawn_links(position: np.ndarray, link: np.ndarray, age: np.ndarray) -> DrawnLinks:
    """Pairs of which at least one hears the other, as clear as the older of what the two know of each other is fresh.

    Args:
        position: (N, 2) [m].
        link, age: (N, N) of :class:`~marlbc_mj.supervisors.communication.Hearing`, or (0, 0) where there are none.
    """
    ends = np.argwhere(np.triu(link | link.T, 1))
    if len(ends) > MOST_LINKS:
        length = np.linalg.norm(position[ends[:, 0]] - position[ends[:, 1]], axis=1)
        ends = ends[np.sort(np.argsort(length, kind="stable")[:MOST_LINKS])]
    older = np.maximum(age, age.T)[ends[:, 0], ends[:, 1]]
    return DrawnLinks(ends, np.maximum(CLEAREST * 0.5 ** (older / HALF_LIFE), FAINTEST))


def links_of_log(log: EpisodeLog, step: int) -> DrawnLinks:
    """The links of a mission step of a log."""
    return drawn_links(log.position[step], log.link[step], log.age[step])
