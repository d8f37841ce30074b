"""Checkpoints of policies and saved training runs: damaged bytes, and wrong content under a correct digest."""

import json
import struct
from random import Random
from typing import Any

import numpy as np
from safetensors.numpy import load
from safetensors.numpy import save as serialise

from marlbc_mj.policies.checkpoint import digest

from .cases import Bases, Case, damaged
from .wrong_logs import replaced

POLICY, RUN = "p.safetensors", "run/resume.safetensors"


def make(rng: Random, bases: Bases) -> Case:
    """A case that flies or exports the policy, or resumes a training run."""
    resumed = rng.random() < 0.35
    content = bases.run[RUN] if resumed else bases.policy
    name, files = (RUN, dict(bases.run)) if resumed else (POLICY, {})
    chance = rng.random()
    if chance < 0.5:
        files[name] = flipped(rng, content) if chance < 0.3 else damaged(rng, content)
    elif resumed and chance < 0.6:
        files["run/config.json"] = damaged(rng, files["run/config.json"])
    else:
        files[name] = rewritten(rng, content)
    refused = chance < 0.5 and files[name] != content
    return Case(["train", "--resume", "run"] if resumed else using(rng), {name: content, **files}, refused)


def using(rng: Random) -> list[str]:
    """A command that reads the policy."""
    if rng.random() < 0.1:
        return ["export", POLICY, "p.onnx"]
    return ["run", "paper", "--supervisor", POLICY, "--controller", "pd", "--duration", "0.5", "--out", "out"]


def flipped(rng: Random, content: bytes) -> bytes:
    """The content with one bit flipped, in the header more often than its share of the bytes."""
    (header,) = struct.unpack("<Q", content[:8])
    place = rng.randrange(rng.choice((8 + header, len(content))))
    data = bytearray(content)
    data[place] ^= 1 << rng.randrange(8)
    return bytes(data)


def rewritten(rng: Random, content: bytes) -> bytes:
    """The checkpoint with changed arrays or a changed description, and its digest computed anew."""
    (header,) = struct.unpack("<Q", content[:8])
    description = json.loads(json.loads(content[8 : 8 + header])["__metadata__"]["marlbc_mj"])
    arrays = {name: np.array(array) for name, array in load(content).items()}
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.5:
            description = replaced(rng, description)
        else:
            reshape(rng, arrays)
    if isinstance(description, dict):
        description["sha256"] = digest(arrays, description)
    try:
        return serialise(arrays, {"marlbc_mj": json.dumps(description)})
    except UnicodeEncodeError:
        return content


def reshape(rng: Random, arrays: dict[str, Any]) -> None:
    """Change, replace, remove or duplicate one array."""
    if not arrays:
        return
    name, other = rng.choice(sorted(arrays)), rng.choice(sorted(arrays))
    array = arrays[name]
    match rng.randrange(7):
        case 0:
            del arrays[name]
        case 1:
            arrays[name] = arrays[other]
        case 2:
            arrays[name] = array.astype(rng.choice(("float64", "int8", "int64", "uint16", "bool", "float16")))
        case 3:
            arrays[name] = np.ascontiguousarray(array[..., :-1]) if array.ndim else array
        case 4:
            arrays[name] = array.reshape(-1)
        case 5:
            with np.errstate(all="ignore"):
                arrays[name] = np.full_like(array, rng.choice((0, 1, -1, 100, 255)))
                if array.dtype.kind == "f":
                    arrays[name][...] = rng.choice((np.nan, np.inf, -1e30, 1e30))
        case _:
            arrays[f"{name}{rng.randrange(10)}"] = array
