"""Progress of a run: the console, metrics.jsonl, sinks (`run.sinks`), status.json, Prometheus where a port is given.

Files, sinks and console are written by threads of their own (`telemetry/sinks/background.py`): a full disk costs rows,
which are counted in `telemetry/dropped_rows`, and a console without a reader costs lines; neither costs time or the
run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.run_files import LineFile, SinkEvents
from kinetix_dist.telemetry.json_lines import read_lines, utc_text
from kinetix_dist.telemetry.names import check_metrics
from kinetix_dist.telemetry.sinks import SINKS, Evaluation, Sink, SinkRun
from kinetix_dist.telemetry.sinks.background import BackgroundSink, close_sinks
from kinetix_dist.telemetry.sinks.console import Progress
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.telemetry.sinks.prometheus import PrometheusSink
from kinetix_dist.telemetry.status import RUNNING, STATUS, Status, write_status

DROPPED_ROWS, DROPPED_WRITES = "telemetry/dropped_rows", "telemetry/dropped_writes"
MAX_EARLY_EVENTS = 200  # held until sinks are opened, whose queues hold a few more
Call = tuple[str, tuple[Any, ...]]  # method of a sink, arguments


class RunReporter:
    """A `roles.Reporter`. Files and sinks are opened with the first metrics or evaluation, when it is known where the
    run goes on."""

    def __init__(
        self,
        run: RunDirectory,
        console: Progress,
        *,
        total_env_steps: int = 0,
        metrics_port: int = 0,
        sinks: Sequence[str] = ("tensorboard",),
    ) -> None:
        """total_env_steps: at which the run ends; 0: it ends by time. metrics_port: where Prometheus finds the last
        row, on loopback; 0: nowhere. sinks: names of SINKS. Raises PortTakenError."""
        self._served = PrometheusSink(metrics_port, run=run.path.name) if metrics_port else None
        self._run = run
        self._console = console
        self._kinds = {name: SINKS[name] for name in sinks}
        self._rows: BackgroundSink | None = None  # metrics.jsonl
        self._sinks: dict[str, BackgroundSink[Call]] = {}
        self._num_parts = 0  # that sinks were opened for, in this session
        self._early_events: deque[dict[str, Any]] | None = deque(maxlen=MAX_EARLY_EVENTS)  # None: it is closed
        self._lock = threading.RLock()  # of the sinks and those events, which come from any thread
        self._dropped_before = 0  # by files and sinks that are closed
        self._last_update = 0
        self._importing: threading.Thread | None = None
        self._sink_events = SinkEvents(run, self.note)
        # A file on a full disk, or a pipe without a reader.
        self._shown: BackgroundSink[Callable[[], None]] = BackgroundSink("console", _Calls, self._sink_events.put)
        self._status = RunStatus(run, total_env_steps=total_env_steps, on_event=self._sink_events.put)
        run.on_event = self._event

    @property
    def session(self) -> int:
        """1, and 1 more with every resume."""
        return self._status.session

    def phase(self, name: str) -> None:
        if self._importing is None:  # from now on this process waits for others, where there are others
            self._importing = threading.Thread(target=_prepare, args=(list(self._kinds.values()),), name="import")
            self._importing.start()
        self._status.phase(name)
        self._show(self._console.set_phase, name)

    def note(self, message: str) -> None:
        self._show(self._console.note, message)

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None:
        """Metrics of the update that led to `num_updates`; rows of later updates, of a killed session, are removed."""
        env_steps = int(metrics["progress/env_steps"])
        if self._rows is None or num_updates <= self._last_update:
            self._open(resume_at=num_updates - 1, from_env_steps=env_steps)
        assert self._rows is not None
        self._last_update = num_updates
        self._status.updated(num_updates, env_steps=env_steps, seconds_left=seconds_left)
        dropped_writes = metrics.get(DROPPED_WRITES, 0.0) + self._status.num_dropped
        row = check_metrics({**metrics, DROPPED_ROWS: self._num_dropped(), DROPPED_WRITES: dropped_writes})
        self._rows.write(num_updates, row)
        without_evaluations = {name: value for name, value in row.items() if not name.startswith("evaluation/")}
        self._deliver("metrics", num_updates, without_evaluations)
        if self._served is not None:
            self._served.write(num_updates, row)
        self._show(self._console.set_seconds_left, seconds_left)
        self._show(self._console.write, num_updates, row)
        self._sink_events.report(self._last_update)

    def evaluated(self, evaluation: Evaluation) -> None:
        """An evaluation has come; during training after the metrics of the update at which it came."""
        if self._rows is None:
            # Points of the update itself stay: an evaluation comes after them.
            from_env_steps = evaluation.env_steps + 1 if evaluation.reported_at else 0
            self._open(resume_at=evaluation.reported_at, from_env_steps=from_env_steps)
        self._deliver("evaluated", evaluation)

    def ended(self, state: str, error: str | None = None) -> None:
        """Sets the end in status.json: a state of `telemetry.status`, and the line that the command ends with."""
        self._status.ended(state, error)

    def close(self) -> None:
        self._close_sinks()
        with self._lock:
            self._early_events = None
        self._status.close()
        self._sink_events.report(self._last_update)
        if self._served is not None:
            self._served.close()
        self._show(self._console.close)
        self._shown.close()
        self._sink_events.report(self._last_update)

    def _open(self, *, resume_at: int, from_env_steps: int) -> None:
        """Another part of the run begins: rows after `resume_at` updates are removed.

        Nothing is touched before the first row, and then by the threads: whatever goes wrong there stays there."""
        path = self._run.metrics / "metrics.jsonl"

        def open_rows(is_first: bool) -> JsonlSink:
            return JsonlSink(path, resume_at=resume_at if is_first else None)

        self._close_sinks()
        rows = LineFile(self._run.path, open_rows, self._sink_events.put, path)
        run = self._part(resume_at, from_env_steps)
        with self._lock:
            self._last_update = resume_at
            self._rows = BackgroundSink(path.name, rows.open, self._sink_events.put)
            self._sinks = {
                name: BackgroundSink(
                    name, functools.partial(_Opened, kind, run), self._sink_events.put, patience_s=kind.patience_s
                )
                for name, kind in self._kinds.items()
            }
            assert self._early_events is not None, "metrics after close"
            early = list(self._early_events)
            self._early_events.clear()
        for event in early:
            self._deliver("event", event)

    def _part(self, resume_at: int, from_env_steps: int) -> SinkRun:
        self._num_parts += 1
        stored, now = self._run.config or {}, time.time()
        name = self._run.path.resolve().name
        words = (name, int(now), os.getpid(), self._num_parts)
        return SinkRun(
            name=name,
            directory=self._run.path,
            config=stored.get("config", {}),
            config_hash=stored.get("hash", ""),
            session=self.session,
            resume_at=resume_at,
            from_env_steps=from_env_steps,
            began_at=now,
            id="-".join(re.sub(r"[^A-Za-z0-9]+", "_", str(word)) for word in words),
        )

    def _deliver(self, method: str, *arguments: Any) -> None:
        """Calls a method of every sink that has it of its own, by the thread of the sink."""
        with self._lock:
            for name, sink in self._sinks.items():
                if getattr(self._kinds[name], method) is not getattr(Sink, method):
                    sink.write(self._last_update, (method, arguments))

    def _event(self, event: dict[str, Any]) -> None:
        """Hands an event on, from any thread; stores it until sinks are open."""
        with self._lock:
            if self._sinks:
                self._deliver("event", event)
            elif self._early_events is not None:
                self._early_events.append(event)

    def _num_dropped(self) -> int:
        return self._dropped_before + sum(sink.num_dropped for sink in self._opened())

    def _opened(self) -> list[BackgroundSink]:
        return [*([] if self._rows is None else [self._rows]), *self._sinks.values()]

    def _close_sinks(self) -> None:
        with self._lock:
            close_sinks(self._opened())
            self._dropped_before, self._rows, self._sinks = self._num_dropped(), None, {}

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


class _Opened:
    """A `RowSink` whose rows are calls of a sink."""

    def __init__(self, kind: type[Sink], run: SinkRun) -> None:
        self._sink = kind(run)

    def write(self, update: int, call: Call, /) -> None:
        del update
        method, arguments = call
        getattr(self._sink, method)(*arguments)

    def close(self) -> None:
        self._sink.close()


def _prepare(kinds: Sequence[type[Sink]]) -> None:
    """Imports what sinks need; an error is raised again, and reported, where a sink is opened."""
    for kind in kinds:
        with contextlib.suppress(Exception):
            kind.prepare()


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
