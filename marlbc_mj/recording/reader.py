"""Reading MCAP logs back into arrays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import McapReader
from mcap.records import Statistics
from mcap.summary import Summary

from marlbc_mj.core.motion import NUMBERS
from marlbc_mj.recording import schemas
from marlbc_mj.recording.log import Course, EpisodeLog, Substeps, hearing_columns, shield_rows
from marlbc_mj.recording.mcap_file import open_mcap
from marlbc_mj.recording.writer import METADATA, MODEL
from marlbc_mj.supervisors.communication import Hearing
from marlbc_mj.util.errors import ConfigurationError


def read_log(path: str | Path) -> EpisodeLog:
    """Read an episode from its log; every number is identical to the recorded one to the last bit.

    Raises:
        ConfigurationError: the file does not exist, is not an MCAP, is torn or damaged, or is not a log of this package.
    """
    with open_mcap(path) as reader:
        metadata = _marlbc_metadata(path, reader)
        model = next((a.data.decode() for a in reader.iter_attachments() if a.name == MODEL), None)
        if model is None:
            raise ConfigurationError(f"{path} has no attachment {MODEL}; it was damaged, or not written by marlbc")
        found = _messages(path, reader)
        columns = _columns(found)
        log = EpisodeLog(
            scenario=metadata["scenario"],
            supervisor=metadata["supervisor"],
            controller=metadata["controller"],
            seed=int(metadata["seed"]),
            mission_step=float(metadata["mission_step"]),
            safe_distance=float(metadata["safe_distance"]),
            force_limit=float(metadata["force_limit"]),
            commands=tuple(json.loads(metadata["commands"])),
            obstacles=np.array(json.loads(metadata["obstacles"]), dtype=np.float64).reshape(-1, 3),
            motions=np.array(json.loads(metadata.get("motions", "[]")), dtype=np.float64).reshape(-1, NUMBERS),
            mjcf=model,
            substeps=_substeps(found, metadata, columns["position"].shape[1]),
            robots=tuple(map(str, json.loads(metadata.get("robots", "[]")))),
            **columns,
        )
        _check_log(log)
        return log


def _check_log(log: EpisodeLog) -> None:
    """Raise ValueError if arrays do not fit each other, or have values that no episode produces."""
    steps, agents = log.position.shape[:2]
    shapes = {
        **dict.fromkeys(("position", "velocity", "reference", "reference_velocity", "force"), (steps, agents, 2)),
        **dict.fromkeys(("time", "formation", "reward", "decision_ms"), (steps,)),
        **dict.fromkeys(("clearance", "command"), (steps, agents)),
    }
    for name, shape in shapes.items():
        array = getattr(log, name)
        if array.shape != shape or array.dtype.kind not in "if":
            raise ValueError(f"{name} is {array.dtype} with shape {array.shape}, not numbers with shape {shape}")
        if not np.isfinite(array).all() and name != "clearance":
            raise ValueError(f"{name} is not finite")
    if log.pose.shape[:2] not in ((steps, 0), (steps, agents)) or log.pose.shape[2:] != (7,) or not np.isfinite(log.pose).all():
        raise ValueError(f"pose has shape {log.pose.shape}, or is not finite")
    shield = log.shield
    shapes_of_shield = (steps, 0, shield.shape[-1]), (steps, agents, len(schemas.SHIELD.columns))
    if shield.shape not in shapes_of_shield or not (shield >= 0).all():
        raise ValueError(f"shield has shape {shield.shape}, or negative counts")
    for name in ("link", "age"):
        if getattr(log, name).shape not in ((steps, 0, 0), (steps, agents, agents)):
            raise ValueError(f"{name} has shape {getattr(log, name).shape}")
    if len(log.robots) not in (0, agents):
        raise ValueError(f"robots has {len(log.robots)} names for {agents} agents")
    if not (log.age >= 0).all():
        raise ValueError("an age is negative, or not a number")
    if log.command.dtype.kind != "i" or not ((log.command >= 0) & (log.command < len(log.commands))).all():
        raise ValueError(f"a command is not one of the {len(log.commands)} in the log")
    if not all(isinstance(name, str) for name in log.commands):
        raise ValueError("the names of commands are not strings")
    if not (np.diff(log.time) > 0).all() or not (0 < log.mission_step < np.inf and 0 < log.safe_distance < np.inf):
        raise ValueError("times do not increase, or mission_step or safe_distance is not positive")
    if (
        not np.isfinite(log.obstacles).all()
        or not np.isfinite(log.motions).all()
        or len(log.motions) not in (0, len(log.obstacles))
    ):
        raise ValueError("obstacles are not finite, or their motions do not fit them")


def log_info(path: str | Path) -> dict[str, Any]:
    """Overview of the content of an MCAP, for display: JSON values only.

    Keys: ``file, bytes, library, start_s, duration_s, messages, chunks``, ``topics`` (by name: ``messages, schema,
    schema_encoding, message_encoding``), ``metadata`` (by record name) and ``attachments`` (``name, media_type, bytes``).

    Raises:
        ConfigurationError: the file does not exist, is not an MCAP, is torn or damaged, or has no summary.
    """
    with open_mcap(path) as reader:
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise ConfigurationError(f"{path} has no summary; `marlbc log recover {path} OUT` writes one")
        count = summary.statistics
        return {
            "file": str(path),
            "bytes": Path(path).stat().st_size,
            "library": reader.get_header().library,
            "start_s": count.message_start_time / 1e9,
            "duration_s": (count.message_end_time - count.message_start_time) / 1e9,
            "messages": count.message_count,
            "chunks": count.chunk_count,
            "topics": _topics(summary, count),
            "metadata": {record.name: record.metadata for record in reader.iter_metadata()},
            "attachments": [
                {"name": a.name, "media_type": a.media_type, "bytes": a.data_size} for a in summary.attachment_indexes
            ],
        }


def _topics(summary: Summary, count: Statistics) -> dict[str, dict[str, Any]]:
    topics = {}
    for channel in sorted(summary.channels.values(), key=lambda c: c.topic):
        schema = summary.schemas.get(channel.schema_id)
        topics[channel.topic] = {
            "messages": count.channel_message_counts.get(channel.id, 0),
            "schema": schema.name if schema else "",
            "schema_encoding": schema.encoding if schema else "",
            "message_encoding": channel.message_encoding,
        }
    return topics


def _marlbc_metadata(path: str | Path, reader: McapReader) -> dict[str, str]:
    for record in reader.iter_metadata():
        if record.name == METADATA:
            return record.metadata
    raise ConfigurationError(f"{path} has no metadata {METADATA!r}; it was not written by marlbc")


def _messages(path: str | Path, reader: McapReader) -> dict[str, list[dict[str, Any]]]:
    """Decoded messages of every required topic, and of the optional topics in this log; all have the same number."""
    some = [
        topic
        for topic in (schemas.SUBSTEP_ROWS, schemas.POSE, schemas.COMMUNICATION, schemas.SHIELD)
        if topic.name in _topics_used(reader)
    ]
    found: dict[str, list[dict[str, Any]]] = {topic.name: [] for topic in (*schemas.REQUIRED, *some)}
    for _, channel, message in reader.iter_messages(topics=list(found), log_time_order=False):
        found[channel.topic].append(json.loads(message.data))
    counts = {name: len(messages) for name, messages in found.items()}
    if not all(counts.values()):
        missing = ", ".join(name for name, count in counts.items() if not count)
        raise ConfigurationError(f"{path} has no messages on {missing}: no mission step was recorded")
    if len(set(counts.values())) > 1:
        raise ConfigurationError(f"{path} has incomplete mission steps: {counts}")
    return found


def _topics_used(reader: McapReader) -> set[str]:
    """Topics with at least one message. The communication topic has none if the supervisor sends no messages."""
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        return set()
    counts = summary.statistics.channel_message_counts
    return {channel.topic for channel in summary.channels.values() if counts.get(channel.id, 0)}


def _columns(found: dict[str, list[dict[str, Any]]]) -> dict[str, np.ndarray]:
    """The arrays of EpisodeLog from decoded messages."""
    pose, shield, steps = schemas.POSE, schemas.SHIELD, len(found["/state"])

    def agents(topic: str, *names: str) -> np.ndarray:
        # Infinite numbers are left out of the JSON, and only a clearance can be infinite.
        return np.array([[[row.get(n, np.inf) for n in names] for row in m["agents"]] for m in found[topic]])

    def scalar(topic: str, name: str) -> np.ndarray:
        return np.array([m[name] for m in found[topic]])

    return {
        "time": scalar("/state", "time"),
        "position": agents("/state", "x", "y"),
        "velocity": agents("/state", "vx", "vy"),
        "reference": agents("/reference", "x", "y"),
        "reference_velocity": agents("/reference", "vx", "vy"),
        "force": agents("/force", "x", "y"),
        "clearance": agents("/metrics", "clearance")[..., 0],
        "formation": scalar("/metrics", "formation"),
        "command": agents("/priorities", "index")[..., 0],
        "reward": scalar("/metrics", "reward"),
        "decision_ms": scalar("/metrics", "decision_ms"),
        "pose": agents(pose.name, *pose.columns) if pose.name in found else np.zeros((steps, 0, 7)),
        "shield": _shield_rows(found[shield.name]) if shield.name in found else shield_rows(None, steps),
        **hearing_columns(_hearing(found), steps),
    }


def _substeps(found: dict[str, list[dict[str, Any]]], metadata: dict[str, str], agents: int) -> Substeps | None:
    """All substeps; None if the log has none."""
    if schemas.SUBSTEP_ROWS.name not in found:
        return None
    moments = [schemas.decode_substeps(row, agents) for row in found[schemas.SUBSTEP_ROWS.name]]
    positions, *others = (list(rows) for rows in zip(*moments, strict=True))
    position = np.concatenate([*(rows[:-1] for rows in positions), positions[-1][-1:]])
    return Substeps(_course(metadata, agents), position, *(np.concatenate(rows) for rows in others))


def _course(metadata: dict[str, str], agents: int) -> Course:
    """The scenario's fields that metrics need, from the metadata.

    Raises:
        ValueError: a number is not valid in a scenario.
    """
    numbers = {name: float(metadata[name]) for name in ("substep", "mission_step", "safe_distance", "scenario_force_limit")}
    (x, y), (vx, vy) = np.array(json.loads(metadata["path"]), dtype=np.float64).reshape(2, 2).tolist()
    formations = np.array(json.loads(metadata["slots"]), dtype=np.float64).reshape(2, agents, 2)
    limit, given = numbers.pop("scenario_force_limit"), [*numbers.values(), x, y, vx, vy, *formations.ravel()]
    own = json.loads(metadata.get("robot_force_limits", json.dumps([limit] * agents)))
    limits = np.array(own, dtype=np.float64).reshape(agents)
    if not min(*numbers.values(), *limits) > 0 or not np.isfinite([*given, *limits]).all():
        raise ValueError("substep, safe_distance, force_limit, path or slots are invalid")
    return Course(**numbers, force_limits=limits, path_origin=(x, y), path_velocity=(vx, vy), formations=formations)


def _shield_rows(messages: list[dict[str, Any]]) -> np.ndarray:
    """Field ``shield`` (M, N, 7) of EpisodeLog; columns that an older log lacks are 0."""
    return np.array([[[float(row.get(name, 0.0)) for name in schemas.SHIELD.columns] for row in m["agents"]] for m in messages])


def _hearing(found: dict[str, list[dict[str, Any]]]) -> Hearing | None:
    """Links and ages (M, N, N) of the communication; None if the log has none."""
    if schemas.COMMUNICATION.name not in found:
        return None
    moments = [schemas.decode_hearing(message["agents"]) for message in found[schemas.COMMUNICATION.name]]
    return Hearing(*(np.array(rows) for rows in zip(*moments, strict=True)))
