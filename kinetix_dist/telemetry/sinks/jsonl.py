"""Metrics as JSON lines: one object an update, readable while the run goes on and after it was killed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.json_lines import mend_lines, read_lines
from kinetix_dist.telemetry.names import check_metrics


class JsonlSink:
    """Appends to `path`; lines of updates after `resume_at` (of a killed session) are removed first.

    num_damaged: lines that were no metrics, and stand in `metrics.damaged` beside it now.
    """

    def __init__(self, path: Path, *, resume_at: int = 0) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.num_damaged = mend_lines(path, is_row=_is_metrics, keep=lambda row: row["update"] <= resume_at)
        self._file = path.open("a", buffering=1)  # line buffered: a reader sees whole lines

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """One line. A value that is not finite is written as null: JSON has no nan."""
        values = check_metrics(metrics)
        row = {"update": update} | {k: v if math.isfinite(v) else None for k, v in values.items()}
        self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        self._file.close()


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """Rows of a metrics file; damaged lines and an unfinished last one are left out."""
    return read_lines(path, _is_metrics).rows


def _is_metrics(row: dict[str, Any]) -> bool:
    return isinstance(row.get("update"), int)
