"""Shared by all tests: hypothesis settings, and the expensive episodes, each run once per session."""

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

if find_spec("triton"):  # as builds of torch with CUDA have it; its LLVM crashes if a software renderer's is loaded first
    import_module("torch._dynamo")

settings.register_profile("marlbc", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("marlbc")

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a job in the background; the programs that tests interrupt inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

MOST_WORKERS = 8  # of parallel tests: each takes up to 1.2 GB
FIRST = ("test_train_run.py", "test_cli.py", "test_study.py", "test_report.py", "test_ending.py")
"""Files whose tests take longest, or share what takes long to make. They run first, so that workers end together."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One worker per core that this process may use, up to a bound."""
    return min(MOST_WORKERS, len(os.sched_getaffinity(0)))


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--slow``: also the tests that take over about five seconds each, as ``make test-all`` does."""
    parser.addoption("--slow", action="store_true", help="also run tests marked slow")


def pytest_sessionstart() -> None:
    """While tests are collected nothing becomes garbage."""
    gc.disable()


def pytest_collection_finish() -> None:
    """What was imported stays until the end, so that later searches for garbage need not look through it."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests, unless they are asked for; of several files those of :data:`FIRST` come first."""
    items.sort(key=lambda item: item.path.name not in FIRST)
    if not config.getoption("--slow"):
        kept, left = [], []
        for item in items:
            (left if item.get_closest_marker("slow") else kept).append(item)
        items[:] = kept
        config.hook.pytest_deselected(items=left)


@pytest.fixture(scope="module")
def coarse_figures() -> Iterator[None]:
    """Figures of 75 dpi in the place of 300, which take a third of the time: for tests of what a command writes, not of what its
    figures show.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(import_module("marlbc_mj.report.plotting")._STYLE, "savefig.dpi", 75)
        yield


@pytest.fixture
def quick_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The warm-up of a quarter of the worlds, and a tenth of the auto-encoder's training: for tests that compare two learners."""
    monkeypatch.setattr("marlbc_mj.training.trainer.WARM_UP", 1_250)
    monkeypatch.setattr("marlbc_mj.training.codes.MINIBATCHES", 50)


Episode = Callable[..., "Trajectory"]


@pytest.fixture(scope="session")
def episode() -> Episode:
    """``episode(supervisor, controller, native=None, **scenario changes)``: a whole case-study episode, kept for the session."""
    from marlbc_mj import World, make_controller, make_supervisor, paper, run_episode  # not where pytest only shares tests out

    @cache
    def run(supervisor: str, controller: str, native: bool | None = None, **changes: Any) -> "Trajectory":
        world = World(paper(**changes), make_controller(controller), record=True, native=native)
        return run_episode(world, make_supervisor(supervisor), names=(supervisor, controller))

    return run
