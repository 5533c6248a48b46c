"""Metrics as TensorBoard event files.

tensorboardX writes them from a thread whose queue blocks for ever once that thread has died, of a full disk say. So its
records go through `AtomicAppender` here: an error is raised where it happens, and a file holds whole records only.
"""

from __future__ import annotations

import math
import os
import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.record_writer import masked_crc32c
from tensorboardX.summary import scalar

from kinetix_dist.atomic_files import AtomicAppender
from kinetix_dist.telemetry.names import check_metrics

_FILE_VERSION = "brain.Event:2"  # what TensorBoard takes a file for


def new_event_file(directory: Path) -> Path:
    """A name that no other session and no other sink of this process has."""
    name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
    number = 0
    while (path := directory / f"{name}.{number}").exists():
        number += 1
    return path


class TensorboardSink:
    """Writes scalars against environment steps; `purge_after` hides points of a killed session beyond it."""

    def __init__(self, path: Path, *, purge_after: int | None = None) -> None:
        """path: of an event file; one that is there already is gone on with."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = AtomicAppender(path)
        if self._file.size == 0:
            events = [Event(wall_time=time.time(), file_version=_FILE_VERSION)]
            if purge_after is not None:
                start = SessionLog(status=SessionLog.START)
                events.append(Event(wall_time=time.time(), step=purge_after, session_log=start))
            self._file.append(b"".join(map(_record, events)))

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """One point a metric, at `progress/env_steps`; values that are not finite are left out."""
        values = check_metrics(metrics)
        step = int(values.get("progress/env_steps", update))
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        events = (Event(wall_time=time.time(), step=step, summary=scalar(*item)) for item in finite.items())
        self._file.append(b"".join(map(_record, events)))

    def close(self) -> None:
        self._file.close()


def _record(event: Event) -> bytes:
    """TFRecord: length, its checksum, the message, its checksum."""
    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc32c(length)) + data + struct.pack("<I", masked_crc32c(data))
