"""Processes of a run over time: where each ran, how busy it was, which were lost.

    processes.jsonl                 --Tail--> newest reading of each process, idle shares over time
    events.jsonl, `process_lost`    --------> how often each was replaced, and why last

A process is identified by its name (`rollout 3`), which its replacement takes over.
"""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.studio.runs import run_files
from kinetix_dist.telemetry.tail import Tail

MAX_COLUMNS = 48  # of idle shares over time; neighbouring lines are merged
LOST = "process_lost"  # event


@dataclasses.dataclass(frozen=True)
class _Line:
    update: int
    idle: dict[str, float]  # share of time in no call, of processes that report it


class Processes:
    """Follows the file of one run. `describe` may be called from any thread."""

    def __init__(self, path: Path) -> None:
        """path: the run directory."""
        self._tail = Tail(path / run_files.PROCESSES, is_row=_is_line)
        self._lock = threading.Lock()
        self._start_again()

    def _start_again(self) -> None:
        self._lines: list[_Line] = []
        self._newest: dict[str, Any] = {}
        self._known: dict[str, dict[str, Any]] = {}  # last reading of every process that ever ran

    def describe(self, events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Description {time, update, processes, updates, idle, problems}; events: all of the run.

        processes: all that ever ran, as docs/run_data.md has it, with `seen_at` (update of its last reading),
        `is_there` (in the newest line), `idle` (mean over its readings, or null), `lost` (how often) and `error`
        (why last, or null).
        updates: [C] last update of each column; idle: {name: [C] shares 0 to 1, null where it is unknown}.
        Raises RunFileError where the file cannot be read.
        """
        losses = [event for event in events if event.get("event") == LOST]
        errors = {event.get("process"): event.get("error") for event in losses}
        lost = Counter(event.get("process") for event in losses)
        with self._lock:
            self._read()
            columns = np.array_split(np.arange(len(self._lines)), min(MAX_COLUMNS, max(len(self._lines), 1)))
            names = dict.fromkeys(name for line in self._lines for name in line.idle)
            there = {process["name"] for process in self._newest.get("processes", ())}
            damaged = self._tail.num_damaged
            return {
                "time": self._newest.get("time"),
                "update": self._newest.get("update"),
                "processes": [
                    {
                        **process,
                        "is_there": name in there,
                        "idle": _mean([line.idle.get(name) for line in self._lines]),
                        "lost": lost[name],
                        "error": errors.get(name),
                    }
                    for name, process in self._known.items()
                ],
                "updates": [self._lines[column[-1]].update for column in columns if len(column)],
                "idle": {
                    name: [_mean([self._lines[k].idle.get(name) for k in column]) for column in columns]
                    for name in names
                },
                "problems": [run_files.damaged_lines(damaged, run_files.PROCESSES)] if damaged else [],
            }

    def _read(self) -> None:
        while True:
            try:
                found = self._tail.poll()
            except OSError as error:
                raise run_files.RunFileError(f"{run_files.PROCESSES} cannot be read ({error.strerror})") from error
            if found.is_restarted:
                self._start_again()
            for row in found.rows:
                self._take(row)
            if not found.bytes_left:
                return

    def _take(self, row: dict[str, Any]) -> None:
        self._newest = row
        idle = {}
        for process in row["processes"]:
            self._known[process["name"]] = process | {"seen_at": row["update"]}
            if isinstance(process.get("busy"), int | float):
                idle[process["name"]] = 1.0 - process["busy"]
        self._lines.append(_Line(update=row["update"], idle=idle))


def _is_line(row: dict[str, Any]) -> bool:
    processes = row.get("processes")
    return (
        isinstance(row.get("update"), int)
        and isinstance(processes, list)
        and all(
            isinstance(one, dict) and isinstance(one.get("name"), str) and isinstance(one.get("pid"), int)
            for one in processes
        )
    )


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
