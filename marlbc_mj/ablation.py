"""Ablations of the controller: what each choice is worth, measured on whole episodes."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from marlbc_mj import laws
from marlbc_mj.controllers import PD, SORLC, Controller
from marlbc_mj.disturbances import PaperDrag
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.errors import SimulationError
from marlbc_mj.scenarios import Scenario, cruise, paper
from marlbc_mj.scenarios.case_study import SLOTS
from marlbc_mj.supervisors import Scripted

RATES = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)
WIDTHS = (2.0, 4.0, 6.0)


class Row(NamedTuple):
    """One run: team RMS of the velocity and the position error, or why there is none."""

    study: str
    drag_scale: float
    controller: str
    rms_velocity_error: float | None  # [m/s]
    rms_position_error: float | None  # [m]
    over_off: float | None  # RMS velocity error of ``off`` in the same study over this one's
    failure: str = ""


@laws.controller
def exact_model(params, state, p, v, p_r, v_r, drag, h, force_out):  # type: ignore[no-untyped-def]
    """PD plus perfect knowledge of f: u = clip(-k_p e_p - k_v e_v - f); the limit of what any identifier can reach."""
    for axis in range(2):
        wish = -params[0] * (p[axis] - p_r[axis]) - params[1] * (v[axis] - v_r[axis]) - drag[axis]
        force_out[axis] = laws.clip(wish, params[2])


class ExactModel(PD):
    """The gains of :class:`PD` with :func:`exact_model`."""

    law = staticmethod(exact_model)


def half_mission(scale: float) -> Scenario:
    """The case study's first 50 s from the slots: both points, no jump of the reference that the drag times 20 would turn
    into a fall.
    """
    starts = tuple((x - 2.5, y) for x, y in SLOTS)
    return paper(starts=starts, duration=50.0, disturbance=PaperDrag(scale))


def studies() -> dict[str, tuple[Scenario, float]]:
    """Scenario and drag scale of each study of the basis."""
    made = {f"case study, drag x{scale:g}": (paper(disturbance=PaperDrag(scale)), scale) for scale in (0.0, 1.0, 5.0, 20.0)}
    made["first half, drag x20"] = (half_mission(20.0), 20.0)
    made["cruise, drag x20"] = (cruise(disturbance=PaperDrag(20.0)), 20.0)
    return made


def variants() -> dict[str, Controller]:
    """The bases, and the limit that a perfectly known drag sets."""
    return {"off": SORLC(basis="off"), "printed": SORLC(), "scaled": SORLC.scaled(), "exact model": ExactModel()}


def basis_study(progress: Callable[[str, float, float], None] | None = None) -> list[Row]:
    """Every basis in every study."""
    say = progress or (lambda what, done, total: None)
    rows: list[Row] = []
    total = len(studies()) * len(variants())
    for study, (scenario, scale) in studies().items():
        rows.extend(_compare(study, scenario, scale, variants()))
        say("basis", len(rows), total)
    return rows


def gain_sweep(progress: Callable[[str, float, float], None] | None = None) -> list[Row]:
    """Learning rate and width of the scaled basis on the cruise with the drag multiplied by 20; ``off`` is the first row."""
    say = progress or (lambda what, done, total: None)
    scenario = cruise(disturbance=PaperDrag(20.0))
    grid: dict[str, Controller] = {"off": SORLC(basis="off")}
    grid |= {
        f"rate {rate:g}, width {width:g}": SORLC.scaled(identifier_rate=rate, width=width) for rate in RATES for width in WIDTHS
    }
    rows = []
    for row in _compare("sweep on the cruise, drag x20", scenario, 20.0, grid):
        rows.append(row)
        say("gain sweep", len(rows), len(grid))
    return rows


def _compare(study: str, scenario: Scenario, scale: float, controllers: dict[str, Controller]) -> Iterator[Row]:
    """Rows of one study; the first controller is what the others are compared with."""
    reference: float | None = None
    for name, controller in controllers.items():
        try:
            velocity_error, position_error = _rms(scenario, controller)
        except SimulationError as error:
            yield Row(study, scale, name, None, None, None, str(error).split(":")[0])
            continue
        reference = reference or velocity_error
        yield Row(study, scale, name, velocity_error, position_error, reference / velocity_error)


def _rms(scenario: Scenario, controller: Controller) -> tuple[float, float]:
    """Root of the mean squared velocity [m/s] and position [m] error over all agents and substeps."""
    trajectory = run_episode(World(scenario, controller, record=True), Scripted())
    velocity = trajectory.velocity[:-1] - trajectory.reference_velocity
    position = trajectory.position[:-1] - trajectory.reference
    return tuple(float(np.sqrt((e**2).sum(-1).mean())) for e in (velocity, position))  # type: ignore[return-value]


def markdown(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| study | controller | RMS velocity error, m/s | RMS position error, m | off / this |",
        "|---|---|---:|---:|---:|",
    ]
    for row in rows:
        if row.rms_velocity_error is None:
            lines.append(f"| {row.study} | {row.controller} | diverged ({row.failure}) | | |")
        else:
            figures = f"{row.rms_velocity_error:.4f} | {row.rms_position_error:.4f} | {row.over_off:.2f}"
            lines.append(f"| {row.study} | {row.controller} | {figures} |")
    return "\n".join(lines)
