"""Where the progress of a run goes: the console, metrics.jsonl, TensorBoard events, Prometheus where a port is given.

Files are written by threads of their own (`telemetry/sinks/background.py`): a full disk costs rows, which are counted
in `telemetry/dropped_rows`, and never time or the run.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.errors import one_line
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.names import check_metrics
from kinetix_dist.telemetry.sinks.background import BackgroundSink, RowSink
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.telemetry.sinks.prometheus import PrometheusSink
from kinetix_dist.telemetry.sinks.tensorboard import TensorboardSink, new_event_file


class RunReporter:
    """A `roles.Reporter`. Files are opened with the first metrics, when it is known where the run goes on."""

    def __init__(self, run: RunDirectory, console: ConsoleSink, *, metrics_port: int = 0) -> None:
        """metrics_port: where Prometheus finds the last row, on loopback; 0: nowhere. Raises PortTakenError."""
        self._served = PrometheusSink(metrics_port, run=run.path.name) if metrics_port else None
        self._run = run
        self._console = console
        self._is_console_failing = False
        self._files: list[BackgroundSink] = []
        self._dropped_before = 0  # by files that are closed
        self._last_update = 0
        self._news: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()  # from the sinks' threads

    def phase(self, name: str) -> None:
        self._show(self._console.set_phase, name)

    def note(self, message: str) -> None:
        self._show(self._console.note, message)

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None:
        """Metrics of the update that led to `num_updates`; rows of later updates, of a killed session, are removed."""
        if not self._files or num_updates <= self._last_update:
            self._close_files()
            self._files = self._open_files(num_updates, env_steps=int(metrics["progress/env_steps"]))
        self._last_update = num_updates
        row = check_metrics({**metrics, "telemetry/dropped_rows": self._num_dropped()})
        for sink in self._files:
            sink.write(num_updates, row)
        if self._served is not None:
            self._served.write(num_updates, row)
        self._show(self._console.set_seconds_left, seconds_left)
        self._show(self._console.write, num_updates, row)
        self._tell()

    def close(self) -> None:
        self._close_files()
        self._tell()
        if self._served is not None:
            self._served.close()
        self._show(self._console.close)

    def _open_files(self, num_updates: int, *, env_steps: int) -> list[BackgroundSink]:
        """Nothing is touched before the first row, and then by the threads: whatever goes wrong there stays there."""
        rows = _Rows(self._run.metrics / "metrics.jsonl", resume_at=num_updates - 1, tell=self._hear)
        points = _Points(self._run.metrics, purge_after=env_steps)
        return [
            BackgroundSink("metrics.jsonl", rows.open, self._hear),
            BackgroundSink("TensorBoard", points.open, self._hear),
        ]

    def _num_dropped(self) -> int:
        return self._dropped_before + sum(sink.num_dropped for sink in self._files)

    def _close_files(self) -> None:
        for sink in self._files:
            sink.close()
        self._dropped_before, self._files = self._num_dropped(), []

    def _hear(self, kind: str, details: dict[str, Any]) -> None:
        self._news.put((kind, details))

    def _tell(self) -> None:
        """What the threads have to say becomes events and notes here, in the thread of the run."""
        self._run.write_pending_events()
        while not self._news.empty():
            kind, details = self._news.get()
            self._run.event(kind, update=self._last_update, **details)
            if kind == "sink_failing":
                self.note(f"{details['sink']}: {details['error']}; rows are dropped and counted, training goes on")
            elif kind == "sink_recovered":
                self.note(f"{details['sink']} takes rows again; {details['dropped']} were dropped")

    def _show(self, method: Callable[..., None], *arguments: Any) -> None:
        """The console may be a file on a full disk, or a pipe that nobody reads any more."""
        try:
            method(*arguments)
        except OSError as error:
            if not self._is_console_failing:
                self._is_console_failing = True
                self._run.event("sink_failing", sink="console", error=one_line(error), update=self._last_update)
        else:
            if self._is_console_failing:
                self._is_console_failing = False
                self._run.event("sink_recovered", sink="console", update=self._last_update)


class _Rows:
    """metrics.jsonl, opened for a session and again after failures."""

    def __init__(self, path: Path, *, resume_at: int, tell: Callable[[str, dict[str, Any]], None]) -> None:
        self._path = path
        self._resume_at: int | None = resume_at
        self._tell = tell

    def open(self) -> RowSink:
        sink = JsonlSink(self._path, resume_at=self._resume_at)
        self._resume_at = None  # rows of this session are kept from now on
        name = f"{self._path.parent.name}/{self._path.name}"
        if sink.set_aside is not None:
            self._tell("file_set_aside", {"file": name, "to": sink.set_aside.name, "reason": "it cannot be read"})
        if sink.num_damaged:
            aside = f"{self._path.parent.name}/{sink.damaged_path.name}"
            self._tell("lines_set_aside", {"file": name, "lines": sink.num_damaged, "to": aside})
        return sink


class _Points:
    """The TensorBoard events of a session: one file, also after failures."""

    def __init__(self, directory: Path, *, purge_after: int) -> None:
        self._directory = directory
        self._purge_after = purge_after
        self._path: Path | None = None

    def open(self) -> RowSink:
        self._path = self._path or new_event_file(self._directory)
        return TensorboardSink(self._path, purge_after=self._purge_after)
