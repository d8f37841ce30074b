# The package's public names and where each of them lives; __init__.py reads this file.
from .controllers import PD as PD
from .controllers import SORLC as SORLC
from .controllers import make_controller as make_controller
from .core import laws as laws
from .engine.world import World as World
from .episode import Trajectory as Trajectory
from .episode import run_episode as run_episode
from .recording.reader import read_log as read_log
from .recording.video import render_video as render_video
from .recording.writer import LogWriter as LogWriter
from .results.metrics import measure as measure
from .scenarios import Scenario as Scenario
from .scenarios import make_scenario as make_scenario
from .scenarios import paper as paper
from .studies.bench import run_bench as run_bench
from .supervisors import FSAMS as FSAMS
from .supervisors import Scripted as Scripted
from .supervisors import make_supervisor as make_supervisor
from .util.errors import ConfigurationError as ConfigurationError
from .util.errors import MarlbcError as MarlbcError
from .util.errors import SimulationError as SimulationError

__version__: str
