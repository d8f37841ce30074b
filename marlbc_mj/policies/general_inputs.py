"""Features that an agent of any team senses, sends and pools: inputs of the general policy (project).

All features are relative and dimensionless: lengths in units of the safe distance d_OA, times in units of the settling time
T = d_OA / v_max + 1 / min(Lambda, alpha), in which a reference covers d_OA and settles. So larger or slower robots and teams of
any size have the same features. An agent needs its own position, its two slots, the path with its end and the obstacles around
its lanes. The inputs contain neither a place on the map nor a list of obstacles.

A *lane* is the track of a slot along the path. Its profile is the least clearance from obstacles, beyond d_OA, in each of several
time bins around the present. Slot and obstacle both move in straight lines, so it is computed exactly, without sampling.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import allocation_free, compiled
from marlbc_mj.engine.inequalities import make_barrier
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError

EDGES = (-5.0, -2.5, 0.0, 2.0, 4.0, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 24.0)
"""Bounds of a lane's time bins, in settling times from now."""
LANE_BINS = len(EDGES) - 1
LEAST_BEYOND, MOST_BEYOND = -1.0, 3.0
"""Clearances beyond d_OA are clipped to this range [d_OA]."""
COARSE = 5.0
"""The coarse scale of slot errors [d_OA], and the finer scale of ages and of the time left [T]."""
COARSEST = 20.0
"""The coarse scale of ages and of the time left [T]."""

WAY_DELAYS = (0.0, 1.2, 2.4, 3.6, 6.0)
"""Times until an agent sets out for a slot, for which the clearance of its way is known, in settling times."""

LANES = 2 * LANE_BINS
"""Entries 0 to LANES - 1: lane profiles of the slot in the formation and of the slot in the column."""
FORMATION_WAY, COLUMN_WAY = LANES, LANES + len(WAY_DELAYS)
"""First of the entries for the way to each slot, one for every delay; the first is for an agent that sets out at once."""
WAYS = LANES + 2 * len(WAY_DELAYS)
"""Entries LANES to WAYS - 1: clearances of the ways to both slots."""
ERRORS = WAYS + 4
"""Entries WAYS to ERRORS - 1: distances from both slots, each on two scales."""
COLUMN_ENTRY, AGE_ENTRIES, CLEARANCE_ENTRY = ERRORS, ERRORS + 1, ERRORS + 3
"""Next entries: whether the agent's command is the column, the command's age on two scales, and the present clearance."""
SENT = CLEARANCE_ENTRY + 1
"""M, number of entries that an agent sends."""
ENDING = SENT
"""Entries from ENDING on: nearness of the mission's end on two scales; not sent, since all agents know it."""
FEATURES = ENDING + 2
"""F, number of features of an agent."""
POOLED = 2 * SENT + (AGE_ENTRIES + 2 - WAYS) + 2
"""Number of pooled entries: minima, means, maxima of errors, column flag and ages, share of agents heard, oldest age."""
INPUTS = FEATURES + POOLED
"""S, number of inputs of a network."""
INPUT_LAYOUT: dict[str, float | list[float]] = {
    **{"version": 3, "features": FEATURES, "sent": SENT, "pooled": POOLED, "edges": list(EDGES), "delays": list(WAY_DELAYS)},
    **{"nearest": LEAST_BEYOND, "farthest": MOST_BEYOND, "far": COARSE, "old": COARSEST},
}
"""Layout of the inputs, for which a network's weights are valid; ``version`` increases when the meaning of entries changes."""


class Sight(NamedTuple):
    """The data needed to compute the features of one scenario's teams."""

    slots: np.ndarray  # (2, N, 2) slots of formation and column around the desired centroid [m]
    path: np.ndarray  # (2, 2) p_cd(0) [m] and its velocity [m/s]
    edges: np.ndarray  # (LANE_BINS + 1,) bounds of the lanes' time bins [s]
    delays: np.ndarray  # WAY_DELAYS [s]
    speed: float  # v_max [m/s]
    length: float  # d_OA [m]
    time: float  # T [s]
    end: float  # end of the mission [s]
    is_column: np.ndarray  # (C,) bool, whether a command ends in the column


def settling_time(scenario: Scenario) -> float:
    """T = d_OA / v_max + 1 / min(Lambda, alpha) [s], with v_max and alpha of the set-based composition."""
    barrier = make_barrier(scenario)
    gains = [b.gain for b in scenario.behaviors if b.name in scenario.formation_names]  # type: ignore[attr-defined]
    return float(scenario.safe_distance / barrier.speed + 1.0 / min(*gains, barrier.rate))


