"""Files of a run directory that dashboards read. All are opened for reading only; `lock` is never touched.

A shared lock, even for a moment, would refuse a driver that starts.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry import curriculum_log, status
from kinetix_dist.telemetry.json_lines import parse_line

CONFIG = "config.json"
METRICS = "metrics/metrics.jsonl"
EVENTS = "events.jsonl"
EVALUATIONS = "evaluations.json"
EVALUATION_LINES = "evaluations.jsonl"
REPORT = "report.json"
RECORDINGS = "recordings"
STATUS = status.STATUS
CURRICULUM = curriculum_log.DIRECTORY
OUTCOMES = f"{CURRICULUM}/{curriculum_log.OUTCOMES}"
PROCESSES = "processes.jsonl"

MAX_JSON_BYTES = 64 << 20
LAST_BYTES = 64 << 10  # in which the last row of a file is looked for; one of metrics.jsonl has 1 to 4 kB


class RunFileError(ValueError):
    """A file of a run that is there and cannot be read: which, and why, in one line."""


def read_object(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None where there is no such file. Raises RunFileError."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_JSON_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise RunFileError(f"{path.name} cannot be read ({error.strerror})") from error
    if len(content) > MAX_JSON_BYTES:
        raise RunFileError(f"{path.name} is larger than {MAX_JSON_BYTES >> 20} MiB; it is none of ours")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise RunFileError(f"{path.name} is damaged ({' '.join(str(error).split())})") from error
    if not isinstance(found, dict):
        raise RunFileError(f"{path.name} holds a {type(found).__name__}, not an object")
    return found


def is_run(path: Path) -> bool:
    """Whether a directory is a run: it has a config.json."""
    return (path / CONFIG).is_file()


def modified_at(path: Path) -> float | None:
    """Unix time s of the last change of a file; None where there is none."""
    try:
        return os.stat(path).st_mtime
    except OSError:
        return None


def size_of(path: Path) -> int | None:
    """Bytes of a file; None where there is none."""
    try:
        return os.stat(path).st_size
    except OSError:
        return None


def last_row(path: Path, *, max_bytes: int = LAST_BYTES) -> dict[str, Any] | None:
    """The last whole row of a file of JSON lines, read from its end; None where there is none, or it cannot be read."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - max_bytes, 0))
            content = file.read(max_bytes)
    except OSError:
        return None
    for line in reversed(content.split(b"\n")):
        row = parse_line(line) if line else None
        if row is not None:
            return row
    return None
