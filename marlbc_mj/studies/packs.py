"""Packs: files to which small records are appended, each with its key and a checksum. A torn record is dropped.

One process writes a pack while others may read it. Whatever stops the writer, kill −9 and a full disk included, every record
before the last is whole, and a torn last record is detected.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import BinaryIO, NamedTuple

import zstandard

from marlbc_mj.util.files import writing

MAGIC = b"MJr1"
_HEAD = struct.Struct("<4s32sQI")  # magic, key, length of the payload, CRC-32 of key and payload
LARGEST_PACK = 256 * 2**20  # size at which a new pack is started [bytes]
SYNC_EVERY = 1.0  # time between two flushes to the disk [s]
_PREFIX, PACK_SUFFIX = "results-", ".pack"


class Packed(NamedTuple):
    """The location of a record's payload."""

    key: str
    """64 hexadecimal digits."""
    path: Path
    start: int  # of the payload in the file [bytes]
    length: int  # of the payload [bytes]

    def payload(self) -> bytes:
        """The stored bytes, decompressed."""
        with self.path.open("rb") as file:
            file.seek(self.start)
            return zstandard.ZstdDecompressor().decompress(file.read(self.length))


def entries(path: Path, begin: int = 0) -> Iterator[Packed]:
    """All whole records of a pack from the offset ``begin`` on; damaged parts are skipped."""
    with path.open("rb") as file:
        while (entry := _entry(path, file, begin)) is not None or (begin := _next_magic(file, begin + 1)) > 0:
            if entry is not None:
                yield entry
                begin = entry.start + entry.length


def _entry(path: Path, file: BinaryIO, begin: int) -> Packed | None:
    """The record at the offset ``begin``; None if there is no whole one."""
    file.seek(begin)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(MAGIC):
        return None
    _, key, length, checksum = _HEAD.unpack(head)
    start = begin + _HEAD.size
    if start + length > os.fstat(file.fileno()).st_size or zlib.crc32(file.read(length), zlib.crc32(key)) != checksum:
        return None
    return Packed(key.hex(), path, start, length)


def _next_magic(file: BinaryIO, begin: int) -> int:
    """The next offset from ``begin`` on at which a record may start, or −1."""
    file.seek(begin)
    found = file.read().find(MAGIC)
    return begin + found if found >= 0 else -1


class PackWriter:
    """Appends records to a pack, after the last whole one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._synced = monotonic()
        with writing(path):
            path.touch()
            self._end = max((entry.start + entry.length for entry in entries(path)), default=0)
            self._file = os.open(path, os.O_RDWR)
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)

    def __enter__(self) -> "PackWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def full(self) -> bool:
        """Whether a new pack should be started."""
        return self._end >= LARGEST_PACK

    def add(self, key: str, payload: bytes) -> Packed:
        """Append a record; later calls flush it to the disk after about a second, and :meth:`close` always does.

        Raises:
            NoSpaceError: the disk is full; the pack is unchanged.
        """
        packed = zstandard.ZstdCompressor().compress(payload)
        name = bytes.fromhex(key)
        head = _HEAD.pack(MAGIC, name, len(packed), zlib.crc32(packed, zlib.crc32(name)))
        begin = self._end
        with writing(self.path):
            try:
                _write_all(self._file, head + packed)
            except BaseException:
                os.ftruncate(self._file, begin)
                os.lseek(self._file, begin, os.SEEK_SET)
                raise
            self._end = begin + len(head) + len(packed)
            if monotonic() > self._synced + SYNC_EVERY:
                os.fsync(self._file)
                self._synced = monotonic()
        return Packed(key, self.path, begin + len(head), len(packed))

    def close(self) -> None:
        """Flush and close."""
        with writing(self.path):
            try:
                os.fsync(self._file)
            finally:
                os.close(self._file)


def _write_all(file: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(file, left) :]


def packs(folder: Path) -> list[Path]:
    """The packs of a folder that :func:`next_pack` named, in their order."""
    return sorted(folder.glob(f"{_PREFIX}*{PACK_SUFFIX}"))


def next_pack(folder: Path) -> Path:
    """The pack to append to: the last one, or a new one if that is full."""
    there = packs(folder)
    if there and there[-1].stat().st_size < LARGEST_PACK:
        return there[-1]
    return folder / f"{_PREFIX}{len(there):06d}{PACK_SUFFIX}"
