"""Untrusted MCAP files: opened, checked for completeness and size before decompression, and recovered if they are torn."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import SEEK_CUR
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import staged_file

_END = struct.Struct("<BQQQI8s")
"""End of an MCAP: footer record (opcode, length, starts of the summary and of its offsets, checksum of the summary), magic."""
_DATA_END_SIZE = 1 + 8 + 4  # the record before the summary: opcode, length, checksum of everything before it [bytes]
_DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError, MemoryError),
    *(TypeError, AttributeError, IndexError, RecursionError, RuntimeError, EOFError),  # lz4 raises a bare RuntimeError
)
"""Errors that the mcap package, decompression and decoding raise on invalid data."""
MOST_UNPACKED, MOST_CHUNK = 2**31, 2**26
"""Largest size of all decompressed chunks of a log, and of one chunk [bytes]: twice the size for 256 agents in 100 s, and 60
times the size of the writer's chunks.
"""


def recover_log(torn: str | Path, out: str | Path, overwrite: bool = False) -> int:
    """Copy all intact records of a torn or damaged MCAP into a new one that any reader can open.

    Metadata and attachments are at the start of a log, so they survive if its first chunk does. A chunk or an
    attachment with a wrong checksum is left out; metadata has no checksum.

    Returns:
        The number of messages saved.

    Raises:
        ConfigurationError: the file does not exist, is not an MCAP, or has no intact message (for example if it was torn
            within its first chunk); or the output cannot or must not be written. Nothing is written in these cases.
    """
    with _open_file(torn) as source, staged_file(Path(out), overwrite=overwrite) as staging, open(staging, "wb") as target:
        writer = Writer(target, enable_data_crcs=True)
        records = _whole_records(source, Path(torn).stat().st_size)
        first = next(records, None)
        header = first if isinstance(first, Header) else Header("", "")
        writer.start(header.profile, header.library)
        saved = _copy(records, writer)
        if not saved:
            raise ConfigurationError(f"{torn} holds no complete message, so there is nothing to recover")
        writer.finish()
    return saved


@contextmanager
def _open_file(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file and check that it is an MCAP, whole or torn."""
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
def open_mcap(path: str | Path) -> Iterator[McapReader]:
    """Open a reader of a whole MCAP; parse errors inside the block become a ConfigurationError of one line."""
    with _open_file(path) as stream:
        try:
            _check_whole(path, stream)
            _check_sizes(stream)
            yield make_reader(stream, validate_crcs=True)
        except ConfigurationError:
            raise
        except _DAMAGE as error:
            text = f"{path} is damaged ({error}); `marlbc log recover {path} OUT` salvages the intact messages"
            raise ConfigurationError(text) from error


def _check_whole(path: str | Path, stream: BinaryIO) -> None:
    """Raise unless the file has a valid end and correct checksums; the mcap package checks only those of chunks."""
    data = stream.read()
    stream.seek(0)
    opcode, length, summary_start, _, summary_crc, magic = _END.unpack(data[-_END.size :].rjust(_END.size, b"\0"))
    if (opcode, length, magic) != (Opcode.FOOTER, 20, MCAP0_MAGIC):
        raise ConfigurationError(f"{path} is truncated; `marlbc log recover {path} OUT` salvages the intact messages")
    if summary_crc and zlib.crc32(data[summary_start : -len(MCAP0_MAGIC) - 4]) != summary_crc:
        raise ValueError("wrong checksum of its summary")
    if summary_start:
        data_crc = int.from_bytes(data[summary_start - 4 : summary_start], "little")
        if data_crc and zlib.crc32(data[: summary_start - _DATA_END_SIZE]) != data_crc:
            raise ValueError("wrong checksum of its data")


def _check_sizes(stream: BinaryIO) -> None:
    """Raise ValueError, before any decompression, if the decompressed chunks would be larger than those of any log."""
    total = 0
    for record in StreamReader(stream, emit_chunks=True).records:
        if isinstance(record, Chunk):
            total += _unpacked(record)
            if total > MOST_UNPACKED:
                raise ValueError(f"its chunks unpack to more than {MOST_UNPACKED} bytes")
    stream.seek(0)


def _unpacked(chunk: Chunk) -> int:
    """Decompressed size of a chunk [bytes]; ValueError if it is too large or differs from that of the compressed data."""
    said, packed = chunk.uncompressed_size, len(chunk.data)
    if said > MOST_CHUNK:
        raise ValueError(f"a chunk of {packed} bytes claims to unpack to {said}; at most {MOST_CHUNK} are accepted")
    if chunk.compression == "zstd":
        found = zstandard.frame_content_size(chunk.data)
    elif chunk.compression == "lz4":
        found = lz4.frame.get_frame_info(chunk.data)["content_size"] or -1
    else:
        found = packed
    if found not in (-1, said) or (found == -1 and chunk.compression == "lz4"):
        raise ValueError(f"a chunk that should hold {said} bytes holds {found if found >= 0 else 'an unknown number'}")
    return int(said)


def _whole_records(source: BinaryIO, size: int) -> Iterator[McapRecord]:
    """Records of the data section, including those in chunks, up to the first that cannot be read."""
    records = iter(StreamReader(source, emit_chunks=True, record_size_limit=size).records)
    while True:
        try:
            record = next(records, None)
        except _DAMAGE:
            return
        if record is None or isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            with suppress(*_DAMAGE):  # only the chunk that is damaged or too large is lost
                _unpacked(record)
                yield from breakup_chunk(record, validate_crc=True)
        elif not isinstance(record, Attachment) or _is_whole(record, source):
            yield record


def _is_whole(attachment: Attachment, source: BinaryIO) -> bool:
    """Whether the attachment just read from ``source`` matches its checksum, which the mcap package does not verify."""
    source.seek(-4, SEEK_CUR)
    stored = source.read(4)
    record = RecordBuilder()
    attachment.write(record)
    return stored in (bytes(4), bytes(record.end()[-4:]))  # zero: no checksum was written


def _copy(records: Iterator[McapRecord], writer: Writer) -> int:
    """Write records with new schema and channel numbers, and return the number of messages."""
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
