"""Metrics as JSON lines: one object an update, readable while the run goes on and after it was killed."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.names import check_metrics


class JsonlSink:
    """Appends to `path`; lines of updates after `resume_at` (of a killed session) are cut off first."""

    def __init__(self, path: Path, *, resume_at: int = 0) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            _keep_until(path, resume_at)
        self._file = path.open("a", buffering=1)  # line buffered: a reader sees whole lines

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """One line. A value that is not finite is written as null: JSON has no nan."""
        values = check_metrics(metrics)
        row = {"update": update} | {k: v if math.isfinite(v) else None for k, v in values.items()}
        self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        self._file.close()


def read_jsonl(path: Path) -> Iterator[dict[str, Any]]:
    """Rows of a metrics file; an incomplete last line is left out."""
    with path.open() as file:
        for line in file:
            if line.endswith("\n"):
                yield json.loads(line)


def _keep_until(path: Path, last_update: int) -> None:
    rows = [row for row in read_jsonl(path) if row["update"] <= last_update]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
