"""The JSON topics of a log: their fields, their JSON Schemas, and the compact encoding that is written at mission rate.

The topics use only features that viewers support: Foxglove's schema parser accepts one plain type per field (no
``["number", "null"]``) and no arrays of arrays, and PlotJuggler rejects a channel without a schema. Hence every topic is one
object with scalars and a list ``agents`` of flat objects. Numbers that are not finite are left out, since JSON has neither NaN
nor Infinity.
"""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.communication import components
from marlbc_mj.supervisors.communication import Hearing

UNKNOWN_AGE = "-"
SCHEMA_ENCODING = "jsonschema"
MESSAGE_ENCODING = "json"


class MessageField(NamedTuple):
    """One field of a topic."""

    type: str  # "number", "integer" or "string"
    description: str  # including the unit
    required: bool = True  # False: left out if it is not finite


class Topic(NamedTuple):
    """One JSON topic: scalars, and one row per agent."""

    name: str
    schema_name: str
    description: str
    agents: Mapping[str, MessageField]
    scalars: Mapping[str, MessageField] = {}

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of an agent's fields, in the order of the columns of ``values`` in :func:`encode`."""
        return tuple(self.agents)


def _plane(kind: str) -> dict[str, MessageField]:
    return {axis: MessageField("number", f"{kind}, {axis} axis") for axis in ("x", "y")}


def _motion(position: str, velocity: str) -> dict[str, MessageField]:
    rates = {f"v{axis}": MessageField("number", f"{velocity}, {axis} axis [m/s]") for axis in ("x", "y")}
    return {**_plane(f"{position} [m]"), **rates}


STATE_TOPIC = Topic(
    "/state",
    "marlbc.State",
    "measured motion at the start of a mission step",
    _motion("position p", "velocity v"),
    {"time": MessageField("number", "start of the mission step [s]")},
)
REFERENCE = Topic(
    "/reference",
    "marlbc.Reference",
    "reference that the controller follows, at the start of a mission step",
    _motion("reference position p_r", "reference velocity v_r"),
)
FORCE = Topic("/force", "marlbc.Force", "force applied in the first substep of a mission step", _plane("force u [N]"))
PRIORITIES = Topic(
    "/priorities",
    "marlbc.Priorities",
    "orders of the mission supervisor",
    {
        "command": MessageField("string", "behaviors from the highest priority down, for example OA>FM"),
        "index": MessageField("integer", "the same as an index into the scenario's commands"),
    },
)
WEIGHTS = Topic(
    "/weights",
    "marlbc.Weights",
    "adaptive state of SORLC at the start of a mission step",
    {
        "identifier": MessageField("number", "Frobenius norm of w_f", required=False),
        "actor": MessageField("number", "Frobenius norm of w_a", required=False),
        "critic": MessageField("number", "Frobenius norm of w_c", required=False),
        "tau_x": MessageField("number", "saturation compensator tau, x axis", required=False),
        "tau_y": MessageField("number", "saturation compensator tau, y axis", required=False),
    },
)
METRICS = Topic(
    "/metrics",
    "marlbc.Metrics",
    "verdicts on a mission step",
    {"clearance": MessageField("number", "distance to the nearest obstacle [m]; absent without obstacles", required=False)},
    {
        "formation": MessageField("integer", "G at the start: 2 in formation, 1 in column, 0 neither"),
        "reward": MessageField("number", "r1 + r2 of this mission step"),
        "decision_ms": MessageField("number", "computing time of the supervisor [ms]"),
    },
)
POSE = Topic(
    "/pose",
    "marlbc.Pose",
    "position and orientation of the bodies of robots with a free joint, at the start of a mission step",
    {
        **{axis: MessageField("number", f"position of the body, {axis} axis [m]") for axis in ("x", "y", "z")},
        **{f"q{part}": MessageField("number", f"orientation, quaternion {part}") for part in ("w", "x", "y", "z")},
    },
)
SHIELD = Topic(
    "/shield",
    "marlbc.Shield",
    "counts and sums of the shield since the episode began, at the end of a mission step",
    {
        "interventions": MessageField("number", "substeps in which it changed the force, or the reference velocity"),
        "change": MessageField("number", "integral of |u - wish| dt, or sum of m |v_r - wish| [N s]"),
        "speed": MessageField("number", "substeps beyond the speed cap that it assumes"),
        "force": MessageField("number", "substeps with a disturbance beyond the bound that it assumes"),
        "state": MessageField("number", "substeps outside the set of states from which agents can stop in time"),
        "motion": MessageField("number", "the same, because of an obstacle that moves"),
        "tube": MessageField("number", "substeps farther from the reference than it assumes"),
    },
)
COMMUNICATION = Topic(
    "/communication",
    "marlbc.Communication",
    "links between agents, and the age of what each agent knows of the others, when orders were given",
    {
        "component": MessageField("integer", "number of the first agent of its connected component, from 1"),
        "hears": MessageField("string", "numbers of the agents that it hears directly, from 1"),
        "ages": MessageField("string", "age of what it knows of each agent [s]; - where it knows nothing"),
        "known": MessageField("integer", "number of agents that it knows something about, including itself"),
        "oldest": MessageField("number", "greatest of the ages [s]"),
    },
)
SUBSTEP_ROWS = Topic(
    "/substeps",
    "marlbc.Substeps",
    "position, velocity, reference, reference velocity and force of every substep of a mission step, for metrics",
    {},
    {
        "substeps": MessageField("integer", "number of substeps"),
        "data": MessageField("string", "packed numbers, see encode_substeps"),
    },
)
TOPICS = (STATE_TOPIC, REFERENCE, FORCE, SUBSTEP_ROWS, PRIORITIES, WEIGHTS, METRICS)
REQUIRED = (STATE_TOPIC, REFERENCE, FORCE, PRIORITIES, METRICS)
"""Topics without which a log cannot be read.

Of the others, ``SUBSTEP_ROWS`` is in every new log, ``WEIGHTS`` in logs of SORLC, ``POSE`` in those of robots with a free
joint, ``SHIELD`` in those of teams with a shield, and ``COMMUNICATION`` in those of teams whose communication is not ideal.
"""