def make_sight(scenario: Scenario) -> Sight:
    """The :class:`Sight` of a scenario.

    Raises:
        ConfigurationError: the path is at rest, or formation and column have the same slots.
    """
    path = np.array([scenario.path_origin, scenario.path_velocity], dtype=np.float64)
    slots = np.ascontiguousarray(scenario.formations)
    if not path[1].any():
        raise ConfigurationError(f"scenario {scenario.name!r} has a path at rest, so there are no lanes along it")
    if np.abs(slots[0] - slots[1]).max() < 1e-9:
        first, second = scenario.formation_names
        raise ConfigurationError(f"scenario {scenario.name!r} has no column: {second} has the same slots as {first}")
    unit = settling_time(scenario)
    columns = [name.endswith(scenario.formation_names[1]) for name in scenario.orders.commands]
    edges, delays, speed = unit * np.array(EDGES), unit * np.array(WAY_DELAYS), float(make_barrier(scenario).speed)
    return Sight(slots, path, edges, delays, speed, float(scenario.safe_distance), unit, scenario.duration, np.array(columns))


def sense_features(observation: Observation, sight: Sight) -> np.ndarray:
    """(B, N, F) float32 features that each agent senses by itself; the constants of this module define the entries."""
    features = np.empty((*observation.position.shape[:2], FEATURES), dtype=np.float32)
    arrays = observation.time, observation.position, observation.clearance, observation.age, observation.obstacles
    _fill_features(sight, sight.is_column[observation.command], *map(np.ascontiguousarray, arrays), features)
    return features


@compiled
def _fill_features(sight, column, time, position, clearance, age, obstacles, features):
    """Fill ``features`` (B, N, F), see :func:`sense_features`; ``column`` (B, N) bool, other arguments as in an observation."""
    slot, lane, ways = np.empty(2), np.empty(LANE_BINS), np.empty(len(WAY_DELAYS))
    for b in range(position.shape[0]):
        for i in range(position.shape[1]):
            row = features[b, i]
            for which in range(2):
                for axis in range(2):
                    centre = sight.path[0, axis] + time[b] * sight.path[1, axis]
                    slot[axis] = centre + sight.slots[which, i, axis]
                fill_lane(slot, sight, obstacles[b], lane)
                for k in range(LANE_BINS):
                    row[which * LANE_BINS + k] = lane[k]
                fill_ways(position[b, i], slot, sight, obstacles[b], ways)
                for k in range(len(WAY_DELAYS)):
                    row[LANES + which * len(WAY_DELAYS) + k] = ways[k]
                error = np.sqrt((position[b, i, 0] - slot[0]) ** 2 + (position[b, i, 1] - slot[1]) ** 2) / sight.length
                row[WAYS + 2 * which] = np.tanh(error)
                row[WAYS + 2 * which + 1] = np.tanh(error / COARSE)
            row[COLUMN_ENTRY] = 1.0 if column[b, i] else 0.0
            row[AGE_ENTRIES] = 1.0 - np.exp(-age[b, i] / (COARSE * sight.time))
            row[AGE_ENTRIES + 1] = 1.0 - np.exp(-age[b, i] / (COARSEST * sight.time))
            row[CLEARANCE_ENTRY] = _beyond(clearance[b, i], sight.length)
            left = max(sight.end - time[b], 0.0) / sight.time
            row[ENDING] = np.exp(-left / COARSE)
            row[ENDING + 1] = np.exp(-left / COARSEST)


@allocation_free
def _beyond(clearance, length):
    """Clearance beyond d_OA = ``length`` [m], in units of d_OA, clipped."""
    return min(max(clearance / length - 1.0, LEAST_BEYOND), MOST_BEYOND)


@allocation_free
def fill_lane(slot, sight, obstacles, lane):
    """Write the profile of the lane of a slot, now at ``slot`` (2,) [m], to ``lane`` (LANE_BINS,) [d_OA]."""
    for k in range(LANE_BINS):
        lane[k] = MOST_BEYOND
    first, last = sight.edges[0], sight.edges[LANE_BINS]
    middle, half = 0.5 * (first + last), 0.5 * (last - first)
    u, w = sight.path[1, 0], sight.path[1, 1]
    square = u * u + w * w
    reach = half * np.sqrt(square)
    for o in range(obstacles.shape[0]):
        x, y = slot[0] - obstacles[o, 0], slot[1] - obstacles[o, 1]
        if obstacles.shape[1] > 3:
            u, w = sight.path[1, 0] - obstacles[o, 3], sight.path[1, 1] - obstacles[o, 4]
            square = u * u + w * w
            reach = half * np.sqrt(square)
        if _cannot_reach(x + middle * u, y + middle * w, reach, obstacles[o, 2], sight.length):
            continue
        when = -(x * u + y * w) / square if square > 0.0 else 0.0
        aside = (x + when * u) ** 2 + (y + when * w) ** 2
        for k in range(LANE_BINS):
            t = min(max(when, sight.edges[k]), sight.edges[k + 1])
            distance = np.sqrt(aside + square * (t - when) ** 2)
            lane[k] = min(lane[k], _beyond(distance - obstacles[o, 2], sight.length))


