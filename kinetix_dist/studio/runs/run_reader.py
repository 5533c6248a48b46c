"""Reader of a run directory that follows it while it is written: metrics as columns, events, problems.

    metrics.jsonl, events.jsonl --Tail--> RunReader.poll() --> Changes, for the pages that watch the run

`poll` reads new lines and never waits for a writer. It is called from one thread at a time.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.long_metrics import LONG_BYTES, read_long
from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.telemetry.json_lines import utc_seconds
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row
from kinetix_dist.telemetry.tail import Tail


@dataclasses.dataclass(frozen=True)
class Changes:
    """Changes of a run that a poll found."""

    first_row: int | None = None  # rows of the table from here on are new; None: no row is
    rewound_to: float | None = None  # rows of updates after this one are void (a run that went back); None: none are
    events: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    events_restarted: bool = False  # events of earlier polls are void
    bytes_left: int = 0  # that wait to be read: more than one poll takes

    def __bool__(self) -> bool:
        return self.first_row is not None or self.rewound_to is not None or bool(self.events) or self.events_restarted


class RunReader:
    """Reads a run directory. `problems` has one line for each file that cannot be read as it is."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = SeriesTable()
        self.revision = 0  # of the table: counts how often rows became void
        self.events: list[dict[str, Any]] = []
        self.problems: dict[str, str] = {}  # by file
        self.lock = threading.Lock()  # held while polling and while reading what a poll changes
        self._metrics = Tail(path / run_files.METRICS, is_row=is_metrics_row)
        self._events = Tail(path / run_files.EVENTS, is_row=run_files.is_event)

    def read_first(self, report: Callable[[int], None]) -> None:
        """Read all existing files; report(bytes) receives how many are left. Nothing else may use the reader meanwhile.

        A long file is read by a process of its own; where that fails, in this one, which takes three times as long.
        """
        file = self.path / run_files.METRICS
        if (run_files.size_of(file) or 0) >= LONG_BYTES:
            found = read_long(file, report)
            if found is not None:
                found.hand_over(self._metrics)
                self.table = found.table
        while left := self.poll().bytes_left:
            report(left)

    def poll(self) -> Changes:
        """Reads new lines, a few MB of each file at most."""
        first_row, rewound_to, left = self._poll_metrics()
        new_events, restarted, events_left = self._poll_events()
        return Changes(first_row, rewound_to, new_events, restarted, left + events_left)

    def anchors(self) -> list[tuple[int, float]]:
        """(update, unix time) of the events that have both."""
        return [
            (event["update"], time)
            for event in self.events
            if isinstance(event.get("update"), int) and (time := _time_of(event)) is not None
        ]

    def _poll_metrics(self) -> tuple[int | None, float | None, int]:
        try:
            found = self._metrics.poll()
        except OSError as error:
            self.problems[run_files.METRICS] = f"{run_files.METRICS} cannot be read ({error.strerror})"
            return None, None, 0
        self._note_damage(run_files.METRICS, self._metrics)
        before = self.table
        if found.is_restarted:
            self.table = SeriesTable()
        num_before = before.num_rows
        first_row = self.table.append(found.rows)
        if found.is_restarted:
            first_row = _num_equal(before, self.table) if not found.bytes_left else 0
        rewound_to = None
        if first_row < num_before:
            self.revision += 1
            rewound_to = float(before.column("update")[first_row - 1]) if first_row else 0.0
        return (first_row if first_row < self.table.num_rows else None), rewound_to, found.bytes_left

    def _poll_events(self) -> tuple[list[dict[str, Any]], bool, int]:
        try:
            found = self._events.poll()
        except OSError as error:
            self.problems[run_files.EVENTS] = f"{run_files.EVENTS} cannot be read ({error.strerror})"
            return [], False, 0
        self._note_damage(run_files.EVENTS, self._events)
        if found.is_restarted:
            self.events = []
        self.events += found.rows
        return found.rows, found.is_restarted, found.bytes_left

    def _note_damage(self, name: str, tail: Tail) -> None:
        self.problems.pop(name, None)
        if tail.num_damaged:
            self.problems[name] = run_files.damaged_lines(tail.num_damaged, name)


def _time_of(event: dict[str, Any]) -> float | None:
    """Unix time s; None for an event without one, or of another writer."""
    try:
        return utc_seconds(event["time"])
    except (KeyError, TypeError, ValueError):
        return None


def _num_equal(before: SeriesTable, after: SeriesTable) -> int:
    """Number of rows from the start on that are the same in both."""
    count = min(before.num_rows, after.num_rows)
    is_same = np.ones(count, bool)
    for name in ("update", *{*before.names, *after.names}):
        a, b = before.column(name)[:count], after.column(name)[:count]
        is_same &= (a == b) | (np.isnan(a) & np.isnan(b))
    return count if is_same.all() else int(np.argmin(is_same))
