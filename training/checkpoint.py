"""Checkpoints: arrays in safetensors with their description as JSON in the header, written whole or not at all."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialise

from marlbc_mj.errors import ConfigurationError
from marlbc_mj.files import staged_file, write_json
from marlbc_mj.provenance import plain_data
from marlbc_mj.scenarios import Scenario
from marlbc_mj.training.policy import Policy

FORMAT = 1
"""Raised when older checkpoints can no longer be read."""


def write_arrays(path: Path, arrays: dict[str, np.ndarray], description: dict[str, Any]) -> None:
    """Arrays and their description as one safetensors file; a file that is there is replaced only by a whole one.

    Raises:
        ConfigurationError: the file cannot be written, no space left for example.
    """
    header = {"marlbc_mj": json.dumps({"format": FORMAT, **plain_data(description)}, allow_nan=False)}
    try:
        with staged_file(path, overwrite=True) as staging:
            staging.write_bytes(serialise({name: np.ascontiguousarray(array) for name, array in arrays.items()}, header))
    except SafetensorError as error:
        raise ConfigurationError(f"cannot write {path}: {error}") from error


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What :func:`write_arrays` wrote; nothing in the file is ever executed.

    Raises:
        ConfigurationError: no such file, torn, not a checkpoint of this package, or of another format.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get("marlbc_mj")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is not a dict
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"cannot read checkpoint {path}: {getattr(error, 'strerror', None) or error}") from error
    try:
        description = json.loads(header or "")
    except json.JSONDecodeError:
        raise ConfigurationError(f"{path} is no checkpoint of marlbc_mj: its header does not describe one") from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        found = description.get("format") if isinstance(description, dict) else description
        raise ConfigurationError(f"checkpoint {path} has format {found!r}; this version reads {FORMAT}")
    return arrays, description


def write_policy(path: Path, policy: Policy, description: dict[str, Any]) -> None:
    """A policy with its description, and the description once more as JSON beside it for people."""
    arrays = {f"weight{k}": w for k, w in enumerate(policy.weights)}
    arrays |= {f"bias{k}": b for k, b in enumerate(policy.biases)}
    description = {**description, "dueling": policy.dueling, "margin": policy.margin, "risk": policy.risk}
    write_arrays(path, {**arrays, "scale": policy.scale}, description)
    write_json(path.with_suffix(".json"), description)


def read_policy(path: Path) -> tuple[Policy, dict[str, Any]]:
    """A policy and its description.

    Raises:
        ConfigurationError: as :func:`read_arrays`, or arrays that do not make a policy.
    """
    arrays, description = read_arrays(path)
    layers = sum(name.startswith("weight") for name in arrays)
    try:
        weights = tuple(arrays[f"weight{k}"] for k in range(layers))
        biases = tuple(arrays[f"bias{k}"] for k in range(layers))
        settings = bool(description["dueling"]), float(description["margin"]), float(description["risk"])
        policy = Policy(weights, biases, arrays["scale"], *settings)
        fits = layers > 0 and all(
            w.ndim == b.ndim == 3 and w.shape[::2] == b.shape[::2] for w, b in zip(weights, biases, strict=True)
        )
    except (KeyError, TypeError, ValueError):
        fits = False
    if not fits or not all(np.isfinite(a).all() for a in arrays.values()):
        raise ConfigurationError(f"checkpoint {path} does not hold the networks of a policy")
    return policy, description


def signature(scenario: Scenario, state: str, actions: str, interval: int) -> dict[str, Any]:
    """What a policy is tied to: a team, its behaviors and slots, what it sees and what it chooses from."""
    return {
        "agents": scenario.agents,
        "commands": list(scenario.orders.commands),
        "slots": scenario.formations.tolist(),
        "mission_step": scenario.mission_step,
        "state": state,
        "actions": actions,
        "interval": interval,
    }


def check_signature(path: Path, found: dict[str, Any], scenario: Scenario) -> None:
    """Raise ConfigurationError where a checkpoint's signature is not that of ``scenario``, naming the first difference."""
    wanted = signature(scenario, found.get("state", ""), found.get("actions", ""), found.get("interval", 1))
    for name, value in wanted.items():
        if found.get(name) != value:
            raise ConfigurationError(
                f"checkpoint {path} was trained for {name} = {found.get(name)}; scenario {scenario.name!r} has {value}"
            )
