"""The questions of ``marlbc ablation``, by name."""

from collections.abc import Sequence
from itertools import product
from typing import Literal

from marlbc_mj.controllers import PD, SORLC, Controller, largest_stable_substep
from marlbc_mj.core import laws
from marlbc_mj.core.disturbances import PaperDrag
from marlbc_mj.scenarios import Scenario, cruise, paper
from marlbc_mj.scenarios.base import REFERENCE_MODES
from marlbc_mj.scenarios.case_study import SLOTS
from marlbc_mj.studies.ablation.cases import AblationRow, Case, Figures, Question
from marlbc_mj.util.errors import check_named_once, unknown

DRAG_SCALES = (0.0, 1.0, 5.0, 20.0)
RATES = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0)
WIDTHS = (2.0, 4.0, 6.0)
BASES_COMPARED: tuple[Literal["off", "published", "scaled"], ...] = ("off", "published", "scaled")
SIGNS: dict[str, Literal[-1, 1]] = {"−": -1, "+": 1}
SUBSTEPS = (0.010, 0.005, 0.002, 0.001)  # [s]
TRACKING = ("velocity_error", "position_error", "ratio")
MISSION = ("total", "switches", "violation_time", "clearance", "effort", "velocity_error", "ratio")


@laws.controller(gains=("position_gain", "velocity_gain", "limit"))
def exact_model(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """PD plus perfect knowledge of f, the best that any identifier could achieve: u = clip(-k_p e_p - k_v e_v - f)."""
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        wish = -gains.position_gain * e_p - gains.velocity_gain * e_v - drag[axis]
        force_out[axis] = laws.clip(wish, gains.limit)


class ExactModel(PD):
    """Controller with the gains of :class:`PD` and the law :func:`exact_model`."""

    law = staticmethod(exact_model)

    def params(self, agent: int, limit: float) -> laws.Numbers:
        return laws.gains_of(self, limit=limit)


def half_mission(scale: float) -> Scenario:
    """The case study's first 50 s with ``scale`` times the drag, starting in the slots of the formation.

    The team passes both point obstacles. From the slots the reference has no large initial jump, which a large drag would turn
    into divergence.
    """
    starts = tuple((x - 2.5, y) for x, y in SLOTS)
    return paper(starts=starts, duration=50.0, disturbance=PaperDrag(scale))


def variants() -> dict[str, Controller]:
    """SORLC with each basis, and the exact model, which no identifier can beat, by name."""
    return {"off": SORLC(basis="off"), "published": SORLC(), "scaled": SORLC.scaled(), "exact model": ExactModel()}


def _basis_cases() -> list[Case]:
    largest = max(DRAG_SCALES)
    scenarios = [("case study", scale, paper(disturbance=PaperDrag(scale))) for scale in DRAG_SCALES]
    scenarios.append(("first half", largest, half_mission(largest)))
    scenarios.append(("cruise", largest, cruise(disturbance=PaperDrag(largest))))
    return [
        Case((name, f"{scale:g}", key), scenario, law) for name, scale, scenario in scenarios for key, law in variants().items()
    ]


def _sweep_cases() -> list[Case]:
    scenario = cruise(disturbance=PaperDrag(max(DRAG_SCALES)))
    grid = [
        Case((f"{rate:g}", f"{width:g}"), scenario, SORLC.scaled(identifier_rate=rate, width=width))
        for rate in RATES
        for width in WIDTHS
    ]
    return [Case(("off", "–"), scenario, SORLC(basis="off")), *grid]


def _sorlc_cases() -> list[Case]:
    made = []
    for scale in DRAG_SCALES:
        scenario = paper(disturbance=PaperDrag(scale))
        for basis, (mark, sign) in product(BASES_COMPARED, SIGNS.items()):
            law = SORLC.scaled(tau_sign=sign) if basis == "scaled" else SORLC(basis=basis, tau_sign=sign)
            made.append(Case((f"{scale:g}", basis, mark), scenario, law))
    return made


def _reference_cases() -> list[Case]:
    return [Case((mode,), paper(reference=mode), SORLC()) for mode in REFERENCE_MODES]


def _avoidance_cases() -> list[Case]:
    sides = {"one-sided": False, "two-sided": True}
    return [Case((name,), paper(two_sided=two_sided), SORLC()) for name, two_sided in sides.items()]


def _substep_cases() -> list[Case]:
    return [Case((f"{1e3 * substep:g}",), paper(substep=substep), SORLC()) for substep in SUBSTEPS]


def _best_of_sweep(rows: Sequence[AblationRow]) -> str:
    ran = [row for row in rows if row.figures is not None and row.settings[0] != "off"]
    if not ran:
        return "No gain of the grid holds the team."
    best = max(ran, key=lambda row: row.first_over_this or 0.0)
    shipped = SORLC.scaled()
    return (
        f"Smallest error: rate {best.settings[0]}, width {best.settings[1]}; `sorlc-scaled` has rate "
        f"{shipped.identifier_rate:g}, width {shipped.width:g}."
    )


def _stability(rows: Sequence[AblationRow]) -> str:
    """Sentences on the stability limit of the substep, and on how much the error changes below the default substep."""
    limit, default = largest_stable_substep(*SORLC().linear_gains), f"{1e3 * paper().substep:g}"
    text = f"The linear loop is stable below {1e3 * limit:.1f} ms."
    errors = {row.settings[0]: row.figures.rms_velocity_error for row in rows if row.figures is not None}
    if default not in errors:
        return text
    smallest = min(errors, key=float)
    change = errors[smallest] / errors[default] - 1.0
    return f"{text} From the default of {default} ms to {smallest} ms the RMS velocity error changes by {change:+.2%}."


def _worth_of_choices(rows: Sequence[AblationRow]) -> str:
    """A sentence on how much the sign alone and the basis alone change the error and the effort."""
    sign, basis = (_largest_changes(rows, varied) for varied in (2, 1))
    return (
        f"With the rest equal, the sign changes the RMS velocity error by at most {sign[0]:.2%} and the effort by at most "
        f"{sign[1]:.2%}, the basis by {basis[0]:.2%} and {basis[1]:.2%}."
    )


def _largest_changes(rows: Sequence[AblationRow], varied: int) -> tuple[float, float]:
    """Largest relative change of RMS velocity error and effort between rows that differ in parameter ``varied`` alone."""
    groups: dict[tuple[str, ...], list[Figures]] = {}
    for row in rows:
        if row.figures is not None:
            groups.setdefault(row.settings[:varied] + row.settings[varied + 1 :], []).append(row.figures)
    errors = [[f.rms_velocity_error for f in group] for group in groups.values()]
    efforts = [[f.effort for f in group] for group in groups.values()]
    largest = [max((max(group) / min(group) - 1.0 for group in kind), default=0.0) for kind in (errors, efforts)]
    return largest[0], largest[1]


_QUESTIONS = (
    Question(
        "basis",
        "SORLC's basis against perfect knowledge of the drag",
        "`exact model` is PD that is told the true drag: no identifier can do better. The drag is multiplied by the scale; the "
        "first half of the case study starts in the slots, and the cruise has nothing in the way.",
        ("scenario", "drag scale", "controller"),
        _basis_cases,
        TRACKING,
        block=2,
    ),
    Question(
        "sweep",
        "Learning rate and width of the scaled basis on the cruise at the largest drag scale",
        "The first row is SORLC without networks.",
        ("rate", "width"),
        _sweep_cases,
        TRACKING,
        remark=_best_of_sweep,
    ),
    Question(
        "sorlc",
        "SORLC's basis and sign of the compensator on the case study",
        "The sign is that of τ in (40): the published one is −, the reading of erratum 2 is +.",
        ("drag scale", "basis", "sign of τ"),
        _sorlc_cases,
        MISSION,
        block=1,
        remark=_worth_of_choices,
    ),
    Question(
        "reference",
        "Where behaviors are evaluated, on the case study",
        "At the reference (virtual), or at the measured position (actual), which feeds tracking errors back into the reference.",
        ("reference",),
        _reference_cases,
        MISSION,
    ),
    Question(
        "avoidance",
        "Obstacle avoidance one-sided or as the published equality task, on the case study",
        "Two-sided avoidance also attracts (erratum 6) and holds an agent on the safe distance, where the reward punishes it.",
        ("avoidance",),
        _avoidance_cases,
        MISSION,
    ),
    Question(
        "substep",
        "Physics and control step on the case study",
        "A step that is small enough leaves all figures where the next smaller one has them.",
        ("substep [ms]",),
        _substep_cases,
        MISSION,
        remark=_stability,
    ),
)

QUESTIONS: dict[str, Question] = {question.name: question for question in _QUESTIONS}
"""Every question by name, in the order of the page."""


def select_questions(names: Sequence[str]) -> tuple[Question, ...]:
    """The named questions in the given order, or all questions if no name is given.

    Raises:
        ConfigurationError: unknown name, or one given twice.
    """
    for name in names:
        if name not in QUESTIONS:
            raise unknown("study", name, QUESTIONS)
    check_named_once("study", names)
    return tuple(QUESTIONS[name] for name in names or QUESTIONS)
