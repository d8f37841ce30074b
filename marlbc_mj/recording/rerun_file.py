"""Export of a log as a recording for Rerun: plots, events and a scene in 3D.

Rerun's viewer shows only those parts of an MCAP for which it has decoders. The package ``rerun-sdk`` is optional.
"""

from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

from marlbc_mj.recording.links import links_of_log
from marlbc_mj.recording.log import EpisodeLog
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.palette import agent_color

TIMELINE = "mission"
"""Name of the timeline of mission time."""
HEIGHT = 1.2  # height of an obstacle in the scene [m]
RADIUS = 0.25  # radius of an agent, and least radius of an obstacle [m]
PAIRS = {"state": ("position", "velocity"), "reference": ("reference", "reference_velocity"), "force": ("force",)}
"""Fields of a log with two axes, by their topic in the MCAP."""


def write_rerun(log: EpisodeLog, stream: BinaryIO) -> None:
    """Write a recording: ``/state``, ``/reference``, ``/force``, ``/metrics`` and ``/priorities`` per agent, and ``/scene``.

    If agents communicate, it also has ``/communication``.

    Raises:
        ConfigurationError: ``rerun-sdk`` is not installed.
    """
    try:
        rerun: Any = import_module("rerun")
    except ImportError as error:
        raise ConfigurationError("a recording for Rerun needs its package: pip install rerun-sdk") from error
    recording = rerun.RecordingStream("marlbc", recording_id=f"{log.scenario}-{log.supervisor}-{log.controller}-{log.seed}")
    sink = recording.binary_stream()
    _write_plots(rerun, recording, log)
    _write_priorities(rerun, recording, log)
    _write_scene(rerun, recording, log)
    stream.write(sink.read())


def _write_plots(rerun: Any, recording: Any, log: EpisodeLog) -> None:
    """Write numbers over mission time, one plot per agent and field."""
    for topic, fields in PAIRS.items():
        for field in fields:
            values = getattr(log, field)
            for i in range(values.shape[1]):
                _plot(rerun, recording, f"{topic}/agent{i + 1}/{field}", log.time, values[:, i], ("x", "y"))
    for i in range(log.clearance.shape[1]):
        _plot(rerun, recording, f"metrics/agent{i + 1}/clearance", log.time, log.clearance[:, i, None], ("clearance",))
    for field in ("formation", "reward", "decision_ms"):
        _plot(rerun, recording, f"metrics/{field}", log.time, getattr(log, field)[:, None], (field,))


def _plot(rerun: Any, recording: Any, entity: str, time: np.ndarray, values: np.ndarray, names: tuple[str, ...]) -> None:
    """Write values (M, C) under ``entity``; times with a value that is not finite are left out."""
    finite = np.isfinite(values).all(axis=1)
    recording.log(entity, rerun.SeriesLines(names=names), static=True)
    columns = rerun.Scalars.columns(scalars=values[finite].astype(np.float64).ravel())
    recording.send_columns(entity, [_clock(rerun, time[finite])], columns.partition(np.full(finite.sum(), len(names))))


def _clock(rerun: Any, time: np.ndarray) -> Any:
    return rerun.TimeColumn(TIMELINE, duration=time)


def _write_priorities(rerun: Any, recording: Any, log: EpisodeLog) -> None:
    """Write every agent's command as a text whenever it changes, and as a plot of its index."""
    for i in range(log.command.shape[1]):
        entity, commands = f"priorities/agent{i + 1}", log.command[:, i]
        changed = np.flatnonzero(np.diff(commands, prepend=-1))
        texts = [log.commands[k] for k in commands[changed]]
        recording.send_columns(f"{entity}/command", [_clock(rerun, log.time[changed])], rerun.TextLog.columns(text=texts))
        _plot(rerun, recording, f"{entity}/index", log.time, commands[:, None], ("command",))


def _write_scene(rerun: Any, recording: Any, log: EpisodeLog) -> None:
    """Write agents and references as moving balls, the agents' paths, and the obstacles, at rest or moving."""
    steps, agents = log.position.shape[:2]
    colors = [[round(255 * part) for part in agent_color(i)] for i in range(agents)]
    for name, places, radius in (("agents", log.position, RADIUS), ("references", log.reference, 0.5 * RADIUS)):
        recording.log(f"scene/{name}", rerun.Points3D.from_fields(colors=colors, radii=radius), static=True)
        raised = np.concatenate([places, np.full((*places.shape[:2], 1), RADIUS)], axis=2).reshape(-1, 3)
        columns = rerun.Points3D.columns(positions=raised).partition(np.full(steps, agents))
        recording.send_columns(f"scene/{name}", [_clock(rerun, log.time)], columns)
    strips = [np.column_stack([log.position[:, i], np.zeros(steps)]) for i in range(agents)]
    recording.log("scene/paths", rerun.LineStrips3D(strips, colors=colors), static=True)
    if log.link.shape[1]:
        _write_links(rerun, recording, log)
    if not len(log.obstacles):
        return
    places = np.array([log.obstacles_at(float(time)) for time in (log.time if len(log.motions) else log.time[:1])])
    radii = np.maximum(places[0, :, 2], RADIUS)
    shape = {"lengths": np.full(len(radii), HEIGHT), "radii": radii}
    if not len(log.motions):
        recording.log("scene/obstacles", rerun.Cylinders3D(**shape, centers=_upright(places[0])), static=True)
        return
    recording.log("scene/obstacles", rerun.Cylinders3D.from_fields(**shape), static=True)
    columns = rerun.Cylinders3D.columns(centers=_upright(places)).partition(np.full(steps, len(radii)))
    recording.send_columns("scene/obstacles", [_clock(rerun, log.time)], columns)


def _write_links(rerun: Any, recording: Any, log: EpisodeLog) -> None:
    """Write links as lines that fade with the age of what agents know of each other, and plots of each agent's oldest age."""
    moments = [links_of_log(log, k) for k in range(len(log.time))]
    strips = [log.position[k][links.ends] for k, links in enumerate(moments)]
    raised = [np.pad(pair, ((0, 0), (0, 1)), constant_values=RADIUS) for step in strips for pair in step]
    colors = [np.rint(255 * color).astype(int).tolist() for links in moments for color in links.colors()]
    columns = rerun.LineStrips3D.columns(strips=raised, colors=colors).partition([len(links.ends) for links in moments])
    recording.send_columns("scene/links", [_clock(rerun, log.time)], columns)
    known = np.where(np.isfinite(log.age), log.age, 0.0)
    for i in range(log.age.shape[1]):
        _plot(rerun, recording, f"communication/agent{i + 1}/oldest", log.time, known[:, i].max(axis=1)[:, None], ("oldest",))


def _upright(places: np.ndarray) -> np.ndarray:
    """Centers (P, 3) of cylinders that stand on the ground, from places (..., 3) x, y, radius [m]."""
    middles = places.reshape(-1, 3).copy()
    middles[:, 2] = 0.5 * HEIGHT
    return middles
