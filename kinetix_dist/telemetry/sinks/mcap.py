"""Rollouts to an MCAP file, from a thread that training never waits for.

    trainer --write(rollout)--> [queue, bounded] --> writing thread --> FILE.mcap

| who            | consumes            | waits for            | when it cannot go on                               |
|----------------|---------------------|----------------------|----------------------------------------------------|
| `write`        | one rollout         | nothing, ever        | queue full: rollout dropped, counted, event        |
| writing thread | rollouts from queue | the queue, the disk  | disk error: event, file stays whole, rest dropped  |
| `close`        |                     | the thread, timeout  | timeout: event; the file has no end but is readable|

One protobuf message a state (rollout_schema.py), one metadata record a rollout with its level and outcome, zstd
chunks of at most 1 MiB. Pictures for Foxglove (scene_updates.py) follow in chunks of their own: like compresses better
with like, and what damages a picture leaves the rollout whole. Every rollout is flushed with one `write` to the file,
so that a killed process loses only what was still in the queue, and a full disk leaves whole rollouts behind.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import queue
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from kinetix_dist.atomic_files import append_atomically
from kinetix_dist.json_text import json_text
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.rollout_schema import MESSAGE, PACKAGE, Sizes, encode_messages, file_descriptor_set
from kinetix_dist.telemetry.scene_updates import fixed_scene, moving_scenes

METADATA_NAME = "kinetix_dist.rollout"
TOPIC = "/rollout/step"
STEP_CHANNEL = 1  # id of that channel in every file: the first one, so that a reader needs no channel record
SCENE_TOPIC, FIXED_SCENE_TOPIC = "/rollout/scene", "/rollout/scene/fixed"
FORMAT_VERSION = "1"
CHUNK_BYTES = 1 << 20
QUEUE_ROLLOUTS = 64  # about 7 MB of 256-step rollouts of size M: seconds of a slow disk, no more
GAP_NS = 1_000_000_000  # between rollouts on the file's clock, so that viewers show them apart

EventHandler = Callable[[str, dict[str, Any]], None]


def metadata_checksum(entries: dict[str, str]) -> str:
    """CRC-32 of a metadata record without its "crc32" entry: MCAP itself has none for metadata."""
    rest = {key: value for key, value in entries.items() if key != "crc32"}
    return f"{zlib.crc32(json_text(rest, sort_keys=True).encode()):08x}"


class RolloutWriter:
    """Writes rollouts to a new MCAP file, in the calling thread. Raises OSError when the disk does."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = _WholeFlushes(path)
        self._writer = Writer(
            self._file,  # pyrefly: ignore[bad-argument-type]  # has what Writer uses: write, tell, flush
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._writer.start(profile="", library="kinetix-dist")
        schema = self._writer.register_schema(f"{PACKAGE}.{MESSAGE}", "protobuf", file_descriptor_set())
        self._channel = self._writer.register_channel(TOPIC, "protobuf", schema)
        assert self._channel == STEP_CHANNEL, f"{TOPIC} has channel {self._channel}"
        scene = register_schema(self._writer, SceneUpdate)
        self._scene = self._writer.register_channel(SCENE_TOPIC, "protobuf", scene)
        self._fixed_scene = self._writer.register_channel(FIXED_SCENE_TOPIC, "protobuf", scene)
        self.num_rollouts = 0
        self._clock_ns = 0

    @property
    def num_bytes(self) -> int:
        """Size of the file so far."""
        return self._file.written

    def write(self, rollout: Rollout) -> None:
        sizes = sizes_of(rollout)
        self._writer.add_metadata(METADATA_NAME, _metadata(self.num_rollouts, rollout, sizes))
        times = (self._clock_ns + np.rint(rollout.seconds * 1e9).astype(np.int64)).tolist()
        self._add_messages(self._channel, times, encode_messages(sizes, _columns(self.num_rollouts, rollout)))
        self._end_chunk()
        self._add_messages(self._fixed_scene, times[:1], [fixed_scene(rollout, times[0])])
        self._add_messages(self._scene, times, moving_scenes(rollout, times))
        self._writer.flush()
        self.num_rollouts += 1
        self._clock_ns = times[-1] + GAP_NS

    def _add_messages(self, channel: int, times: Sequence[int], messages: Iterable[bytes]) -> None:
        for step, (time, message) in enumerate(zip(times, messages, strict=True)):
            self._writer.add_message(channel, log_time=time, data=message, publish_time=time, sequence=step)

    def _end_chunk(self) -> None:
        """Begins another chunk; nothing is written to the disk yet."""
        with self._file.held():
            self._writer.flush()

    def finish(self) -> None:
        """Writes the index and closes the file."""
        try:
            self._writer.finish()
            self._file.flush()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Closes the file as it is: without an index, readable up to the last whole rollout."""
        self._file.close()


@dataclasses.dataclass(frozen=True, kw_only=True)
class SinkStats:
    """Counts of the rollouts given to a sink, by their fate."""

    written: int  # rollouts on disk
    dropped: int  # rollouts given up, because the queue was full or the file had failed
    queued: int  # rollouts waiting
    num_bytes: int  # size of the file
    error: str | None  # why the file was given up; None while all is well


class McapSink:
    """Records rollouts without ever stalling the caller. See the table above.

    `on_event(name, fields)` is called with "recording_dropped" (from the thread that called `write`; at the 1st,
    2nd, 4th, 8th ... drop) and "recording_failed" (from the writing thread). It must not block.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        max_queued: int = QUEUE_ROLLOUTS,
        on_event: EventHandler | None = None,
    ) -> None:
        if max_queued < 1:
            raise ValueError(f"max_queued is {max_queued}; the queue holds at least one rollout")
        self.path = os.fspath(path)
        self._writer = RolloutWriter(path)
        self._queue: queue.Queue[Rollout | None] = queue.Queue(maxsize=max_queued)
        self._on_event = on_event
        self._lock = threading.Lock()
        self._written = 0
        self._dropped = 0
        self._error: str | None = None
        self._is_closed = False
        # A daemon: a disk that hangs must not keep a finished training process alive.
        self._thread = threading.Thread(target=self._work, name=f"mcap {self.path}", daemon=True)
        self._thread.start()

    def write(self, rollout: Rollout) -> bool:
        """Queues a rollout. Returns at once; False when it was dropped."""
        if self._is_closed:
            raise RuntimeError(f"{self.path} is closed; open a new McapSink to record more")
        if self._error is None:
            try:
                self._queue.put_nowait(rollout)
                return True
            except queue.Full:
                self._drop("the queue is full: the disk is slower than rollouts come")
                return False
        self._drop("the file failed earlier")
        return False

    def stats(self) -> SinkStats:
        with self._lock:
            return SinkStats(
                written=self._written,
                dropped=self._dropped,
                queued=self._queue.qsize(),
                num_bytes=self._writer.num_bytes,
                error=self._error,
            )

    def close(self, timeout: float = 30.0) -> SinkStats:
        """Writes what is queued and the file's index, for at most `timeout` seconds. Safe to call twice."""
        if not self._is_closed:
            self._is_closed = True
            try:
                self._queue.put(None, timeout=timeout)
                self._thread.join(timeout)
            except queue.Full:
                pass
            if self._thread.is_alive():
                self._fail(f"{self.path} was not finished within {timeout:g} s; it is readable but has no index")
        return self.stats()

    def __enter__(self) -> McapSink:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _work(self) -> None:
        """Consumes rollouts until None. After an error it goes on consuming, so that `close` is not held up."""
        while (rollout := self._queue.get()) is not None:
            if self._error is not None:
                self._drop("the file failed earlier")
                continue
            try:
                self._writer.write(rollout)
            except Exception as error:  # whatever it is, training goes on and hears of it
                self._drop(None)
                self._fail(_explain(self.path, error))
                self._writer.abandon()
            else:
                with self._lock:
                    self._written += 1
        if self._error is None:
            try:
                self._writer.finish()
            except Exception as error:
                self._fail(_explain(self.path, error))

    def _drop(self, reason: str | None) -> None:
        with self._lock:
            self._dropped += 1
            dropped = self._dropped
        if reason is not None and dropped & (dropped - 1) == 0:
            self._report("recording_dropped", {"path": self.path, "dropped": dropped, "reason": reason})

    def _fail(self, text: str) -> None:
        with self._lock:
            if self._error is not None:
                return
            self._error = text
            written = self._written
        self._report("recording_failed", {"path": self.path, "error": text, "written": written})

    def _report(self, name: str, fields: dict[str, Any]) -> None:
        if self._on_event is not None:
            self._on_event(name, fields)


