"""Reading MCAP logs: whole ones back into arrays, torn ones into whole ones."""

import json
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import SEEK_CUR
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC, Writer

from marlbc_mj.core.motion import NUMBERS
from marlbc_mj.recording import schemas
from marlbc_mj.recording.log import Course, EpisodeLog, Substeps, hearing_columns, shield_rows
from marlbc_mj.recording.writer import METADATA, MODEL
from marlbc_mj.supervisors.communication import Hearing
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import staged_file

_END = struct.Struct("<BQQQI8s")
"""How an MCAP ends: footer record (opcode, length, start of the summary, of its offsets, checksum of the summary), magic."""
_DATA_END_SIZE = 1 + 8 + 4  # the record before the summary: opcode, length, checksum of everything before it [bytes]
_DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError, MemoryError),
    *(TypeError, AttributeError, IndexError, RecursionError, RuntimeError, EOFError),  # lz4 raises a bare RuntimeError
)
"""What the mcap package, decompression and decoding raise on bytes that are not what they should be."""
MOST_UNPACKED, MOST_CHUNK = 2**31, 2**26
"""Largest size of a log's decompressed chunks together, and of one [bytes]: twice what 256 agents leave in 100 s, and 60 times
what the writer puts into one.
"""


def read_log(path: str | Path) -> EpisodeLog:
    """An episode from its log, every number bit for bit as it was recorded.

    Raises:
        ConfigurationError: no such file, no MCAP, a torn or damaged one, or one that is not a log of this package.
    """
    with _open_log(path) as reader:
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
    """Raise ValueError for arrays that do not fit each other, or numbers that no episode leaves."""
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
        raise ValueError(f"robots names {len(log.robots)} for {agents} agents")
    if not (log.age >= 0).all():
        raise ValueError("an age is negative, or not a number")
    if log.command.dtype.kind != "i" or not ((log.command >= 0) & (log.command < len(log.commands))).all():
        raise ValueError(f"a command is none of the {len(log.commands)} that there are")
    if not all(isinstance(name, str) for name in log.commands):
        raise ValueError("the names of commands are no texts")
    if not (np.diff(log.time) > 0).all() or not (0 < log.mission_step < np.inf and 0 < log.safe_distance < np.inf):
        raise ValueError("times do not grow, or mission_step or safe_distance is not positive")
    if (
        not np.isfinite(log.obstacles).all()
        or not np.isfinite(log.motions).all()
        or len(log.motions) not in (0, len(log.obstacles))
    ):
        raise ValueError("obstacles are not finite, or their motions do not fit them")


def log_info(path: str | Path) -> dict[str, Any]:
    """What is in an MCAP, for people: JSON values only.

    Keys: ``file, bytes, library, start_s, duration_s, messages, chunks``, ``topics`` (by name: ``messages, schema,
    schema_encoding, message_encoding``), ``metadata`` (by record name) and ``attachments`` (``name, media_type, bytes``).

    Raises:
        ConfigurationError: no such file, no MCAP, or a torn or damaged one.
    """
    with _open_log(path) as reader:
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


def recover_log(torn: str | Path, out: str | Path, overwrite: bool = False) -> int:
    """Copy everything whole out of a torn or damaged MCAP into a new one, which any reader opens.

    Metadata and attachments stand at the start of a log and survive with its first chunk. A chunk or an
    attachment that fails its checksum is left out; metadata has none.

    Returns:
        How many messages were saved.

    Raises:
        ConfigurationError: no such file, no MCAP, no whole message in it (it was torn before its first chunk ended, for
            example), or an output that cannot or must not be written. Nothing is written then.
    """
    with _open_file(torn) as source, staged_file(Path(out), overwrite=overwrite) as staging, open(staging, "wb") as target:
        writer = Writer(target, enable_data_crcs=True)
        records = _whole_records(source, Path(torn).stat().st_size)
        first = next(records, None)
        header = first if isinstance(first, Header) else Header("", "")
        writer.start(header.profile, header.library)
        saved = _copy(records, writer)
        if not saved:
            raise ConfigurationError(f"{torn} holds no whole message, so there is nothing to recover")
        writer.finish()
    return saved


