"""Writes snapshots of a curriculum, `curriculum/*.npz` of a run, in the thread of a sink."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.telemetry.curriculum_log import (
    LEVELS,
    level_ids,
    remove_later_snapshots,
    thin_snapshots,
    write_snapshot,
)
from kinetix_dist.telemetry.json_lines import set_aside_file


@dataclasses.dataclass(frozen=True)
class UnfinishedSnapshot:
    """What is to be written."""

    kind: str  # of curriculum_log.KINDS
    written_after: int  # updates
    arrays: Callable[[], dict[str, np.ndarray] | None]  # what the curriculum logs; None: nothing


class SnapshotSink:
    """A sink of `UnfinishedSnapshot`s. At the first `open` it removes what a session that goes on from `resume_at`
    updates will write again. is_curated: see `remove_later_snapshots`."""

    def __init__(
        self,
        directory: Path,
        *,
        curriculum: str,
        size: str,
        max_snapshots: int,
        resume_at: int,
        is_curated: bool,
        tell: Callable[[str, dict[str, Any]], None],
    ) -> None:
        self._directory = directory
        self._known = {"curriculum": np.str_(curriculum), "size": np.str_(size)}
        self._max_snapshots = max_snapshots
        self._resume_at: int | None = resume_at
        self._is_curated = is_curated
        self._tell = tell

    def write(self, update: int, snapshot: UnfinishedSnapshot, /) -> None:
        del update
        arrays = snapshot.arrays()
        if arrays is None:
            return
        levels = {name: array for name, array in arrays.items() if name.startswith(LEVELS)}
        arrays = (
            self._known | {"written_after": np.int32(snapshot.written_after), "level_id": level_ids(levels)} | arrays
        )
        write_snapshot(self._directory, snapshot.kind, int(arrays["policy_version"]), arrays)
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
            self._tell("file_set_aside", {"file": file, "to": set_aside_file(path).name, "reason": "it cannot be read"})
