"""Command lines: short commands of every kind, with options added, left out, misspelled, or given wrong values."""

import json
from dataclasses import is_dataclass
from functools import cache
from random import Random
from typing import Any, get_args, get_type_hints

from marlbc_mj.cli import Command
from marlbc_mj.cli.parsing import options_of, subcommands_of
from marlbc_mj.controllers import CONTROLLERS
from marlbc_mj.robots import ROBOTS
from marlbc_mj.scenarios import SCENARIOS

from .cases import FLOATS, INTEGERS, TEXTS, Bases, Case, pick

QUICK = ("--duration", "0.5")
TINY = ("worlds=2", "hidden=4", "capacity=64", "batch=8", "threads=1", "bits=4")
SHORT: tuple[tuple[str, ...], ...] = (
    ("run", "paper", "--controller", "pd", *QUICK, "--out", "out"),
    ("run", "cell.toml", "--supervisor", "fsams", "--controller", "pd", *QUICK, "--out", "out"),
    ("run", "paper", "--supervisor", "p.safetensors", *QUICK, "--out", "out"),
    (
        "bench",
        "paper",
        "--supervisors",
        "scripted",
        "--controllers",
        "pd",
        "--no-figures",
        "--video",
        "none",
        *QUICK,
        "--out",
        "out",
    ),
    ("bench", "paper", "--supervisors", "fsams", "--seeds", "1", "--controllers", "pd", "--no-figures", *QUICK, "--out", "out"),
    ("evaluate", "field", "--supervisors", "fsams", "--seeds", "1", "--controller", "pd", *QUICK, "--out", "out"),
    ("train", "marlms", "--budget", "20", "--set", *TINY),
    ("train", "marlms-general", "--budget", "0"),
    ("train", "--resume", "run"),
    ("study", "--from", "."),
    ("study", "lenient", "--seeds", "0"),
    ("ship", "run", "mine"),
    ("export", "p.safetensors", "p.onnx"),
    ("video", "torn.mcap", "--size", "64x64"),
    ("view", "torn.mcap"),
    ("log", "info", "a.mcap"),
    ("log", "recover", "torn.mcap", "b.mcap"),
    ("log", "export", "a.mcap", "a.csv"),
    ("robot", "check", "cart.xml"),
    ("robot", "gate", "--robots", "nothing"),
    ("perf", "--rounds", "0"),
    ("perf", "--out", "cell.toml"),
    ("scale", "--rounds", "0"),
    ("suite", "--layouts", "0"),
    ("suite", "--page", "--from", "run"),
    ("safety", "field", "--layouts", "0"),
    ("communication", "gates", "--supervisor", "nothing"),
    ("ablation", "--study", "nothing"),
    ("calibrate", "--controllers", "nothing"),
    ("oracle", "--budget", "0"),
    ("list",),
    (),
)
"""Commands that finish within moments."""
LONG = (
    *("duration", "seeds", "layouts", "searched", "budget", "rounds", "workers", "threads", "agents", "width", "height", "fps"),
    *("substep", "samples"),
)
"""Options that may legitimately make a command take minutes."""
REFUSED = ("0", "-1", "nan", "inf", "1e300", "9223372036854775808", "1" + "0" * 30, "x", "", "0.3", "1e-320")
"""Values of such options that are invalid or cost no time."""
SPARED = (
    *("perf", "scale", "ablation", "calibrate", "oracle", "gate", "view", "study"),
    *("suite", "safety", "communication", "marlms-general"),
)
"""Commands that take minutes when they are valid: no change may make them valid."""
PATHS = (
    *(
        "cell.toml",
        "missing.toml",
        "pipe.toml",
        "pipe.mcap",
        "a.mcap",
        "torn.mcap",
        "empty",
        "run",
        ".",
        "..",
        "/dev/null",
        "/dev/full",
    ),
    *(
        "/proc/self/mem",
        "p.safetensors",
        "cart.xml",
        "code.py",
        "code.py:Mine",
        "code.py:gone",
        "code.py:fails",
        "x" * 256,
        "\udcff.toml",
    ),
    *(
        "closed/out",
        "cell.toml/out",
        "out/a/b/c",
        "empty.toml",
        "empty.mcap",
        "run/config.json",
        "a\nb",
        "menagerie:x/y.xml",
        "loop",
    ),
)
NAMES = (*SCENARIOS, *ROBOTS, *CONTROLLERS, "fsams", "fms", "scripted", "layered", "marlms", "Paper", "sorlc ", "PD", "all")
SETTINGS = (
    *(
        "shaping=1",
        "ppo=1",
        "gamma=2",
        "copies=2147483648",
        "copies=0",
        "bits=64",
        "hidden=",
        "hidden=0",
        "hidden=-1,4",
        "=",
        "x",
        "x=1",
    ),
    *(
        "shaping.margin=nan",
        "shaping.x=1",
        "learning_rate=-1",
        "batch=0",
        "state=pixels",
        "device=gpu",
        "seed=-1",
        "worlds=0",
        "dueling=2",
    ),
    *(
        "learner=x",
        "hash=x",
        "n_step=0",
        "interval=7",
        "scenario=nothing",
        "controller=nothing",
        "huber=inf",
        "final_learning_rate=0",
    ),
)
CODE = b"""from dataclasses import dataclass
import numpy as np
@dataclass(frozen=True)
class Mine:
    def start(self, scenario):
        return np.zeros(scenario.agents, dtype=np.int64)
    def decide(self, observation, memory):
        return memory, memory
def fails():
    raise KeyError("gone")
"""


