"""Metrics and evaluations as TensorBoard event files.

tensorboardX writes them from a thread whose queue blocks for ever once that thread has died, of a full disk say. So its
records go through `AtomicAppender` here: an error is raised where it happens, and a file holds whole records only.
tensorboardX imports PyTorch where that is installed, which takes a second and more: it is imported where it is used.
"""

from __future__ import annotations

import math
import os
import socket
import struct
import time
from collections.abc import Mapping
from typing import Any

from kinetix_dist.atomic_files import AtomicAppender
from kinetix_dist.telemetry.names import check_metrics
from kinetix_dist.telemetry.sinks.background import PATIENCE_S
from kinetix_dist.telemetry.sinks.sink import SINKS, Evaluation, Sink, SinkRun

DIRECTORY = "metrics"  # of the run directory
_FILE_VERSION = "brain.Event:2"  # what TensorBoard takes a file for


class TensorboardSink(Sink):
    """Scalars against environment steps, a file for each part of a run, which hides later points of earlier parts."""

    patience_s = PATIENCE_S  # for the disk, as metrics.jsonl

    def __init__(self, run: SinkRun) -> None:
        """A file that is there already, after a failure, is gone on with."""
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        # TensorBoard reads the files of a directory in the order of their names.
        name = f"events.out.tfevents.{int(run.began_at)}.{socket.gethostname()}.{os.getpid()}.{run.id}"
        path = run.directory / DIRECTORY / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = AtomicAppender(path)
        if self._file.size == 0:
            hidden = Event(
                wall_time=time.time(), step=run.from_env_steps, session_log=SessionLog(status=SessionLog.START)
            )
            self._append(Event(wall_time=time.time(), file_version=_FILE_VERSION), hidden)

    @classmethod
    def prepare(cls) -> None:
        import tensorboardX.summary  # noqa: F401

    def metrics(self, update: int, metrics: Mapping[str, float]) -> None:
        """One point a metric, at `progress/env_steps`."""
        self._write(int(metrics.get("progress/env_steps", update)), metrics)

    def evaluated(self, evaluation: Evaluation) -> None:
        """One point a rate, at the environment steps of the policy that was evaluated."""
        self._write(evaluation.env_steps, evaluation.metrics)

    def close(self) -> None:
        self._file.close()

    def _write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Values that are not finite are left out."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        finite = {name: value for name, value in check_metrics(metrics).items() if math.isfinite(value)}
        self._append(*(Event(wall_time=time.time(), step=step, summary=scalar(*item)) for item in finite.items()))

    def _append(self, *events: Any) -> None:
        self._file.append(b"".join(map(_record, events)))


def _record(event: Any) -> bytes:
    """TFRecord: length, its checksum, the message, its checksum."""
    from tensorboardX.record_writer import masked_crc32c

    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc32c(length)) + data + struct.pack("<I", masked_crc32c(data))


SINKS.register("tensorboard", TensorboardSink)
