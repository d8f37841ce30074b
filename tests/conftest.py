"""Settings and fixtures shared by all tests: hypothesis profile, order of files, and episodes that run once per session."""

import gc
import os
import signal
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from marlbc_mj.episode import Trajectory

if find_spec("triton"):  # CUDA builds of torch include it; its LLVM crashes if a software renderer has loaded one first
    import_module("torch._dynamo")

settings.register_profile("marlbc", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("marlbc")

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in background jobs; programs that tests interrupt would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

MOST_WORKERS = 8  # most parallel test processes; each takes up to 1.2 GB of memory
FIRST = ("test_train_run.py", "test_cli.py", "test_study.py", "test_report.py", "test_ending.py")
"""Files with the longest tests or the slowest shared fixtures. They run first, so that all workers end at about the same time."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Number of workers: one per core that this process may use, at most MOST_WORKERS."""
    return min(MOST_WORKERS, len(os.sched_getaffinity(0)))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--slow``, which also runs tests of more than about five seconds each; ``make test-all`` uses it."""
    parser.addoption("--slow", action="store_true", help="also run tests marked slow")


def pytest_sessionstart() -> None:
    """Switch garbage collection off while tests are collected, as nothing becomes garbage then."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Exclude all existing objects from later garbage collections, as imported modules stay until the end."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Move the files in :data:`FIRST` to the front, and deselect slow tests unless ``--slow`` is given."""
    items.sort(key=lambda item: item.path.name not in FIRST)
    if not config.getoption("--slow"):
        kept, left = [], []
        for item in items:
            (left if item.get_closest_marker("slow") else kept).append(item)
        items[:] = kept
        config.hook.pytest_deselected(items=left)


@pytest.fixture(scope="module")
def coarse_figures() -> Iterator[None]:
    """Figures at 75 dpi instead of 300, drawn in a third of the time, for tests that do not check what figures show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(import_module("marlbc_mj.report.plotting")._STYLE, "savefig.dpi", 75)
        yield


@pytest.fixture
def quick_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the warm-up and a tenth of the auto-encoder's training, for tests that compare two learners."""
    monkeypatch.setattr("marlbc_mj.training.trainer.WARM_UP", 1_250)
    monkeypatch.setattr("marlbc_mj.training.codes.MINIBATCHES", 50)


Episode = Callable[..., "Trajectory"]


@pytest.fixture(scope="session")
def episode() -> Episode:
    """``episode(supervisor, controller, native=None, **scenario_changes)`` runs a case-study episode once and caches it."""
    from marlbc_mj import World, make_controller, make_supervisor, paper, run_episode  # not needed by the main process of xdist

    @cache
    def run(supervisor: str, controller: str, native: bool | None = None, **changes: Any) -> "Trajectory":
        world = World(paper(**changes), make_controller(controller), record=True, native=native)
        return run_episode(world, make_supervisor(supervisor), names=(supervisor, controller))

    return run
