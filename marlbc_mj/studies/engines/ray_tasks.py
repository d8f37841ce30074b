"""Engine that runs jobs as Ray tasks, on the cluster that ``RAY_ADDRESS`` names or else in worker processes on this machine.

Ray repeats a task if its worker or node dies. If jobs write large files, all nodes must see the study's folder.
"""

import os
import pickle
import secrets
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.studies.engines import guard
from marlbc_mj.studies.engines.base import MOST_TRIES, EngineCallbacks, Outcome, Task, Work, attempt
from marlbc_mj.studies.protocol import JobT, ResultT
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.text import one_line

TASKS_AHEAD = 2  # tasks queued in Ray per CPU, besides the running ones
ADDRESS = "RAY_ADDRESS"
KEEPS_ENVIRONMENT = "SPT_NOENV"
"""Environment variable that keeps Ray's processes from overwriting their environment, and so the token, with their titles."""


class RayTasks:
    """Engine that runs every job as a Ray task with one CPU.

    Args:
        workers: CPUs of the Ray instance that is started for the study; not used on a cluster.

    Raises:
        ConfigurationError: Ray is not installed.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        try:
            self.ray: Any = import_module("ray")
        except ImportError as error:
            raise ConfigurationError("the engine ray needs Ray: pip install 'marlbc-mj[ray]'") from error

    def map(self, work: Work[JobT, ResultT], tasks: Sequence[Task], ears: EngineCallbacks) -> Generator[tuple[int, ResultT]]:
        if ears.stop is not None:
            raise ConfigurationError("jobs that save their own progress run on this machine only; leave out --engine ray")
        with nullcontext() if os.environ.get(ADDRESS) else _guarded(), self._connected():
            yield from self._finished(work, tasks)

    def _finished(self, work: Work[JobT, ResultT], tasks: Sequence[Task]) -> Generator[tuple[int, ResultT]]:
        ray = self.ray
        remote = ray.remote(num_cpus=1, max_retries=MOST_TRIES - 1)(_attempt)
        shared = ray.put(_Shared(pickle.dumps(work), os.getcwd(), tuple(sys.path)))
        ahead = (1 + TASKS_AHEAD) * max(1, int(ray.cluster_resources().get("CPU", 1)))
        left = list(reversed(tasks))
        places: dict[Any, int] = {}
        try:
            while left or places:
                while left and len(places) < ahead:
                    task = left.pop()
                    places[remote.remote(shared, pickle.dumps(task))] = task.place
                done, _ = ray.wait(list(places), num_returns=1)
                for each in done:
                    yield places.pop(each), self._outcome(each).unpack()
        finally:
            for each in places:
                with suppress(Exception):
                    ray.cancel(each, force=True)

    def _outcome(self, reference: Any) -> Outcome:
        exceptions = self.ray.exceptions
        try:
            found: Outcome = pickle.loads(self.ray.get(reference))  # unpickled here, so that arrays are writable
        except (exceptions.RayTaskError, exceptions.RaySystemError) as error:
            raise SimulationError(f"a Ray task failed: {one_line(str(error)[-300:])}") from error
        except exceptions.RayError as error:
            said = f"a Ray worker died {MOST_TRIES} times on the same job"
            raise SimulationError(f"{said}: {one_line(str(error)[:300])}") from error
        return found

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Connect to Ray during the block, and restore our handler of SIGTERM, which Ray replaces.

        Raises:
            ConfigurationError: the cluster cannot be reached.
        """
        main = threading.current_thread() is threading.main_thread()
        before = signal.getsignal(signal.SIGTERM) if main else None
        ray, address = self.ray, os.environ.get(ADDRESS)
        where: dict[str, Any] = {"address": address} if address else {"address": "local", "num_cpus": self.workers}
        if not address:
            where["include_dashboard"] = False
        try:
            ray.init(**where, log_to_driver=False, logging_level="ERROR", configure_logging=False)
        except Exception as error:
            raise ConfigurationError(f"cannot use Ray at {address or 'this machine'}: {one_line(error)}") from error
        try:
            if before is not None:
                signal.signal(signal.SIGTERM, before)
            yield
        finally:
            ray.shutdown()


@contextmanager
def _guarded() -> Iterator[None]:
    """Run a guard process, which ends the Ray instance started in the block if this process is killed."""
    token = secrets.token_hex(8)
    command = [sys.executable, "-I", "-S", guard.__file__, token]  # starts at once, since it does not import this package
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True) as guarding:
        try:
            with _in_environment({guard.TOKEN: token, KEEPS_ENVIRONMENT: "1"}):
                yield
        finally:
            guard.end_marked(token)  # leftover agents of a killed raylet
            guarding.terminate()


@contextmanager
def _in_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables during the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class _Shared(NamedTuple):
    """Data that all tasks share."""

    work: bytes  # pickled, since it can be read only with the study's search path
    folder: str
    path: tuple[str, ...]


def _attempt(shared: _Shared, pickled: bytes) -> bytes:
    """Run a job on a worker, in the study's working folder if it exists there, and with the study's search path added."""
    if Path(shared.folder).is_dir():
        os.chdir(shared.folder)
    sys.path += [entry for entry in shared.path if entry not in sys.path]
    work: Work[Any, Any] = pickle.loads(shared.work)
    return pickle.dumps(attempt(work.visible(), pickle.loads(pickled)))
