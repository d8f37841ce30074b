"""Writing an episode to an MCAP log while it runs, so that a killed run leaves a log that can be recovered.

Metadata and attachments come first, and every chunk holds whole mission steps, so a file torn anywhere holds a shorter episode.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from marlbc_mj.controllers import Controller, sorlc
from marlbc_mj.core import laws
from marlbc_mj.core.communication import IDEAL
from marlbc_mj.engine.plan import Plan, make_plan
from marlbc_mj.episode import Frame
from marlbc_mj.recording import schemas
from marlbc_mj.recording.scene import SCENE_TOPIC, TRANSFORMS_TOPIC, Scene, foxglove_layout
from marlbc_mj.scenarios import Draw, Scenario
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import check_target, take_name
from marlbc_mj.util.locks import is_held, lock
from marlbc_mj.util.provenance import config_hash, git_revision, plain_data, versions

METADATA = "marlbc"
"""Name of the metadata record with the fields of :class:`EpisodeLog` that are not in messages."""
VERSIONS = "versions"
MODEL, CONFIG, LAYOUT = "model.xml", "config.json", "foxglove-layout.json"

_versions = cache(versions)  # reading them from the packages takes a tenth of the time of an episode

FLUSH_PERIOD = 0.5  # wall time after which a chunk is closed and handed to the operating system [s]
CHUNK_SIZE = 1024 * 1024  # size from which on a chunk is closed earlier [bytes]


class LogWriter:
    """Writes one episode: ``run_episode(..., on_frame=log.write)`` inside ``with LogWriter(...) as log``.

    During the run the file is named ``PATH.partial``. Its data are passed to the operating system every half second, so a
    killed process loses less than a second. When the ``with`` block ends normally, the file is renamed to ``PATH``. After an
    exception inside the block the episode is incomplete, so the name stays ``PATH.partial``; the file is still closed properly,
    and readable, if the disk allows it.

    Args:
        path: a name that ends in ``.mcap``; missing folders are created.
        scenario: the mission that is flown.
        controller: the controller of the agents.
        names: names of supervisor and controller.
        seed: seed of the scenario's draw.
        config: all settings, attached as JSON; their hash is part of the metadata.
        overwrite: replace a log, finished or partial, of the same name.
        plan: plan of the world that runs. It has the model, and a shield in it adds a topic to the log. None: a plan without
            a shield is made for the log.

    Raises:
        ConfigurationError: a path that cannot or must not be written, or a scenario that cannot be assembled.
    """

    def __init__(
        self,
        path: str | Path,
        scenario: Scenario,
        controller: Controller,
        *,
        names: tuple[str, str],
        seed: int,
        config: dict[str, Any],
        overwrite: bool = False,
        plan: Plan | None = None,
    ) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        draw = scenario.draw_of(seed)
        metadata = {
            "supervisor": names[0],
            "controller": names[1],
            "seed": str(seed),
            "config_sha256": config_hash(config),
            "revision": git_revision(),
            **_describe(scenario, controller, draw),
        }
        plan = plan or make_plan(scenario, controller)
        attachments = _attachments(scenario, plan.xml, config)
        self._scene = Scene(scenario, draw.obstacles, draw.motions)
        self._rows = [f'{{"command":{json.dumps(c)},"index":{k}}}' for k, c in enumerate(scenario.orders.commands)]
        self._weighted = laws.interface(controller.law).state == sorlc.STATE
        self._posed = scenario.fleet.floating
        self._shielded = plan.shielded
        self._communicating = scenario.communication != IDEAL
        self._steps = 0
        self._pending = 0  # size of the messages since the last flush [bytes]
        self._flushed = monotonic()  # time of the last flush [s]
        self._stream = _create(self.path, overwrite)
        lock(self._stream.fileno())
        try:
            self._start(metadata, attachments)
        except OSError as error:
            with suppress(OSError):
                self._stream.close()
            raise ConfigurationError(f"cannot write {self.path}: {error.strerror}") from error

    @property
    def partial(self) -> Path:
        """Name of the file while it is being written."""
        return partial_name(self.path)

    def write(self, frame: Frame) -> None:
        """Append one mission step.

        Raises:
            SimulationError: the file cannot be written.
        """
        stamp = round(float(frame.observation.time) * 1e9)
        try:
            for topic, data in self._messages(frame, stamp):
                self._mcap.add_message(self._channels[topic], stamp, data, stamp, self._steps)
                self._pending += len(data)
            self._steps += 1
            now = monotonic()
            if self._pending >= CHUNK_SIZE or now - self._flushed >= FLUSH_PERIOD:
                self._mcap.flush()
                self._pending, self._flushed = 0, now
        except OSError as error:
            raise SimulationError(f"cannot write {self.partial}: {error.strerror}") from error

    def close(self) -> None:
        """Finish the file and give it its final name; does nothing if the file is already closed.

        Raises:
            ConfigurationError: another file has taken the name in the meantime.
            SimulationError: the file cannot be written.
        """
        if self._stream.closed:
            return
        try:
            self._end()
            if self._overwrite:
                os.replace(self.partial, self.path)
            else:
                take_name(self.partial, self.path)
                self.partial.unlink(missing_ok=True)
        except OSError as error:
            raise SimulationError(f"cannot write {self.path}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None:
            self.close()
        elif not self._stream.closed:
            with suppress(OSError):  # the original exception is more informative than one about a full disk
                self._end()

    def _start(self, metadata: dict[str, str], attachments: list[tuple[str, str, bytes]]) -> None:
        """Write header, metadata and attachments, before the first mission step."""
        # Chunks use zstd by default. This class decides when to close a chunk: the library could do so between two messages of
        # one mission step, which would split the step.
        self._mcap = Writer(self._stream, chunk_size=sys.maxsize, enable_data_crcs=True)
        self._mcap.start(library=f"marlbc_mj {versions()['marlbc-mj']}")
        self._mcap.add_metadata(METADATA, metadata)
        self._mcap.add_metadata(VERSIONS, _versions())
        for name, media_type, data in attachments:
            self._mcap.add_attachment(0, 0, name, media_type, data)
        self._channels = self._register()
        self._mcap.flush()

    def _register(self) -> dict[str, int]:
        """Register all channels, and return their numbers by topic."""
        channels = {}
        for name, message in ((SCENE_TOPIC, SceneUpdate), (TRANSFORMS_TOPIC, FrameTransforms)):
            channels[name] = self._mcap.register_channel(name, "protobuf", register_schema(self._mcap, message))
        some = ((schemas.POSE, self._posed), (schemas.SHIELD, self._shielded), (schemas.COMMUNICATION, self._communicating))
        for topic in (*schemas.TOPICS, *(topic for topic, there in some if there)):
            if topic is not schemas.WEIGHTS or self._weighted:
                text = json.dumps(schemas.json_schema(topic)).encode()
                schema = self._mcap.register_schema(topic.schema_name, schemas.SCHEMA_ENCODING, text)
                channels[topic.name] = self._mcap.register_channel(topic.name, schemas.MESSAGE_ENCODING, schema)
        return channels

    def _messages(self, frame: Frame, stamp: int) -> Iterator[tuple[str, bytes]]:
        """All messages of one mission step."""
        seen, first = frame.observation, frame.first
        scene, transforms = self._scene.encode(stamp, first.position, first.reference, frame.hearing)
        yield SCENE_TOPIC, scene
        yield TRANSFORMS_TOPIC, transforms
        motion = np.concatenate([first.position, first.velocity], axis=1)
        yield "/state", schemas.encode(schemas.STATE_TOPIC, motion, time=float(seen.time))
        reference = np.concatenate([first.reference, first.reference_velocity], axis=1)
        yield "/reference", schemas.encode(schemas.REFERENCE, reference)
        yield "/force", schemas.encode(schemas.FORCE, first.force)
        yield schemas.SUBSTEP_ROWS.name, schemas.encode_substeps(frame.record, frame.after)
        yield "/priorities", schemas.message([], ",".join([self._rows[k] for k in frame.command.tolist()]))
        if self._posed:
            yield schemas.POSE.name, schemas.encode(schemas.POSE, frame.pose)
        if self._shielded and frame.shield is not None:
            interventions, change, breaches = frame.shield
            yield schemas.SHIELD.name, schemas.encode(schemas.SHIELD, np.column_stack([interventions, change, breaches]))
        if frame.hearing is not None:
            yield schemas.COMMUNICATION.name, schemas.encode_hearing(frame.hearing)
        if self._weighted:
            yield "/weights", schemas.encode(schemas.WEIGHTS, _weight_table(frame.controller_state))
        verdicts = {"formation": int(seen.formation), "reward": float(frame.reward), "decision_ms": float(frame.decision_ms)}
        yield "/metrics", schemas.encode(schemas.METRICS, seen.clearance[:, None], **verdicts)

    def _end(self) -> None:
        try:
            self._mcap.finish()
        finally:
            self._stream.close()


def partial_name(path: Path) -> Path:
    """Name of a log while it is being written."""
    return path.with_name(path.name + ".partial")


def _create(path: Path, overwrite: bool) -> BinaryIO:
    """Check that a log may be written, and open its partial file."""
    if path.suffix != ".mcap":
        raise ConfigurationError(f"a log's name must end in .mcap, got {path}")
    partial = partial_name(path)
    try:
        check_target(path, overwrite=overwrite)
        path.parent.mkdir(parents=True, exist_ok=True)
        if overwrite and partial.exists() and is_held(partial):
            raise ConfigurationError(f"{partial} is being written by a run in progress; choose another name")
        return open(partial, "wb" if overwrite else "xb")
    except FileExistsError as error:
        if not partial.exists():  # a file where a folder should be
            raise ConfigurationError(f"cannot write {path}: {error.filename} is not a folder") from error
        raise ConfigurationError(
            f"{partial} exists: a run in progress, or a torn log that `marlbc log recover {partial} OUT` salvages; "
            "choose another name or add --overwrite"
        ) from error
    except OSError as error:
        raise ConfigurationError(f"cannot write {path}: {error.strerror}") from error


def _describe(scenario: Scenario, controller: Controller, draw: Draw) -> dict[str, str]:
    """The scenario's fields of an :class:`EpisodeLog`, as strings that read back exactly."""
    return {
        "scenario": scenario.name,
        "composition": scenario.composition,
        "mission_step": repr(float(scenario.mission_step)),
        "substep": repr(float(scenario.substep)),
        "safe_distance": repr(float(scenario.safe_distance)),
        "force_limit": repr(float(scenario.force_limit)) if controller.limited else "inf",
        "scenario_force_limit": repr(float(scenario.force_limit)),
        "robots": json.dumps([robot.name for robot in scenario.fleet.robots]),
        **({"robot_force_limits": json.dumps(scenario.force_limits.tolist())} if scenario.robots else {}),
        "path": json.dumps((scenario.path_origin, scenario.path_velocity)),
        "slots": json.dumps(scenario.formations.tolist()),
        "commands": json.dumps(scenario.orders.commands),
        "obstacles": json.dumps(draw.obstacles.tolist()),
        "motions": json.dumps(draw.motions.tolist()),
        **({} if draw.layout is None else {"layout": str(draw.layout), "split": scenario.split}),
    }


def _attachments(scenario: Scenario, model: str, config: dict[str, Any]) -> list[tuple[str, str, bytes]]:
    """Name, media type and content of every attachment."""
    canonical = json.dumps(plain_data(config), sort_keys=True, separators=(",", ":"))  # what config_hash hashes
    return [
        (CONFIG, "application/json", canonical.encode()),
        (MODEL, "application/xml", model.encode()),
        (LAYOUT, "application/json", json.dumps(foxglove_layout(scenario)).encode()),
    ]


def _weight_table(state: np.ndarray) -> np.ndarray:
    """Norms of w_f, w_a and w_c, and both components of tau, as columns (N, 5) from controller states (N, S)."""
    weights = sorlc.weights(state)
    table = np.empty((len(state), 5))
    for k, matrix in enumerate(weights[:3]):
        table[:, k] = np.sqrt(np.einsum("nkj,nkj->n", matrix, matrix))
    table[:, 3:] = weights.tau
    return table
