"""``marlbc list``: everything that can be selected by name, with one line each."""

from dataclasses import dataclass

_BASES = ("inputs as in the paper", "inputs relative to the reference", "no networks")
_COMPOSITIONS = ("avoidance as an equality task, projected (12)", "avoidance as an inequality: a bound on the velocity")
_REFERENCES = ("behaviors at the reference's own position", "behaviors at the measured position")


def selectable() -> dict[str, dict[str, str]]:
    """Descriptions by kind and name."""
    from marlbc_mj.controllers import CONTROLLERS
    from marlbc_mj.controllers.sorlc import BASES
    from marlbc_mj.core.disturbances import DISTURBANCES
    from marlbc_mj.robots import ROBOTS
    from marlbc_mj.scenarios import SCENARIOS
    from marlbc_mj.scenarios.base import COMPOSITIONS, REFERENCE_MODES
    from marlbc_mj.scenarios.formations import FORMATIONS
    from marlbc_mj.supervisors import SUPERVISORS
    from marlbc_mj.training.config import PRESETS
    from marlbc_mj.training.general.config import GENERAL, GENERAL_SUMMARY
    from marlbc_mj.training.methods import METHODS

    return {
        "scenarios": {name: make().description for name, make in SCENARIOS.items()},
        "formations": {name: line for name, (_, line) in FORMATIONS.items()},
        "supervisors": {name: line for name, (_, line) in SUPERVISORS.items()},
        "controllers": {name: line for name, (_, line) in CONTROLLERS.items()},
        "SORLC bases": dict(zip(BASES, _BASES, strict=True)),
        "compositions": dict(zip(COMPOSITIONS, _COMPOSITIONS, strict=True)),
        "reference modes": dict(zip(REFERENCE_MODES, _REFERENCES, strict=True)),
        "disturbances": {name: line for name, (_, line) in DISTURBANCES.items()},
        "training methods": {name: line for name, (_, line) in METHODS.items()} | {GENERAL: GENERAL_SUMMARY},
        "training presets": {name: line for name, (_, line) in PRESETS.items()},
        "robots": {name: line for name, (_, line) in ROBOTS.items()},
    }


@dataclass(frozen=True)
class ListCommand:
    """List everything that can be selected, one line each."""

    def run(self) -> None:
        """Print every registry."""
        for kind, entries in selectable().items():
            print(f"{kind}:")
            width = max(map(len, entries))
            for name, line in entries.items():
                print(f"  {name:<{width}}  {line}")
