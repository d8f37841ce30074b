"""Well-formed logs with valid checksums and content that no episode writes."""

import io
import json
from functools import cache
from random import Random
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from . import robot_files
from .cases import TEXTS, Bases, Case
from .damaged_logs import reading

JUNK: tuple[Any, ...] = (
    *(None, True, 0, -1, 99, 0.5, 1e308, float("nan"), float("inf"), 10**400, 2**63, "", "FM", "\ud800", [], {}, [1.0], [[1.0]]),
    *({"x": 1.0}, [{}], [{"x": 0.0, "y": 0.0}], ["a", "b", "c", "d"], "a" * 100_000),
)
METADATA = (
    "",
    "x",
    "0",
    "-1",
    "nan",
    "inf",
    "1e400",
    "[]",
    "{}",
    "[[1, 2]]",
    "[[NaN, 2, 3]]",
    "[1, 2, 3]",
    "[" * 5000,
    "9" * 5000,
)


class Parts(NamedTuple):
    """Parts of a log."""

    channels: dict[str, tuple[Any, Any]]  # schema and channel by topic
    messages: list[tuple[str, int, bytes]]  # topic, time, data
    metadata: list[tuple[str, dict[str, str]]]
    attachments: list[tuple[str, str, bytes]]  # name, media type, data


def make(rng: Random, bases: Bases) -> Case:
    """A case in which a command reads the changed log."""
    parts = taken_apart(rng.choice(bases.logs))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        parts = change(rng, parts, bases.bait)
    return Case(reading(rng), {"a.mcap": put_together(rng, parts)})


@cache
def taken_apart(content: bytes) -> Parts:
    """The parts of a valid log."""
    read = make_reader(io.BytesIO(content))
    found = [(schema, channel, message) for schema, channel, message in read.iter_messages()]
    return Parts(
        {channel.topic: (schema, channel) for schema, channel, _ in found},
        [(channel.topic, message.log_time, message.data) for _, channel, message in found],
        [(record.name, record.metadata) for record in read.iter_metadata()],
        [(record.name, record.media_type, record.data) for record in read.iter_attachments()],
    )


def put_together(rng: Random, parts: Parts) -> bytes:
    """The log made of the parts, with valid checksums."""
    with io.BytesIO() as stream:
        compression = rng.choice((CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
        writer = Writer(stream, compression=compression, chunk_size=rng.choice((1000, 2**20)))
        writer.start()
        for name, fields in parts.metadata:
            writer.add_metadata(name, fields)
        for name, kind, data in parts.attachments:
            writer.add_attachment(0, 0, name, kind, data)
        numbers: dict[str, int] = {}
        for topic, (schema, channel) in parts.channels.items():
            encoding = schema.encoding if rng.random() < 0.98 else rng.choice(TEXTS)
            data = schema.data if rng.random() < 0.98 else rng.randbytes(10)
            number = writer.register_schema(schema.name, encoding, data)
            numbers[topic] = writer.register_channel(topic, channel.message_encoding, number)
        for topic, time, data in parts.messages:
            writer.add_message(numbers[topic], time, data, time)
        writer.finish()
        return stream.getvalue()


def change(rng: Random, parts: Parts, bait: str) -> Parts:
    """The parts with one random change."""
    match rng.randrange(10):
        case 0 | 1 | 2 | 3 | 4:
            return parts._replace(messages=reworded(rng, parts.messages))
        case 5:
            return parts._replace(messages=reordered(rng, parts.messages))
        case 6 | 7:
            return parts._replace(metadata=[(name, redescribed(rng, fields)) for name, fields in parts.metadata])
        case _:
            return parts._replace(attachments=remodelled(rng, parts.attachments, bait))


def reworded(rng: Random, messages: list[tuple[str, int, bytes]]) -> list[tuple[str, int, bytes]]:
    """The messages, with one part replaced in all or about a tenth of those of one topic."""
    topics = sorted({topic for topic, _, data in messages if data.startswith(b"{")})
    topic = rng.choice(topics) if topics else ""
    share, seed = rng.choice((1.0, 0.1)), rng.random()
    out = []
    for at, time, data in messages:
        if at == topic and data.startswith(b"{") and rng.random() < share:
            data = (
                json.dumps(replaced(Random(seed), json.loads(data))).encode()
                if rng.random() < 0.95
                else b"\xff" + rng.randbytes(5)
            )
        out.append((at, time, data))
    return out


def replaced(rng: Random, value: Any) -> Any:
    """JSON data with one random part replaced, removed or nested deeply."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        name = rng.choice(sorted(value))
        if rng.random() < 0.1:
            return {key: entry for key, entry in value.items() if key != name}
        return {**value, name: replaced(rng, value[name])}
    if isinstance(value, list) and value and rng.random() < 0.8:
        k = rng.randrange(len(value))
        if rng.random() < 0.2:
            return value[:k]
        return [*value[:k], replaced(rng, value[k]), *value[k + 1 :]]
    if rng.random() < 0.05:
        for _ in range(900):
            value = [value]
        return value
    return rng.choice(JUNK)


def reordered(rng: Random, messages: list[tuple[str, int, bytes]]) -> list[tuple[str, int, bytes]]:
    """The messages shuffled, all at one time, or with those of a topic removed or doubled; or no messages."""
    topic = rng.choice(messages)[0] if messages else ""
    match rng.randrange(5):
        case 0:
            return rng.sample(messages, len(messages))
        case 1:
            time = rng.choice((0, 2**64 - 1, 2**63))
            return [(at, time, data) for at, _, data in messages]
        case 2:
            return [each for each in messages if each[0] != topic]
        case 3:
            return messages + [each for each in messages if each[0] == topic]
    return []


def redescribed(rng: Random, fields: dict[str, str]) -> dict[str, str]:
    """Metadata with one entry replaced or removed."""
    name = rng.choice(sorted(fields)) if fields else "x"
    if rng.random() < 0.2:
        return {key: value for key, value in fields.items() if key != name}
    return {**fields, name: rng.choice(METADATA)}


def remodelled(rng: Random, attachments: list[tuple[str, str, bytes]], bait: str) -> list[tuple[str, str, bytes]]:
    """Attachments with another model, or shuffled with one removed."""
    if rng.random() < 0.2:
        return rng.sample(attachments, len(attachments) - 1) if attachments else []
    model = robot_files.text(rng, bait).encode(errors="replace")
    if rng.random() < 0.3:
        model = rng.choice((b"", b"\xff\xfe", b"<mujoco", b"<mujoco/>" * 2))
    return [(name, kind, model if name.endswith(".xml") else data) for name, kind, data in attachments]
