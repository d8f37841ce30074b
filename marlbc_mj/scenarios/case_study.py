"""The paper's case study: four agents, two points and a gate of four discs on a 100 m path (section 4.1, Tables 1 and 2)."""

from typing import Any

from marlbc_mj.scenarios.base import Obstacle, Scenario, Window, standard_behaviors, with_changes

STARTS = ((-2.0, 8.0), (-2.0, -8.0), (-7.0, 14.0), (-7.0, -14.0))
SLOTS = ((2.5, 6.0), (2.5, -6.0), (-2.5, 12.0), (-2.5, -12.0))
COLUMN = ((4.5, 0.0), (1.5, 0.0), (-1.5, 0.0), (-4.5, 0.0))
"""Gamma_i p_c_i with Gamma_3 and Gamma_4 positive; with the published signs two pairs of slots coincide (erratum 4)."""
OBSTACLES = (
    Obstacle(20, 5),
    Obstacle(40, -11),
    Obstacle(60, 9, 5),
    Obstacle(70, 9, 5),
    Obstacle(60, -9, 5),
    Obstacle(70, -9, 5),
)
SCHEDULE = (
    Window(18.1, 21.9, 0, "OA>FM"),
    Window(43.1, 46.9, 3, "OA>FM"),
    Window(50.0, 82.5, -1, "FR"),
)
"""As few switches as the geometry allows: the slots of agents 1 and 4 pass a point obstacle at 1 m; every slot hits a disc."""


def paper(*, two_sided: bool = False, **changes: Any) -> Scenario:
    """The case study; ``changes`` replace any field of :class:`Scenario`, ``two_sided`` selects the published OA (erratum 6).

    A changed ``safe_distance`` applies both to OA and to the test for violations.
    """
    distance = changes.get("safe_distance", 2.0)
    fields: dict[str, Any] = {
        "name": "paper",
        "starts": STARTS,
        "behaviors": standard_behaviors(SLOTS, COLUMN, two_sided=two_sided, safe_distance=distance),
        "path_origin": (-2.5, 0.0),
        "path_velocity": (1.0, 0.0),
        "obstacles": OBSTACLES,
        "schedule": SCHEDULE,
        "description": "four agents, two points and a gate on a 100 m path: the paper's case study",
    }
    return with_changes(fields, changes)


def cruise(**changes: Any) -> Scenario:
    """The case study's team, in formation from the start, on an oblique path without obstacles.

    Motion along y sweeps the drag (43) through its periods while forces stay small, which shows whether an identifier learns.
    """
    fields: dict[str, Any] = {
        "name": "cruise",
        "starts": tuple((x - 2.5, y) for x, y in SLOTS),
        "path_velocity": (1.0, 0.5),
        "obstacles": (),
        "schedule": (Window(0.0, 0.0, -1, "FM"),),
        "description": "the same team in formation on an oblique path, nothing in the way: identification of the drag",
    }
    return paper(**{**fields, **changes})
