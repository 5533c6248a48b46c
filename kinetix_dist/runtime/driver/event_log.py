"""events.jsonl: what happened in a run. A disk that is full delays events and ends nothing."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.event_names import check_event
from kinetix_dist.telemetry.json_lines import append_line
from kinetix_dist.telemetry.utc import utc_text

MAX_PENDING = 1000  # events kept in memory until they can be written; about 200 kB


class EventLog:
    """Appends events in order, each with the time at which it happened. May be called from any thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._pending: list[dict[str, Any]] = []  # could not be written so far
        self._num_dropped = 0

    def add(self, kind: str, **details: Any) -> None:
        """Writes an event now, or as soon as the disk takes it. Raises UnknownEventError for a kind without a name."""
        row = {"time": utc_text(), "event": check_event(kind), **details}
        with self._lock:
            if len(self._pending) < MAX_PENDING:
                self._pending.append(row)
            else:
                self._num_dropped += 1
            self._write()

    def write_pending(self) -> None:
        """Tries again to write what could not be written."""
        with self._lock:
            self._write()

    def _write(self) -> None:
        try:
            while self._pending:
                append_line(self._path, self._pending[0])
                del self._pending[0]
            if self._num_dropped:
                append_line(self._path, {"time": utc_text(), "event": "events_dropped", "events": self._num_dropped})
                self._num_dropped = 0
        except OSError:
            return  # kept: nothing is lost while there is memory, and `sink_failing` says what the disk does
