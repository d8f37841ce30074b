"""marlbc_mj: a MuJoCo benchmark for teams of robots that must decide and control at once."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from marlbc_mj.controllers import PD, SORLC, make_controller
    from marlbc_mj.core import laws
    from marlbc_mj.engine.world import World
    from marlbc_mj.episode import Trajectory, run_episode
    from marlbc_mj.recording.reader import read_log
    from marlbc_mj.recording.video import render_video
    from marlbc_mj.recording.writer import LogWriter
    from marlbc_mj.results.metrics import measure
    from marlbc_mj.scenarios import Scenario, make_scenario, paper
    from marlbc_mj.studies.bench import run_bench
    from marlbc_mj.supervisors import FSAMS, Scripted, make_supervisor
    from marlbc_mj.util.errors import ConfigurationError, MarlbcError, SimulationError

__version__ = "0.1.0"

_HOMES = {
    "laws": "marlbc_mj.core.laws",
    "run_bench": "marlbc_mj.studies.bench",
    "PD": "marlbc_mj.controllers",
    "SORLC": "marlbc_mj.controllers",
    "make_controller": "marlbc_mj.controllers",
    "World": "marlbc_mj.engine.world",
    "Trajectory": "marlbc_mj.episode",
    "run_episode": "marlbc_mj.episode",
    "ConfigurationError": "marlbc_mj.util.errors",
    "MarlbcError": "marlbc_mj.util.errors",
    "SimulationError": "marlbc_mj.util.errors",
    "measure": "marlbc_mj.results.metrics",
    "read_log": "marlbc_mj.recording.reader",
    "render_video": "marlbc_mj.recording.video",
    "LogWriter": "marlbc_mj.recording.writer",
    "Scenario": "marlbc_mj.scenarios",
    "make_scenario": "marlbc_mj.scenarios",
    "paper": "marlbc_mj.scenarios",
    "FSAMS": "marlbc_mj.supervisors",
    "Scripted": "marlbc_mj.supervisors",
    "make_supervisor": "marlbc_mj.supervisors",
}
"""Public names load when first used, so that the command line can choose a renderer before MuJoCo is imported."""

__all__ = [
    "FSAMS",
    "PD",
    "SORLC",
    "ConfigurationError",
    "LogWriter",
    "MarlbcError",
    "Scenario",
    "Scripted",
    "SimulationError",
    "Trajectory",
    "World",
    "laws",
    "make_controller",
    "make_scenario",
    "make_supervisor",
    "measure",
    "paper",
    "read_log",
    "render_video",
    "run_bench",
    "run_episode",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'marlbc_mj' has no attribute {name!r}")
    home = import_module(_HOMES[name])
    return home if name == "laws" else getattr(home, name)