@allocation_free
def fill_ways(p, slot, sight, obstacles, ways):
    """Write the least clearance on the way from ``p`` (2,) to a slot, now at ``slot`` (2,) [m], to ``ways`` [d_OA], per delay.

    Until it sets out, the agent moves along with the path. Then it approaches the slot at v_max relative to the slot, which moves
    on. So a way is a straight line in space, and moves along with the path until the agent sets out.
    """
    x, y = slot[0] - p[0], slot[1] - p[1]
    way = np.sqrt(x * x + y * y)
    duration = way / sight.speed
    for k in range(sight.delays.shape[0]):
        ways[k] = MOST_BEYOND
    u, w = sight.path[1, 0], sight.path[1, 1]
    farthest = way + np.sqrt(u * u + w * w) * (duration + sight.delays[-1])
    for o in range(obstacles.shape[0]):
        a, b = p[0] - obstacles[o, 0], p[1] - obstacles[o, 1]
        if obstacles.shape[1] > 3:
            u, w = sight.path[1, 0] - obstacles[o, 3], sight.path[1, 1] - obstacles[o, 4]
            farthest = way + np.sqrt(u * u + w * w) * (duration + sight.delays[-1])
        if _cannot_reach(a, b, farthest, obstacles[o, 2], sight.length):
            continue
        along, across = x + duration * u, y + duration * w  # the way relative to the obstacle
        square = along * along + across * across
        for k in range(sight.delays.shape[0]):
            c, d = a + sight.delays[k] * u, b + sight.delays[k] * w
            share = min(max(-(c * along + d * across) / square, 0.0), 1.0) if square > 0.0 else 0.0
            distance = np.sqrt((c + share * along) ** 2 + (d + share * across) ** 2)
            ways[k] = min(ways[k], _beyond(distance - obstacles[o, 2], sight.length))


@allocation_free
def _cannot_reach(x, y, way, radius, length):
    """Whether an obstacle at offset (x, y) [m] is too far to affect clipped clearances at points within ``way`` [m]."""
    return x * x + y * y > (way + (1.0 + MOST_BEYOND) * length + radius) ** 2


@compiled
def pool_heard(heard, age):
    """(B, R, POOLED) float32, pooled messages of R receivers of B teams; R = 1 if all agents have heard the same.

    Minima, means and maxima are over the senders heard so far. For lanes and ways, the mean is the share of negative
    clearances, that is of blocked ones.

    Args:
        heard: (B, R, N, M) float32, last message heard from each sender.
        age: (B, R, N) age of these messages [T]; infinite where nothing was heard.
    """
    pooled = np.empty((heard.shape[0], heard.shape[1], POOLED), dtype=np.float32)
    changing = AGE_ENTRIES + 2 - WAYS
    senders = heard.shape[2]
    for b in range(heard.shape[0]):
        for r in range(heard.shape[1]):
            row = pooled[b, r]
            least, total, most = row[:SENT], row[SENT : 2 * SENT], row[2 * SENT : 2 * SENT + changing]
            least[:], total[:], most[:] = np.inf, 0.0, -np.inf
            count, oldest = 0, 0.0
            for s in range(senders):
                if not np.isfinite(age[b, r, s]):
                    continue
                count, oldest = count + 1, max(oldest, age[b, r, s])
                for j in range(SENT):
                    entry = heard[b, r, s, j]
                    least[j] = min(least[j], entry)
                    total[j] += entry if j >= WAYS else np.float32(entry < 0.0)
                for j in range(changing):
                    most[j] = max(most[j], heard[b, r, s, WAYS + j])
            if count < senders:  # agents not heard count as MOST_BEYOND in minima and as 0 in maxima
                least[:], most[:] = np.minimum(least, np.float32(MOST_BEYOND)), np.maximum(most, np.float32(0.0))
            count = max(count, 1)
            for j in range(SENT):
                total[j] /= count
            row[2 * SENT + changing] = count / senders
            row[2 * SENT + changing + 1] = 1.0 - np.exp(-oldest / COARSE)
    return pooled


def join_inputs(features: np.ndarray, heard: np.ndarray, age: np.ndarray) -> np.ndarray:
    """(B, N, S) float32 inputs of the network: each agent's ``features`` (B, N, F), then its pooled messages.

    ``heard`` (B, N, N, M) and ``age`` (B, N, N) [T] as in :func:`pool_heard`, or (B, 1, N, M) and (B, 1, N) if all agents have
    heard the same.
    """
    inputs = np.empty((*features.shape[:2], INPUTS), dtype=np.float32)
    _fill_inputs(features, np.ascontiguousarray(heard, dtype=np.float32), np.ascontiguousarray(age), inputs)
    return inputs


@compiled
def _fill_inputs(features, heard, age, inputs):
    """Fill ``inputs`` (B, N, S), see :func:`join_inputs`."""
    pooled = pool_heard(heard, age)
    for b in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            inputs[b, i, :FEATURES] = features[b, i]
            inputs[b, i, FEATURES:] = pooled[b, min(i, heard.shape[1] - 1)]