class _WholeFlushes:
    """A file whose flushes succeed as a whole or leave the file as it was."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            self._file = open(path, "xb", buffering=0)  # noqa: SIM115  (closed by close)
        except FileExistsError:
            message = "exists already; recordings are never overwritten: give another name"
            raise FileExistsError(f"{os.fspath(path)} {message}") from None
        self._pending = bytearray()
        self._is_held = False
        self.written = 0

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self.written + len(self._pending)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Flushes within wait for the next one."""
        self._is_held = True
        try:
            yield
        finally:
            self._is_held = False

    def flush(self) -> None:
        if self._is_held:
            return
        append_atomically(self._file, bytes(self._pending), self.written)
        self.written += len(self._pending)
        self._pending.clear()

    def close(self) -> None:
        self._file.close()


def sizes_of(rollout: Rollout) -> Sizes:
    return Sizes(
        shapes=rollout.num_shapes,
        joints=rollout.motor.shape[1],
        thrusters=rollout.thruster.shape[1],
        actions=rollout.actions.shape[1],
    )


def _columns(index: int, rollout: Rollout) -> dict[str, np.ndarray]:
    """Message k holds state k and the step that led to it; zeros where none did (k = 0)."""

    def led_here(values: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros_like(values[:1], shape=(1, *values.shape[1:])), values])

    return {
        "rollout": np.asarray(index),
        "step": np.arange(rollout.num_steps + 1),
        **{name: getattr(rollout, name) for name in ("position", "angle", "velocity", "angular_velocity")},
        **{name: led_here(getattr(rollout, name)) for name in ("actions", "motor", "thruster", "reward")},
    }


def _metadata(index: int, rollout: Rollout, sizes: Sizes) -> dict[str, str]:
    entries = {
        "format": FORMAT_VERSION,
        "rollout": str(index),
        "level": rollout.level_json,
        "level_name": rollout.level_name,
        "outcome": rollout.outcome,
        "policy_version": str(rollout.policy_version),
        "seed": str(rollout.seed),
        "num_steps": str(rollout.num_steps),
        "step_seconds": repr(rollout.step_seconds),
        "actions": json_text([dataclasses.asdict(name) for name in rollout.action_names]),
        **{f"num_{name}": str(value) for name, value in dataclasses.asdict(sizes).items()},
    }
    return {**entries, "crc32": metadata_checksum(entries)}


def _explain(path: str, error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{path} cannot be written: {error.strerror or error}; recording stops, training goes on"
    return f"{path}: {type(error).__name__}: {error}; recording stops, training goes on"