def json_schema(topic: Topic) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a topic."""
    rows = {"type": "array", "description": "one row per agent", "items": _object(topic.agents)}
    schema = _object(topic.scalars)
    schema["properties"]["agents"] = rows
    schema["required"].append("agents")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": topic.schema_name}
    return {**head, "description": topic.description, **schema}


def _object(fields: Mapping[str, MessageField]) -> dict[str, Any]:
    properties = {name: {"type": f.type, "description": f.description} for name, f in fields.items()}
    return {"type": "object", "properties": properties, "required": [n for n, f in fields.items() if f.required]}


def encode(topic: Topic, values: np.ndarray, **scalars: float) -> bytes:
    """One message from an agent table ``values`` (N, columns) and the topic's scalars; reading it restores every bit."""
    rows = encode_rows(topic.columns, values)
    return message([f'"{name}":{value!r}' for name, value in scalars.items()], rows)


def encode_rows(columns: tuple[str, ...], values: np.ndarray) -> str:
    """``{"x":1.0,...},{...}`` from values (N, columns), without numbers that are not finite."""
    numbers = values.ravel().tolist()
    if math.isfinite(sum(numbers)):
        return _template(columns, len(values)) % tuple(numbers)
    rows = [{n: x for n, x in zip(columns, row, strict=True) if math.isfinite(x)} for row in values.tolist()]
    return ",".join(json.dumps(row, separators=(",", ":")) for row in rows)


