"""Progress of a run: the console, metrics.jsonl, TensorBoard events, status.json, Prometheus where a port is given.

Files and console are written by threads of their own (`telemetry/sinks/background.py`): a full disk costs rows, which
are counted in `telemetry/dropped_rows`, and a console without a reader costs lines; neither costs time or the run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.run_files import LineFile, SinkEvents
from kinetix_dist.telemetry.json_lines import read_lines, utc_text
from kinetix_dist.telemetry.names import check_metrics
from kinetix_dist.telemetry.sinks.background import BackgroundSink, RowSink
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.telemetry.sinks.prometheus import PrometheusSink
from kinetix_dist.telemetry.status import RUNNING, STATUS, Status, write_status

DROPPED_ROWS, DROPPED_WRITES = "telemetry/dropped_rows", "telemetry/dropped_writes"


class RunReporter:
    """A `roles.Reporter`. Files are opened with the first metrics, when it is known where the run goes on."""

    def __init__(
        self, run: RunDirectory, console: ConsoleSink, *, total_env_steps: int = 0, metrics_port: int = 0
    ) -> None:
        """total_env_steps: at which the run ends; 0: it ends by time. metrics_port: where Prometheus finds the last
        row, on loopback; 0: nowhere. Raises PortTakenError."""
        self._served = PrometheusSink(metrics_port, run=run.path.name) if metrics_port else None
        self._run = run
        self._console = console
        self._files: list[BackgroundSink] = []
        self._dropped_before = 0  # by files that are closed
        self._last_update = 0
        self._importing: threading.Thread | None = None
        self._sink_events = SinkEvents(run, self.note)
        # A file on a full disk, or a pipe without a reader.
        self._shown: BackgroundSink[Callable[[], None]] = BackgroundSink("console", _Calls, self._sink_events.put)
        self._status = RunStatus(run, total_env_steps=total_env_steps, on_event=self._sink_events.put)

    @property
    def session(self) -> int:
        """1, and 1 more with every resume."""
        return self._status.session

    def phase(self, name: str) -> None:
        if self._importing is None:  # from now on this process waits for others, where there are others
            self._importing = threading.Thread(target=_import_tensorboard, name="import")
            self._importing.start()
        self._status.phase(name)
        self._show(self._console.set_phase, name)

    def note(self, message: str) -> None:
        self._show(self._console.note, message)

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None:
        """Metrics of the update that led to `num_updates`; rows of later updates, of a killed session, are removed."""
        if not self._files or num_updates <= self._last_update:
            self._close_files()
            self._files = self._open_files(num_updates, env_steps=int(metrics["progress/env_steps"]))
        self._last_update = num_updates
        env_steps = int(metrics["progress/env_steps"])
        self._status.updated(num_updates, env_steps=env_steps, seconds_left=seconds_left)
        dropped_writes = metrics.get(DROPPED_WRITES, 0.0) + self._status.num_dropped
        row = check_metrics({**metrics, DROPPED_ROWS: self._num_dropped(), DROPPED_WRITES: dropped_writes})
        for sink in self._files:
            sink.write(num_updates, row)
        if self._served is not None:
            self._served.write(num_updates, row)
        self._show(self._console.set_seconds_left, seconds_left)
        self._show(self._console.write, num_updates, row)
        self._sink_events.report(self._last_update)

    def ended(self, state: str, error: str | None = None) -> None:
        """Sets the end in status.json: a state of `telemetry.status`, and the line that the command ends with."""
        self._status.ended(state, error)

    def close(self) -> None:
        self._close_files()
        self._status.close()
        self._sink_events.report(self._last_update)
        if self._served is not None:
            self._served.close()
        self._show(self._console.close)
        self._shown.close()
        self._sink_events.report(self._last_update)

    def _open_files(self, num_updates: int, *, env_steps: int) -> list[BackgroundSink]:
        """Nothing is touched before the first row, and then by the threads: whatever goes wrong there stays there."""
        path = self._run.metrics / "metrics.jsonl"

        def open_rows(is_first: bool) -> JsonlSink:
            return JsonlSink(path, resume_at=num_updates - 1 if is_first else None)

        rows = LineFile(self._run.path, open_rows, self._sink_events.put, path)
        points = _Points(self._run.metrics, purge_after=env_steps)
        return [
            BackgroundSink(path.name, rows.open, self._sink_events.put),
            BackgroundSink("TensorBoard", points.open, self._sink_events.put),
        ]

    def _num_dropped(self) -> int:
        return self._dropped_before + sum(sink.num_dropped for sink in self._files)

    def _close_files(self) -> None:
        for sink in self._files:
            sink.close()
        self._dropped_before, self._files = self._num_dropped(), []

    def _show(self, method: Callable[..., None], *arguments: Any) -> None:
        self._shown.write(self._last_update, functools.partial(method, *arguments))


class _Calls:
    """A sink whose rows are calls that write."""

    def write(self, update: int, call: Callable[[], None], /) -> None:
        del update
        try:
            call()
        except SystemExit as end:  # rich's, where a pipe has no reader any more
            raise BrokenPipeError("the console has no reader any more") from end

    def close(self) -> None:
        """Nothing is open between two of them."""


class _Points:
    """The TensorBoard events of a session: one file, also after failures."""

    def __init__(self, directory: Path, *, purge_after: int) -> None:
        self._directory = directory
        self._purge_after = purge_after
        self._path: Path | None = None

    def open(self) -> RowSink:
        tensorboard = _tensorboard()
        self._path = self._path or tensorboard.new_event_file(self._directory)
        return tensorboard.TensorboardSink(self._path, purge_after=self._purge_after)


def _tensorboard() -> ModuleType:
    """The module that writes events. tensorboardX imports PyTorch where that is installed, which takes a second and
    more: not at the start, and not while a row waits."""
    from kinetix_dist.telemetry.sinks import tensorboard

    return tensorboard


def _import_tensorboard() -> None:
    """Imports TensorBoard; an error is raised again, and reported, where a file is opened."""
    with contextlib.suppress(Exception):
        _tensorboard()


EVERY_S = 5.0  # between two that differ in numbers only
STARTED = "run_started"  # the event that sessions are counted by


class RunStatus:
    """status.json of one session. No call waits for the disk."""

    def __init__(
        self, run: RunDirectory, *, total_env_steps: int, on_event: Callable[[str, dict[str, Any]], None]
    ) -> None:
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
        self._sink: BackgroundSink[Status] = BackgroundSink(STATUS, lambda: _Sink(run.status), on_event, patience_s=0.0)
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
