"""Engines, which run the jobs of a study in processes on this machine, on a Ray cluster, or in a SLURM job array."""

from collections.abc import Callable
from typing import Literal

from marlbc_mj.studies.engines.base import Engine, JobError, Task, Work
from marlbc_mj.util.errors import ConfigurationError, unknown

__all__ = ["ENGINES", "Engine", "EngineName", "JobError", "Task", "Work", "make_engine"]

EngineName = Literal["local", "ray", "slurm"]


def _local(workers: int) -> Engine:
    from marlbc_mj.studies.engines.local import Processes, ThisProcess

    return ThisProcess() if workers == 1 else Processes(workers)


def _ray(workers: int) -> Engine:
    from marlbc_mj.studies.engines.ray_tasks import RayTasks

    return RayTasks(workers)


def _slurm(workers: int) -> Engine:
    from marlbc_mj.studies.engines.slurm_arrays import SlurmArray

    return SlurmArray(workers)


ENGINES: dict[str, Callable[[int], Engine]] = {"local": _local, "ray": _ray, "slurm": _slurm}
"""Factories of engines by name, called with the number of workers."""


def make_engine(name: str, workers: int = 1) -> Engine:
    """The engine of this name.

    Args:
        name: a key of :data:`ENGINES`.
        workers: processes on this machine, CPUs of the Ray instance started for this study, or tasks of a SLURM array.

    Raises:
        ConfigurationError: unknown name, fewer than one worker, or something that the engine needs is not installed.
    """
    if name not in ENGINES:
        raise unknown("engine", name, ENGINES)
    if workers < 1:
        raise ConfigurationError(f"workers must be at least 1, got {workers}")
    return ENGINES[name](workers)