def encode_hearing(hearing: Hearing) -> bytes:
    """A message on ``COMMUNICATION``; reading it restores every bit of links and ages (N, N)."""
    part = components((hearing.link & hearing.link.T)[None])[0]
    rows = []
    for first, link, age in zip(part.tolist(), hearing.link, hearing.age.tolist(), strict=True):
        known = [seconds for seconds in age if math.isfinite(seconds)]
        row = {
            "component": first + 1,
            "hears": " ".join(str(j + 1) for j in np.flatnonzero(link)),
            "ages": " ".join(repr(seconds) if math.isfinite(seconds) else UNKNOWN_AGE for seconds in age),
            "known": len(known),
            "oldest": max(known),
        }
        rows.append(json.dumps(row, separators=(",", ":")))
    return message([], ",".join(rows))


def decode_hearing(rows: list[dict[str, Any]]) -> Hearing:
    """Links and ages (N, N) from the rows of a message on ``COMMUNICATION``.

    Raises:
        ValueError: a row is not of the form that :func:`encode_hearing` writes.
    """
    agents = len(rows)
    link, age = np.zeros((agents, agents), dtype=np.bool_), np.empty((agents, agents))
    for i, row in enumerate(rows):
        heard = [int(number) for number in row["hears"].split()]
        if not all(1 <= number <= agents for number in heard):
            raise ValueError(f"an agent hears {row['hears']}, of {agents} agents")
        link[i, [number - 1 for number in heard]] = True
        ages = [math.inf if text == UNKNOWN_AGE else float(text) for text in row["ages"].split()]
        if len(ages) != agents:
            raise ValueError(f"an agent knows {len(ages)} ages, of {agents} agents")
        age[i] = ages
    return Hearing(link, age)


def encode_substeps(rows: Sequence[np.ndarray], after: np.ndarray) -> bytes:
    """A message on ``SUBSTEP_ROWS``.

    Its data are little-endian doubles: positions, followed by those at the end of the mission step, velocities, references,
    reference velocities and forces. Each array is stored agent by agent and axis by axis, with all substeps in sequence. The
    first bytes of all numbers come first, then the second bytes and so on, since neighboring numbers have most bytes in common.
    The result is encoded in base64.

    Args:
        rows: the five arrays, (substeps, N, 2) each.
        after: position at the end of the mission step (N, 2) [m].
    """
    position, *others = rows
    tracks = [np.concatenate([position, after[None]]), *others]
    numbers = np.concatenate([track.transpose(1, 2, 0).ravel() for track in tracks]).astype("<f8")
    packed = np.ascontiguousarray(numbers.view(np.uint8).reshape(-1, 8).T)
    scalars = [f'"substeps":{len(position)}', f'"data":"{base64.b64encode(packed.data).decode()}"']
    return message(scalars, "")


def decode_substeps(row: Mapping[str, Any], agents: int) -> list[np.ndarray]:
    """Arrays from a row of :func:`encode_substeps`: positions (substeps + 1, N, 2), then the other four (substeps, N, 2).

    Raises:
        ValueError: the data are not of the form that it writes, or not finite.
    """
    packed = np.frombuffer(base64.b64decode(row["data"], validate=True), np.uint8).reshape(8, -1)
    numbers = np.ascontiguousarray(packed.T).view("<f8").ravel()
    steps = int(row["substeps"])
    ends = np.cumsum([2 * agents * (steps + 1), *[2 * agents * steps] * 4])
    if len(numbers) != ends[-1] or not np.isfinite(numbers).all():
        raise ValueError(f"{len(numbers)} numbers of {steps} substeps of {agents} agents, or not finite ones")
    tracks = np.split(numbers, ends[:-1])
    return [np.ascontiguousarray(track.reshape(agents, 2, -1).transpose(2, 0, 1)) for track in tracks]


def message(scalars: list[str], rows: str) -> bytes:
    """A whole message from encoded scalars and encoded rows."""
    return ("{" + ",".join([*scalars, f'"agents":[{rows}]']) + "}").encode()


@cache
def _template(columns: tuple[str, ...], agents: int) -> str:
    """A %-template of all agents' rows; several times faster than ``json.dumps``, with eight messages per mission step."""
    row = "{" + ",".join(f'"{name}":%r' for name in columns) + "}"
    return ",".join([row] * agents)
