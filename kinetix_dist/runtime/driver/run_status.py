"""status.json of a run, kept true by the thread that drives the run and written by another one."""

from __future__ import annotations

import dataclasses
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.json_lines import read_lines
from kinetix_dist.telemetry.sinks.background import BackgroundSink
from kinetix_dist.telemetry.status import RUNNING, STATUS, Status, write_status
from kinetix_dist.telemetry.utc import utc_text

EVERY_S = 5.0  # between two that differ in numbers only
STARTED = "run_started"  # the event that sessions are counted by


class RunStatus:
    """Of one session. No call waits for the disk."""

    def __init__(self, run: RunDirectory, *, total_env_steps: int, tell: Callable[[str, dict[str, Any]], None]) -> None:
        """total_env_steps: at which the run ends; 0: it ends by time."""
        earlier = sum(row.get("event") == STARTED for row in read_lines(run.events).rows)
        now = utc_text()
        self._status = Status(
            phase="starting",
            pid=os.getpid(),
            host=socket.gethostname(),
            session=earlier + 1,
            started=now,
            time=now,
            update=None,
            env_steps=None,
            total_env_steps=total_env_steps,
            seconds_left=None,
            update_seconds=None,
        )
        self._written_at = 0.0  # s of time.monotonic()
        self._updated_at: float | None = None
        self._sink: BackgroundSink[Status] = BackgroundSink(STATUS, lambda: _Sink(run.status), tell, patience_s=0.0)
        self._write()

    @property
    def session(self) -> int:
        """1, and 1 more with every resume."""
        return self._status.session

    @property
    def num_dropped(self) -> int:
        """Writes that the disk did not take."""
        return self._sink.num_dropped

    def phase(self, name: str) -> None:
        if name != self._status.phase:
            self._status = dataclasses.replace(self._status, phase=name)
            self._write()

    def updated(self, num_updates: int, *, env_steps: int, seconds_left: float | None) -> None:
        """After an update."""
        now, before = time.monotonic(), self._updated_at
        self._updated_at = now
        self._status = dataclasses.replace(
            self._status,
            update=num_updates,
            env_steps=env_steps,
            seconds_left=seconds_left,
            update_seconds=None if before is None else now - before,
        )
        if now - self._written_at >= EVERY_S:
            self._write()

    def ended(self, state: str, error: str | None) -> None:
        """state: of `telemetry.status.STATES`; error: the line that the command ends with."""
        self._status = dataclasses.replace(self._status, state=state, error=error, seconds_left=None)
        self._write()

    def close(self) -> None:
        """Writes the numbers of the last update, too."""
        if self._status.state == RUNNING:
            self._write()
        self._sink.close()

    def _write(self) -> None:
        self._written_at = time.monotonic()
        self._status = dataclasses.replace(self._status, time=utc_text())
        self._sink.write(self._status.update or 0, self._status)


class _Sink:
    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, update: int, status: Status, /) -> None:
        del update
        write_status(self._path, status)

    def close(self) -> None:
        """Nothing is open between two writes."""
