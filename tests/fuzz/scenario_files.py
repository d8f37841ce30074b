"""Scenario files: valid families of missions with wrong values, keys and tables, and with damaged text."""

from dataclasses import fields
from random import Random

from marlbc_mj.core.disturbances import DISTURBANCES
from marlbc_mj.robots import ROBOTS
from marlbc_mj.scenarios.families import FAMILIES
from marlbc_mj.scenarios.files import Custom

from .cases import FLOATS, INTEGERS, TEXTS, Bases, Case, damaged, pick

CUSTOM = {
    "starts": "[[0, -3], [0, 3], [-4, 0]]",
    "slots": "[[0, -3], [0, 3], [-4, 0]]",
    "column": "[[4, 0], [0, 0], [-4, 0]]",
    "obstacles": "[[20, 1], [25, -4, 1.5]]",
    "schedule": '[[1.0, 2.0, -1, "FR"]]',
    "duration": "12.0",
}
TABLES = {
    "disturbance": ("kind", "scale", "seed", "coefficient", "speed", "strength", "direction"),
    "perturbation": ("start_spread", "obstacle_spread", "drag_scale"),
    "imperfections": ("position_noise", "velocity_noise", "delay", "loss", "loss_agent", "loss_start"),
    "nothing": ("x",),
}
WORDS = tuple(
    f'"{word}"' for word in (*ROBOTS, *DISTURBANCES, "grid", "wedge", "circle", "line", "virtual", "actual", "set-based", "test")
)
ROWS = (
    *("[]", "[[]]", "[1, 2]", "[[0, 1], [2, 3]]", "[[0, 0], [0, 0], [0, 0]]", "[[nan, 1], [2, inf], [3, 4]]", "[[1, 2, 3]]"),
    *("[[1e300, 0], [0, 1e300], [1, 1]]", '[["a", "b"]]', "[[20, 0, -1]]", "[[0, 0, 50]]", "[[1, 0, 0, 2, 0.0]]", "[0.5, 0.1]"),
    *('[[3.0, 1.0, 9, "XX"]]', '[[nan, 1.0, 0, "FM"]]', "[[1, 0, 0, 0, 0, 0], [0, 1]]", "[" * 30 + "]" * 30, "[[1, 2], 3]"),
)
OTHERS = ("true", "false", "{}", "{a = 1}", "1979-05-27", "07:32:00", "0x10", "0o7", "1_000", "'''a\nb'''", "+1", "1.", "=")
SUPERVISORS = ("scripted", "fsams", "fms", "fixed", "set-based-rule", "layered", "motor-schema")
CONTROLLERS = ("pd", "pd", "pd", "lqr", "sorlc")


def make(rng: Random, bases: Bases) -> Case:
    """A case that runs one scenario file."""
    content = text(rng).encode(errors="surrogatepass")
    if rng.random() < 0.15:
        content = damaged(rng, content)
    run = ["run", "cell.toml", "--duration", rng.choice(("0.5", "0.1")), "--supervisor", rng.choice(SUPERVISORS), "--out", "out"]
    argv = [*run, "--controller", rng.choice(CONTROLLERS), "--seed", str(rng.randrange(5))]
    return Case(
        argv + rng.choice(([], [], ["--shield"], ["--split", "test"], ["--composition", "set-based"])), {"cell.toml": content}
    )


def text(rng: Random) -> str:
    """A scenario file with a few values that may be wrong."""
    family = rng.choice((*FAMILIES, "custom", "custom", "paper", "cruise"))
    lines = {"family": f'"{family}"', **(CUSTOM if family == "custom" else {})}
    known = [each.name for each in fields(Custom if family == "custom" else FAMILIES.get(family, Custom))]
    for _ in range(rng.choice((0, 1, 1, 1, 2, 4))):
        name = rng.choice(known) if rng.random() < 0.95 else rng.choice(TEXTS) or "x"
        lines[name] = value(rng)
    if rng.random() < 0.1:
        del lines[rng.choice(list(lines))]
    written = [f"{name} = {entry}" for name, entry in lines.items()]
    if rng.random() < 0.05 and written:
        written.append(rng.choice(written))
    return "\n".join([*written, *tables(rng), ""])


def value(rng: Random) -> str:
    """A value, more often a number than anything else."""
    quoted = tuple(f'"{each}"' for each in TEXTS)
    return pick(rng, FLOATS, INTEGERS, PLAUSIBLE, PLAUSIBLE, WORDS, ROWS, OTHERS, quoted)


PLAUSIBLE = ("0.1", "0.3", "0.02", "0.001", "4", "5", "8", "12", "40", "100", "256", "257", "1.5", "3.0", "6.0", "20.0", "60.0")
"""Numbers that many fields accept."""


def tables(rng: Random) -> list[str]:
    """Lines of tables at the file's end."""
    lines = []
    for name in rng.sample(list(TABLES), rng.choice((0, 0, 0, 0, 1))):
        lines.append(rng.choice((f"[{name}]", f"[{name}]", f"[{name}]", f"[[{name}]]", f"[{name}.x]")))
        for key in rng.sample(TABLES[name], rng.randrange(len(TABLES[name]) + 1)):
            kind = key == "kind" and rng.random() < 0.8
            lines.append(f"{key} = " + (f'"{rng.choice(list(DISTURBANCES))}"' if kind else value(rng)))
    return lines