@contextmanager
def _open_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file that is an MCAP, whole or torn."""
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise ConfigurationError(f"cannot read {path}: it is not a file")
        with open(path, "rb") as stream:
            if not MCAP0_MAGIC.startswith(stream.read(len(MCAP0_MAGIC))):
                raise ConfigurationError(f"{path} is not an MCAP file")
            stream.seek(0)
            yield stream
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error


@contextmanager
def _open_log(path: str | Path) -> Iterator[McapReader]:
    """A reader of a whole MCAP; parse errors inside the block become one line."""
    with _open_file(path) as stream:
        try:
            _check_whole(path, stream)
            _check_sizes(stream)
            yield make_reader(stream, validate_crcs=True)
        except ConfigurationError:
            raise
        except _DAMAGE as error:
            text = f"{path} is damaged ({error}); `marlbc log recover {path} OUT` salvages what is whole"
            raise ConfigurationError(text) from error


def _check_whole(path: str | Path, stream: BinaryIO) -> None:
    """Raise unless the file ends as an MCAP does and its checksums hold; the mcap package checks those of chunks only."""
    data = stream.read()
    stream.seek(0)
    opcode, length, summary_start, _, summary_crc, magic = _END.unpack(data[-_END.size :].rjust(_END.size, b"\0"))
    if (opcode, length, magic) != (Opcode.FOOTER, 20, MCAP0_MAGIC):
        raise ConfigurationError(f"{path} is truncated; `marlbc log recover {path} OUT` salvages what is whole")
    if summary_crc and zlib.crc32(data[summary_start : -len(MCAP0_MAGIC) - 4]) != summary_crc:
        raise ValueError("wrong checksum of its summary")
    if summary_start:
        data_crc = int.from_bytes(data[summary_start - 4 : summary_start], "little")
        if data_crc and zlib.crc32(data[: summary_start - _DATA_END_SIZE]) != data_crc:
            raise ValueError("wrong checksum of its data")


def _check_sizes(stream: BinaryIO) -> None:
    """Raise ValueError for chunks that are larger than any log's once they are decompressed, before one of them is."""
    total = 0
    for record in StreamReader(stream, emit_chunks=True).records:
        if isinstance(record, Chunk):
            total += _unpacked(record)
            if total > MOST_UNPACKED:
                raise ValueError(f"its chunks are larger than {MOST_UNPACKED} bytes together")
    stream.seek(0)


def _unpacked(chunk: Chunk) -> int:
    """Size of a chunk that is no bomb [bytes]; ValueError for one that is, or says another size than its compressed data do."""
    said, packed = chunk.uncompressed_size, len(chunk.data)
    if said > MOST_CHUNK:
        raise ValueError(f"a chunk of {packed} bytes says that it holds {said}; none has more than {MOST_CHUNK}")
    if chunk.compression == "zstd":
        found = zstandard.frame_content_size(chunk.data)
    elif chunk.compression == "lz4":
        found = lz4.frame.get_frame_info(chunk.data)["content_size"] or -1
    else:
        found = packed
    if found not in (-1, said) or (found == -1 and chunk.compression == "lz4"):
        raise ValueError(f"a chunk that should hold {said} bytes holds {found if found >= 0 else 'an unknown number'}")
    return int(said)


def _marlbc_metadata(path: str | Path, reader: McapReader) -> dict[str, str]:
    for record in reader.iter_metadata():
        if record.name == METADATA:
            return record.metadata
    raise ConfigurationError(f"{path} has no metadata {METADATA!r}; it was not written by marlbc")


def _messages(path: str | Path, reader: McapReader) -> dict[str, list[dict[str, Any]]]:
    """Decoded messages of every required topic, and of those of some logs that this one has; the same number of each."""
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
        raise ConfigurationError(f"{path} has mission steps that are not whole: {counts}")
    return found


def _topics_used(reader: McapReader) -> set[str]:
    """Topics with at least one message; a team whose supervisor says nothing leaves none on its communication."""
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        return set()
    counts = summary.statistics.channel_message_counts
    return {channel.topic for channel in summary.channels.values() if counts.get(channel.id, 0)}


