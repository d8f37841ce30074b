"""The type of a case, and the numbers, texts and byte changes that damage all kinds of input."""

from collections.abc import Callable
from random import Random
from typing import NamedTuple


class Case(NamedTuple):
    """A command line and the files in its working folder."""

    argv: list[str]
    files: dict[str, bytes]
    refused: bool = False  # whether exit status 0 would be a fault: the program would have accepted damaged input


class Bases(NamedTuple):
    """Valid files for cases to damage, and the folder of files that no command may open."""

    logs: list[bytes]
    policy: bytes  # a small checkpoint
    run: dict[str, bytes]  # files of a training run, by name
    bait: str  # path of a folder outside every case's folder


Make = Callable[[Random, Bases], Case]
"""Makes a case from a random stream."""

INTEGERS = ("0", "1", "-1", "2", "3", "7", "1000", "2147483648", "-2147483649", "9223372036854775808", "1" + "0" * 30)
FLOATS = (
    *("0.0", "-0.0", "1.0", "-1.0", "0.5", "0.05", "0.005", "2.5", "1e-9", "1e-308", "5e-324", "1e9", "1e16", "1e300", "-1e308"),
    *("1e309", "nan", "inf", "-inf", "-nan"),
)
TEXTS = (
    "",
    " ",
    "x",
    "FM",
    "OA>FM",
    "\u00e9\u4e2d\U0001f600",
    "a/b",
    "../x",
    "a" * 300,
    "%s%n",
    "{0}",
    "\\",
    "'",
    '"',
    "\t",
    "--",
    "None",
)


def pick(rng: Random, *pools: tuple[str, ...]) -> str:
    """A random member of one of several equally likely pools."""
    return rng.choice(rng.choice(pools))


def damaged(rng: Random, content: bytes) -> bytes:
    """The content with some bytes flipped, cut, doubled, zeroed, replaced at random or inserted."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        if not data:
            break
        first = rng.randrange(len(data))
        last = min(len(data), first + rng.choice((1, 2, 8, 64, 1000)))
        match rng.randrange(8):
            case 0 | 1:
                data[first] ^= 1 << rng.randrange(8)
            case 2:
                del data[first:]
            case 3:
                del data[first:last]
            case 4:
                data[first:first] = data[first:last]
            case 5:
                data[first:last] = bytes(last - first)
            case 6:
                data[first:last] = rng.randbytes(last - first)
            case _:
                data[first:first] = rng.choice(
                    (b"\xff" * 8, b"\x00", b"[" * 3000, b'"', b"<", b"\xed\xa0\x80", b"\r\n", b"9" * 5000)
                )
    return bytes(data)
