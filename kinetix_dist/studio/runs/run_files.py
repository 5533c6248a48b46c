"""Files of a run directory, opened for reading only. `lock` is never touched.

A shared lock, even for a moment, would refuse a driver that starts.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from kinetix_dist.telemetry import curriculum_log, status
from kinetix_dist.telemetry.json_lines import Row, parse_row
from kinetix_dist.text_files import loads_json

T = TypeVar("T")

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
LAST_BYTES = 64 << 10  # searched for the last row of a file; one of metrics.jsonl has 1 to 4 kB


class RunFileError(ValueError):
    """An existing file of a run that cannot be read: which, and why, in one line."""


def read_object(path: Path) -> dict[str, Any] | None:
    """JSON object in a file; None where there is no such file. Raises RunFileError."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_JSON_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise RunFileError(f"{path.name} cannot be read ({error.strerror})") from error
    if len(content) > MAX_JSON_BYTES:
        raise RunFileError(f"{path.name} is larger than {MAX_JSON_BYTES >> 20} MiB; no run writes such a file")
    try:
        found = loads_json(content)
    except ValueError as error:
        raise RunFileError(f"{path.name} is damaged ({error})") from error
    if not isinstance(found, dict):
        raise RunFileError(f"{path.name} holds a {type(found).__name__}, not an object")
    return found


def member(content: Mapping[str, Any], name: str, kind: type[T] | tuple[type[T], ...], *, file: str) -> T | None:
    """The value of a field; None where it is missing, or null. Raises RunFileError for one of another type."""
    value = content.get(name)
    if value is None or isinstance(value, kind):
        return value
    kinds = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
    raise RunFileError(f"{file} is damaged ({name} is a {type(value).__name__}, not {kinds})")


def read_config(path: Path) -> dict[str, Any]:
    """The configuration in the config.json of a run directory; empty where there is none. Raises RunFileError."""
    return member(read_object(path / CONFIG) or {}, "config", dict, file=CONFIG) or {}


def damaged_lines(count: int, file: str) -> str:
    """Problem of a file of JSON lines, in one line: "1 line is damaged in events.jsonl and left out"."""
    return f"{count} {'line is' if count == 1 else 'lines are'} damaged in {file} and left out"


def is_event(row: Row) -> bool:
    """True for a JSON object that is a row of events.jsonl."""
    return isinstance(row.get("event"), str)


def is_run(path: Path) -> bool:
    """True for a run directory: it has a config.json."""
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


@dataclasses.dataclass(frozen=True)
class LastRow:
    """Last whole row of a file; `problem`: why there is none, or why lines behind it were skipped."""

    row: dict[str, Any] | None
    problem: str | None = None


def last_row(path: Path, *, is_row: Callable[[Row], bool], max_bytes: int = LAST_BYTES) -> LastRow:
    """Reads a file of JSON lines from its end. An absent file has no row, and an unfinished last line is no damage."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - max_bytes, 0))
            content = file.read(max_bytes)
    except (FileNotFoundError, NotADirectoryError):
        return LastRow(None)
    except OSError as error:
        return LastRow(None, f"{path.name} cannot be read ({error.strerror})")
    lines, problem = content.split(b"\n"), None
    for number, line in reversed([*enumerate(lines)]):
        if not line:
            continue
        is_unfinished = number == len(lines) - 1
        is_cut = number == 0 and size > max_bytes
        try:
            row = parse_row(line)
            if is_row(row):
                return LastRow(row, problem)
            found = "it is no row of this file"
        except ValueError as error:
            found = str(error)
        if problem is None and not is_unfinished and not is_cut:
            problem = f"the last line of {path.name} is damaged ({found})"
    return LastRow(None, problem)
