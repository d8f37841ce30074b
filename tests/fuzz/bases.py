"""Makes the valid files that cases damage, with the program itself, and so loads once the compiled code that all cases share."""

import itertools
import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import signature, write_policy
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.policies.states import make_state
from marlbc_mj.scenarios import paper

from .cases import Bases

QUICK = ("--duration", "0.5")
TRAIN = "train marlms --budget 600 --set worlds=2 hidden=4 capacity=256 batch=8 threads=1 bits=4 evaluate_every=600"


def quietly(folder: Path, *argv: str) -> None:
    """Run a command and send its output to a file."""
    with open(folder / "said", "a") as said, redirect_stdout(said), redirect_stderr(said):
        main([*argv])


def make_bases(folder: Path, bait: Path, kinds: tuple[str, ...]) -> Bases:
    """Make the valid files that the given kinds of input need."""
    folder.mkdir(parents=True)
    write_policy(folder / "p.safetensors", small_policy(), {"signature": signature(paper(), "extended", "commands", 10)})
    logs = [flown(folder, "plain", "run", "paper"), flown(folder, "pd", "run", "paper", "--controller", "pd")]
    run: dict[str, bytes] = {}
    if {"commands", "checkpoints"} & set(kinds):
        import torch

        torch.set_num_threads(1)
        quietly(folder, *TRAIN.split(), "--out", str(folder / "run"))
        run = {f"run/{name}": (folder / "run" / name).read_bytes() for name in ("resume.safetensors", "config.json")}
    if {"damaged", "wrong"} & set(kinds):
        from marlbc_mj.recording.gl import choose_gl

        choose_gl()  # tried once for all cases
        logs.append(flown(folder, "shield", "run", "paper", "--shield", "--supervisor", "layered"))
        logs.append(flown(folder, "pose", "run", "robot_gate", "--robot", "crazyflie", "--controller", "pd"))
    if "toml" in kinds:
        for supervisor in ("fsams", "fms", "set-based-rule", "motor-schema"):
            flown(folder, supervisor, "run", "field", "--supervisor", supervisor, "--controller", "lqr")
    return Bases(logs, (folder / "p.safetensors").read_bytes(), run, os.fspath(bait))


def flown(folder: Path, name: str, *argv: str) -> bytes:
    """The log of an episode of half a second."""
    quietly(folder, *argv, *QUICK, "--out", str(folder / name))
    (log,) = (folder / name).rglob("*.mcap")
    return log.read_bytes()


def small_policy() -> Policy:
    """A small policy with random weights."""
    rng, size = np.random.default_rng(0), make_state("extended", paper()).size
    sizes = [size, 3, 9]
    weights = tuple(rng.normal(size=(4, a, b)).astype(np.float32) for a, b in itertools.pairwise(sizes))
    biases = tuple(rng.normal(size=(4, 1, b)).astype(np.float32) for b in sizes[1:])
    return Policy(weights, biases, np.ones(size, np.float32), True, 0.1, 0.4)
