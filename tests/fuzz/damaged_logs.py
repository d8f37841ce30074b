"""Logs with damaged bytes."""

import struct
from random import Random

from .cases import Bases, Case, damaged

OUTPUTS = ("out.csv", "out.npz", "out.rrd", "out.txt")


def make(rng: Random, bases: Bases) -> Case:
    """A case in which a command reads the damaged log."""
    content = rng.choice(bases.logs)
    content = resized(rng, content) if rng.random() < 0.2 else damaged(rng, content)
    return Case(reading(rng), {"a.mcap": content})


def reading(rng: Random) -> list[str]:
    """A command that reads ``a.mcap``."""
    tiny = ["--size", "64x64", "--fps", "1", "--speed", "100", "--samples", "0", "--out", "a.mp4"]
    match rng.randrange(20):
        case 0:
            return ["video", "a.mcap", *tiny, "--camera", rng.choice(("top", "track", "close", "x"))]
        case 1 | 2 | 3 | 4:
            return ["log", "info", "a.mcap"]
        case 5 | 6 | 7 | 8:
            return ["log", "recover", "a.mcap", "b.mcap"]
        case _:
            return ["log", "export", "a.mcap", rng.choice(OUTPUTS)]


def resized(rng: Random, content: bytes) -> bytes:
    """The log with one record's length, or a number in the record, replaced by another."""
    starts, at = [], 8
    while at + 9 <= len(content) - 8:
        starts.append(at)
        at += 9 + struct.unpack_from("<Q", content, at + 1)[0]
    data, record = bytearray(content), rng.choice(starts)
    at = min(record + rng.choice((1, 9, 17, 25, 33)), len(data) - 8)
    (old,) = struct.unpack_from("<Q", data, at)
    new = rng.choice((0, 1, old + 1, old - 1, old * 2, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1))
    struct.pack_into("<Q", data, at, new % 2**64)
    return bytes(data)
