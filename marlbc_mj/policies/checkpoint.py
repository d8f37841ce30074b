"""Checkpoints: arrays as safetensors with a JSON description in the header; a file is written completely or not at all."""

import hashlib
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialise

from marlbc_mj.policies.actions import ACTIONS
from marlbc_mj.policies.greedy import Policy
from marlbc_mj.policies.states import STATES, make_state
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import staged_file, write_json
from marlbc_mj.util.provenance import plain_data

FORMAT = 3
"""Version of the file format, in which a digest covers the arrays and their description."""


def write_arrays(path: Path, arrays: dict[str, np.ndarray], description: dict[str, Any]) -> None:
    """Write arrays and their description as one safetensors file. An existing file is replaced only by a complete one.

    Args:
        path: the file.
        arrays: arrays by name.
        description: contents of the header, JSON data or dataclasses.

    Raises:
        ConfigurationError: the file cannot be written, for example for lack of space.
    """
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    said = {**plain_data(description), "format": FORMAT}
    said["sha256"] = digest(arrays, said)
    try:
        with staged_file(path, overwrite=True) as staging:
            staging.write_bytes(serialise(arrays, {"marlbc_mj": json.dumps(said, allow_nan=False)}))
    except SafetensorError as error:
        raise ConfigurationError(f"cannot write {path}: {error}") from error


