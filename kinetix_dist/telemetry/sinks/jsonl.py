"""Metrics as JSON lines: one object an update, readable while the run goes on and after it was killed."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import AtomicAppender
from kinetix_dist.telemetry.json_lines import Row, damaged_path, mend_lines, read_lines, set_aside_unless_readable
from kinetix_dist.telemetry.names import check_metrics


class LinesSink:
    """Appends rows to `path`, one a line; those not to `keep`, of a killed session, are removed first.

    num_damaged: lines that were no rows, and stand in `damaged_path` now.
    set_aside: what `path` was renamed to where it could not be read at all; else None.
    """

    def __init__(self, path: Path, *, is_row: Callable[[Row], bool], keep: Callable[[Row], bool] | None) -> None:
        """is_row: whether an object of the file is a row; keep None: this session has written to it already, and goes
        on."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self.num_damaged = 0
        self.damaged_path = damaged_path(path)
        self.set_aside: Path | None = None
        if keep is not None:
            self.set_aside = set_aside_unless_readable(path)
            self.num_damaged = mend_lines(path, is_row=is_row, keep=keep)
        self._file = AtomicAppender(path)

    def write(self, update: int, row: Mapping[str, Any], /) -> None:
        """One line, whole or not at all."""
        del update
        self._file.append_line(json.dumps(row, allow_nan=False).encode() + b"\n")

    def close(self) -> None:
        self._file.close()


class JsonlSink(LinesSink):
    """Rows of metrics; those of updates after `resume_at` are removed first."""

    def __init__(self, path: Path, *, resume_at: int | None = 0) -> None:
        """resume_at None: this session has written to it already, and goes on."""
        keep = None if resume_at is None else lambda row: row["update"] <= resume_at
        super().__init__(path, is_row=is_metrics_row, keep=keep)

    def write(self, update: int, row: Mapping[str, float], /) -> None:
        """One line, whole or not at all. A value that is not finite is written as null: JSON has no nan."""
        values = check_metrics(row)
        super().write(update, {"update": update} | {k: v if math.isfinite(v) else None for k, v in values.items()})


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics file; damaged lines and an unfinished last one are left out."""
    return read_lines(path, is_metrics_row).rows


def is_metrics_row(row: dict[str, Any]) -> bool:
    """True for a row of metrics; other objects count as damaged."""
    return isinstance(row.get("update"), int)