def _columns(found: dict[str, list[dict[str, Any]]]) -> dict[str, np.ndarray]:
    """The arrays of EpisodeLog from decoded messages."""
    pose, shield, steps = schemas.POSE, schemas.SHIELD, len(found["/state"])

    def agents(topic: str, *names: str) -> np.ndarray:
        # Infinite numbers are left out of the JSON, and only a clearance can be.
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
    """All substeps; None in a log without."""
    if schemas.SUBSTEP_ROWS.name not in found:
        return None
    moments = [schemas.decode_substeps(row, agents) for row in found[schemas.SUBSTEP_ROWS.name]]
    positions, *others = (list(rows) for rows in zip(*moments, strict=True))
    position = np.concatenate([*(rows[:-1] for rows in positions), positions[-1][-1:]])
    return Substeps(_course(metadata, agents), position, *(np.concatenate(rows) for rows in others))


def _course(metadata: dict[str, str], agents: int) -> Course:
    """What metrics read of the scenario.

    Raises:
        ValueError: numbers that no scenario has.
    """
    numbers = {name: float(metadata[name]) for name in ("substep", "mission_step", "safe_distance", "scenario_force_limit")}
    (x, y), (vx, vy) = np.array(json.loads(metadata["path"]), dtype=np.float64).reshape(2, 2).tolist()
    formations = np.array(json.loads(metadata["slots"]), dtype=np.float64).reshape(2, agents, 2)
    limit, given = numbers.pop("scenario_force_limit"), [*numbers.values(), x, y, vx, vy, *formations.ravel()]
    own = json.loads(metadata.get("robot_force_limits", json.dumps([limit] * agents)))
    limits = np.array(own, dtype=np.float64).reshape(agents)
    if not min(*numbers.values(), *limits) > 0 or not np.isfinite([*given, *limits]).all():
        raise ValueError("substep, safe_distance, force_limit, path or slots are no numbers of a scenario")
    return Course(**numbers, force_limits=limits, path_origin=(x, y), path_velocity=(vx, vy), formations=formations)


def _shield_rows(messages: list[dict[str, Any]]) -> np.ndarray:
    """(M, N, 7) as EpisodeLog has them; columns that an older log lacks are 0."""
    return np.array([[[float(row.get(name, 0.0)) for name in schemas.SHIELD.columns] for row in m["agents"]] for m in messages])


def _hearing(found: dict[str, list[dict[str, Any]]]) -> Hearing | None:
    """Who heard whom, (M, N, N) each; None in a log without."""
    if schemas.COMMUNICATION.name not in found:
        return None
    moments = [schemas.decode_hearing(message["agents"]) for message in found[schemas.COMMUNICATION.name]]
    return Hearing(*(np.array(rows) for rows in zip(*moments, strict=True)))


def _whole_records(source: BinaryIO, size: int) -> Iterator[McapRecord]:
    """Records of the data section up to the first that is not whole, chunks opened."""
    records = iter(StreamReader(source, emit_chunks=True, record_size_limit=size).records)
    while True:
        try:
            record = next(records, None)
        except _DAMAGE:
            return
        if record is None or isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            with suppress(*_DAMAGE):  # a bomb, or a damaged chunk between whole ones costs only itself
                _unpacked(record)
                yield from breakup_chunk(record, validate_crc=True)
        elif not isinstance(record, Attachment) or _is_whole(record, source):
            yield record


def _is_whole(attachment: Attachment, source: BinaryIO) -> bool:
    """Whether the attachment just read from ``source`` fits its checksum, which the mcap package does not look at."""
    source.seek(-4, SEEK_CUR)
    stored = source.read(4)
    record = RecordBuilder()
    attachment.write(record)
    return stored in (bytes(4), bytes(record.end()[-4:]))  # zero: none was written


def _copy(records: Iterator[McapRecord], writer: Writer) -> int:
    """Write records under new schema and channel numbers. Returns the number of messages."""
    schema_ids: dict[int, int] = {0: 0}
    channel_ids: dict[int, int] = {}
    saved = 0
    for record in records:
        if isinstance(record, Message) and record.channel_id in channel_ids:
            channel = channel_ids[record.channel_id]
            writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            saved += 1
        elif isinstance(record, Schema) and record.id not in schema_ids:
            schema_ids[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channel_ids and record.schema_id in schema_ids:
            channel_ids[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema_ids[record.schema_id], record.metadata
            )
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
    return saved