def digest(arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> str:
    """SHA-256 of contiguous arrays with their names, types and shapes, and of their description (JSON data).

    The entry ``sha256`` of ``description`` is excluded.
    """
    said = {name: value for name, value in description.items() if name != "sha256"}
    sha = hashlib.sha256(json.dumps(said, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        sha.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the description that :func:`write_arrays` wrote; nothing in the file is ever executed.

    Raises:
        ConfigurationError: the file does not exist, is incomplete, is not a checkpoint of this package, has another format, or
            differs in any bit from what was written.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get("marlbc_mj")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is not a dict
    except (OSError, SafetensorError, TypeError, AttributeError) as error:  # NumPy has no bfloat16, for example
        raise ConfigurationError(f"cannot read checkpoint {path}: {getattr(error, 'strerror', None) or error}") from error
    try:
        description = json.loads(header or "")
    except (ValueError, RecursionError):
        raise ConfigurationError(f"{path} is not a checkpoint of marlbc_mj: its header does not describe one") from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        found = description.get("format") if isinstance(description, dict) else description
        raise ConfigurationError(f"checkpoint {path} has format {found!r}; this version reads {FORMAT}")
    if not _unchanged(arrays, description, header):
        raise ConfigurationError(f"checkpoint {path} is damaged: its arrays or its header have changed since it was written")
    return arrays, description


def _unchanged(arrays: Mapping[str, np.ndarray], description: Mapping[str, Any], header: str | None) -> bool:
    """Whether arrays and description match their digest, and the header has exactly the text that :func:`write_arrays` writes:
    ``1E-3`` instead of ``1e-3`` is a change, too.
    """
    try:
        return description.get("sha256") == digest(arrays, description) and header == json.dumps(description)
    except RecursionError:
        return False


def write_policy(path: Path, policy: Policy, description: dict[str, Any]) -> None:
    """Write a policy with its description, and the description again as a JSON file beside it for people to read."""
    arrays = {f"weight{k}": w for k, w in enumerate(policy.weights)}
    arrays |= {f"bias{k}": b for k, b in enumerate(policy.biases)}
    description = {**description, "dueling": policy.dueling, "margin": policy.margin, "risk": policy.risk}
    write_arrays(path, {**arrays, "scale": policy.scale}, description)
    write_json(path.with_suffix(".json"), description)


def read_policy(path: Path) -> tuple[Policy, dict[str, Any]]:
    """Read a policy and its description, whose ``signature`` has all entries of :func:`signature`.

    Raises:
        ConfigurationError: as :func:`read_arrays`; arrays that do not form a policy; or a signature with a missing or invalid
            entry.
    """
    arrays, description = read_arrays(path)
    try:
        settings = bool(description["dueling"]), float(description["margin"]), float(description["risk"])
        layers = sum(name.startswith("weight") for name in arrays)
        weights = tuple(arrays[f"weight{k}"] for k in range(layers))
        biases = tuple(arrays[f"bias{k}"] for k in range(layers))
        policy = Policy(weights, biases, arrays["scale"], *settings)
    except (KeyError, OverflowError, TypeError, ValueError):
        raise ConfigurationError(f"checkpoint {path} does not hold the networks of a policy") from None
    fault = _fault(policy, arrays) or _unsigned(description.get("signature"))
    if fault:
        raise ConfigurationError(f"checkpoint {path} does not hold the networks of a policy that is usable: {fault}")
    return policy, description


def _fault(policy: Policy, arrays: Mapping[str, np.ndarray]) -> str:
    """The reason why arrays do not form a valid policy; empty if they do."""
    weights, biases, scale = policy.weights, policy.biases, policy.scale
    if len(arrays) != 2 * len(weights) + 1 or not weights:
        return f"it has the arrays {', '.join(sorted(arrays))}"
    for name, array in arrays.items():
        if array.dtype != np.float32:
            return f"{name} is {array.dtype}, not float32"
        if not np.isfinite(array).all():
            return f"{name} is not finite"
    if any(w.ndim != 3 or b.shape != (len(w), 1, w.shape[2]) for w, b in zip(weights, biases, strict=True)):
        return "weights must be (networks, in, out) and biases (networks, 1, out)"
    if any(a.shape[::2] != (len(b), b.shape[1]) for a, b in itertools.pairwise(weights)) or scale.shape != weights[0].shape[1:2]:
        return f"its layers do not chain: scale {scale.shape}, weights {[w.shape for w in weights]}"
    if not (scale > 0).all():
        return "its scale is not positive"
    if not (math.isfinite(policy.margin) and 0 <= policy.risk <= 1):
        return f"its margin is {policy.margin}, its risk {policy.risk}"
    if policy.columns < 1 or policy.width(policy.columns) != weights[-1].shape[2]:
        return f"its {weights[-1].shape[2]} outputs do not fit a policy with dueling {policy.dueling}, risk {policy.risk}"
    return ""


SIGNATURE_KINDS: dict[str, type] = {
    "agents": int,
    "commands": list,
    "slots": list,
    "mission_step": float,
    "path_velocity": list,
    "safe_distance": float,
    "formation_tolerance": float,
    "reference": str,
    "state": str,
    "layout": dict,
    "actions": str,
    "interval": int,
}
"""Types of the entries of a signature."""


def signature(scenario: Scenario, state: str, actions: str, interval: int) -> dict[str, Any]:
    """The settings for which a policy is trained: team, behaviors, slots, path, state and action set.

    Obstacles, starts, drag and duration are not included, since a policy should cope with different ones.

    Args:
        scenario: the scenario of the team.
        state: name of the kind of state.
        actions: name of the action set.
        interval: mission steps for which a decision holds.
    """
    return {
        "agents": scenario.agents,
        "commands": list(scenario.orders.commands),
        "slots": scenario.formations.tolist(),
        "mission_step": float(scenario.mission_step),
        "path_velocity": [float(v) for v in scenario.path_velocity],
        "safe_distance": float(scenario.safe_distance),
        "formation_tolerance": float(scenario.formation_tolerance),
        "reference": scenario.reference,
        "state": state,
        "layout": make_state(state, scenario).layout,
        "actions": actions,
        "interval": interval,
    }


def _unsigned(found: Any) -> str:
    """The reason why JSON data are not a valid signature; empty if they are."""
    if not isinstance(found, dict):
        return "it has no signature"
    for name, kind in SIGNATURE_KINDS.items():
        if not isinstance(found.get(name), kind) or isinstance(found[name], bool):
            return f"its signature says {name} = {found.get(name)!r}"
    for name, valid in (("state", STATES), ("actions", ACTIONS)):
        if found[name] not in valid:
            return f"its signature says {name} = {found[name]!r}, not one of {', '.join(valid)}"
    if found["interval"] < 1:
        return f"its signature says interval = {found['interval']}, which must be at least 1"
    return ""


def check_signature(path: Path, found: dict[str, Any], scenario: Scenario) -> None:
    """Raise ConfigurationError, naming the first difference, if a checkpoint's signature does not match ``scenario``."""
    fault = _unsigned(found)
    if fault:
        raise ConfigurationError(f"checkpoint {path} cannot be used: {fault}")
    wanted = signature(scenario, found["state"], found["actions"], found["interval"])
    for name, value in wanted.items():
        if found[name] != value:
            raise ConfigurationError(
                f"checkpoint {path} was trained for {name} = {found[name]}; scenario {scenario.name!r} has {value}"
            )


def check_policy(path: Path, policy: Policy, agents: int, actions: int, state: int) -> None:
    """Raise ConfigurationError if a policy's networks do not fit the team.

    Either N networks have A values each, or one network has A^N values of joint actions.

    Args:
        path: the checkpoint, for the message.
        policy: the policy.
        agents: N, number of agents.
        actions: A, number of actions.
        state: S, size of the state.
    """
    networks, columns, inputs = len(policy.weights[0]), policy.columns, len(policy.scale)
    if inputs != state:
        raise ConfigurationError(f"checkpoint {path} has networks for a state of {inputs} numbers; here the state has {state}")
    if (networks, columns) not in {(agents, actions), (1, actions**agents)}:
        raise ConfigurationError(
            f"checkpoint {path} has {networks} networks with {columns} values each; {agents} agents with {actions} actions each "
            f"need {agents} with {actions}, or 1 with {actions**agents}"
        )