def make(rng: Random, bases: Bases) -> Case:
    """A command line with up to five random changes."""
    argv = list(rng.choice(SHORT))
    for _ in range(rng.choice((0, 1, 1, 2, 2, 3, 5))):
        change(rng, argv)
    return Case(argv, surroundings(rng, bases))


def surroundings(rng: Random, bases: Bases) -> dict[str, bytes]:
    """Files that a command line may name."""
    whole = bases.logs[0]
    return {
        "cell.toml": b'family = "open"\nagents = 3\nduration = 1.0\n',
        "empty.toml": b"",
        "empty.mcap": b"",
        "a.mcap": whole,
        "torn.mcap": whole[: rng.randrange(len(whole))],
        "p.safetensors": bases.policy,
        "code.py": CODE,
        "study.csv": rng.choice((b"", b"variant,seed\n", b"variant,seed,return\nlenient,0,x\n", json.dumps([1]).encode())),
        "curves.csv": rng.choice((b"", b"a,b\n1,2\n")),
        "cart.xml": b"<mujoco/>",
        **bases.run,
    }


def change(rng: Random, argv: list[str]) -> None:
    """Make one change, but none that could turn a command in ``SPARED`` into a valid one."""
    at = rng.randrange(len(argv) + 1)
    spared = any(word in SPARED for word in argv)
    match rng.randrange(10):
        case 0 | 1 | 2 | 3 if argv and not spared:
            argv.extend(an_option(rng, argv))
        case 4 if at < len(argv) and argv[at] not in QUICK and not spared:
            del argv[at]
        case 5 if at < len(argv) and not spared and not is_long(argv, at):
            argv[at] = pick(rng, PATHS, NAMES, TEXTS)
        case 6 if at < len(argv):
            argv[at] = argv[at][:-1] + rng.choice(("", "x", "-", argv[at][-1:] * 2))
        case 7:
            argv.insert(rng.choice((at, len(argv))), rng.choice(("--help", "-h", "--", "--x", "-1", "", "--out", "--seed=x")))
        case 8 if not spared:
            argv.insert(at, pick(rng, PATHS, TEXTS))
        case _:
            argv.insert(at, "--" + rng.choice(TEXTS) + rng.choice(("", "=1")))


def is_long(argv: list[str], at: int) -> bool:
    """Whether a word is the value of an option in ``LONG``."""
    return at > 0 and argv[at - 1].lstrip("-") in LONG


def an_option(rng: Random, argv: list[str]) -> list[str]:
    """An option with up to two values, in most cases one of the command's own."""
    name = rng.choice(options(argv[0]) if rng.random() < 0.9 else options(""))
    bare = name.lstrip("-")
    if bare in LONG:
        return [name, rng.choice(REFUSED)]
    if bare == "set":
        return [name, *TINY, rng.choice(SETTINGS)]
    values = [pick(rng, INTEGERS, FLOATS, TEXTS, NAMES, PATHS, CHOICES) for _ in range(rng.choice((0, 1, 1, 1, 1, 2)))]
    return [f"{name}={values[0]}"] if values and rng.random() < 0.1 else [name, *values]


CHOICES = (
    "none",
    "first",
    "all",
    "virtual",
    "actual",
    "set-based",
    "null-space",
    "paper",
    "gusts",
    "wind",
    "test",
    "train",
    "top",
    "cpu",
    "cuda",
)


@cache
def options(command: str) -> tuple[str, ...]:
    """Options of a command and its actions; those of all commands if the word is no command."""
    kind: Any = subcommands_of(Command).get(command, Command)
    hints = get_type_hints(kind, include_extras=True) if is_dataclass(kind) else {}
    action = get_args(hints["action"])[0] if "action" in hints else kind
    return tuple(dict.fromkeys(options_of(action))) or ("--help",)
