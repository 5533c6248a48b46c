"""Sinks of the files of a run: JSON lines, snapshots of the curriculum, and the events that their threads report.

A file of JSON lines is opened for a session, where later lines of a killed one are removed, and again after failures,
where all lines stay. Snapshots are `curriculum/*.npz`, see docs/run_data.md.
"""

from __future__ import annotations

import dataclasses
import queue
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.curriculum_log import (
    LEVELS,
    level_ids,
    remove_later_snapshots,
    thin_snapshots,
    write_snapshot,
)
from kinetix_dist.telemetry.json_lines import set_aside_file
from kinetix_dist.telemetry.sinks.jsonl import LinesSink

Sink = TypeVar("Sink", bound=LinesSink)


class LineFile(Generic[Sink]):
    """`open` is for a `BackgroundSink`, and called in its thread."""

    def __init__(
        self, run: Path, open_sink: Callable[[bool], Sink], on_event: Callable[[str, dict[str, Any]], None], path: Path
    ) -> None:
        """run: directory of the run; open_sink(is_first): of `path`, for the first time in the session or again."""
        self._name = str(path.relative_to(run))
        self._open_sink = open_sink
        self._on_event = on_event
        self._is_first = True

    def open(self) -> Sink:
        sink = self._open_sink(self._is_first)
        self._is_first = False  # rows of this session stay from now on
        if sink.set_aside is not None:
            self._on_event(
                "file_set_aside", {"file": self._name, "to": sink.set_aside.name, "reason": "it cannot be read"}
            )
        if sink.num_damaged:
            aside = str(Path(self._name).with_name(sink.damaged_path.name))
            self._on_event("lines_set_aside", {"file": self._name, "lines": sink.num_damaged, "to": aside})
        return sink


class SinkEvents:
    """`put` is for any thread, `report` for that of the run."""

    def __init__(self, run: RunDirectory, note: Callable[[str], None]) -> None:
        self._run = run
        self._note = note
        self._queue: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()

    def put(self, kind: str, details: dict[str, Any]) -> None:
        """An event, and what it says."""
        self._queue.put((kind, details))

    def report(self, num_updates: int) -> None:
        """All that came since."""
        self._run.write_pending_events()
        while not self._queue.empty():
            kind, details = self._queue.get()
            self._run.event(kind, update=num_updates, **details)
            if kind == "sink_failing":
                self._note(f"{details['sink']}: {details['error']}; rows are dropped and counted, training goes on")
            elif kind == "sink_recovered":
                self._note(f"{details['sink']} takes rows again; {details['dropped']} were dropped")


@dataclasses.dataclass(frozen=True)
class UnfinishedSnapshot:
    """Snapshot that is to be written."""

    kind: str  # of curriculum_log.KINDS
    written_after: int  # updates
    known: Mapping[str, Any]  # name of the "curriculum" and "size" of its levels
    arrays: Callable[[], dict[str, np.ndarray] | None]  # what the curriculum logs; None: nothing


class SnapshotSink:
    """A sink of `UnfinishedSnapshot`s. At the first `open` it removes what a session that goes on from `resume_at`
    updates will write again. is_curated: see `remove_later_snapshots`."""

    def __init__(
        self,
        directory: Path,
        *,
        max_snapshots: int,
        resume_at: int,
        is_curated: bool,
        on_event: Callable[[str, dict[str, Any]], None],
    ) -> None:
        self._directory = directory
        self._max_snapshots = max_snapshots
        self._resume_at: int | None = resume_at
        self._is_curated = is_curated
        self._on_event = on_event

    def write(self, update: int, snapshot: UnfinishedSnapshot, /) -> None:
        del update
        arrays = snapshot.arrays()
        if arrays is None:
            return
        levels = {name: array for name, array in arrays.items() if name.startswith(LEVELS)}
        about = {**snapshot.known, "written_after": np.int32(snapshot.written_after), "level_id": level_ids(levels)}
        write_snapshot(self._directory, snapshot.kind, int(arrays["policy_version"]), about | arrays)
        thin_snapshots(self._directory, snapshot.kind, self._max_snapshots)

    def open(self) -> SnapshotSink:
        """Itself, once what is later is removed."""
        if self._resume_at is not None:
            self._remove_later(self._resume_at)
            self._resume_at = None
        return self

    def close(self) -> None:
        """Nothing is open between two snapshots."""

    def _remove_later(self, num_updates: int) -> None:
        for path in remove_later_snapshots(self._directory, num_updates, is_curated=self._is_curated):
            file = f"{self._directory.name}/{path.name}"
            self._on_event(
                "file_set_aside", {"file": file, "to": set_aside_file(path).name, "reason": "it cannot be read"}
            )
