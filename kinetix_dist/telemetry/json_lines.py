"""Files of JSON objects, one a line, that survive a kill at any byte; times as files of a run have them.

A line is whole when it parses (`text_files.loads_json`), since an object ends with its last character. A line that
does not parse is damaged: it is set aside into another file, never lost and never joined with what is written next.
Rewriting goes through a draft that is flushed to the disk and then renamed, so that at every moment the old or the new
file is there.

Our own writers write null for a value that is not finite. Times are UTC: 2026-01-31T12:00:00Z.
"""

from __future__ import annotations

import calendar
import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import AtomicAppender, flush_to_disk, replace_file
from kinetix_dist.json_text import json_text
from kinetix_dist.text_files import loads_json

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Lines:
    """Content of a file."""

    rows: list[Row]
    damaged: list[bytes]  # without line ends
    is_ended: bool  # the last line has its line end, or there is none


def read_lines(path: Path, is_row: Callable[[Row], bool] = lambda row: True) -> Lines:
    """All rows in order; lines that are no JSON object, or not `is_row`, are damaged. An absent file has no lines."""
    content = path.read_bytes() if path.exists() else b""
    rows, damaged = [], []
    for line in filter(None, content.split(b"\n")):
        row = parse_line(line)
        if row is not None and is_row(row):
            rows.append(row)
        else:
            damaged.append(line)
    return Lines(rows=rows, damaged=damaged, is_ended=not content or content.endswith(b"\n"))


def append_line(path: Path, row: Mapping[str, Any]) -> None:
    """Adds a row on a line of its own, also after an unfinished one: whole, or not at all where OSError is raised."""
    file = AtomicAppender(path)
    try:
        file.append_line(_encode(row))
    finally:
        file.close()


def mend_lines(path: Path, *, is_row: Callable[[Row], bool], keep: Callable[[Row], bool]) -> int:
    """Leaves the rows to `keep`, each on a whole line; returns how many damaged lines were set aside.

    These go to `damaged_path(path)`, whose own lines are raw bytes. Nothing is written where nothing changes.
    """
    lines = read_lines(path, is_row)
    rows = [row for row in lines.rows if keep(row)]
    if len(rows) == len(lines.rows) and not lines.damaged and lines.is_ended:
        return 0
    if lines.damaged:
        with damaged_path(path).open("ab") as file:  # first: a kill in between sets a line aside twice, and loses none
            file.write(b"".join(line + b"\n" for line in lines.damaged))
            flush_to_disk(file)
    replace_file(path, b"".join(map(_encode, rows)))
    return len(lines.damaged)


def damaged_path(path: Path) -> Path:
    """metrics.jsonl -> metrics.damaged"""
    return path.with_suffix(".damaged")


def set_aside_unless_readable(path: Path) -> Path | None:
    """Renames what cannot be read as a file (a directory, say): metrics.jsonl -> metrics.jsonl.damaged, or
    .damaged-2, ... where there is one; returns the new name. None: it can be read, or is not there."""
    if not path.exists() and not path.is_symlink():
        return None
    try:
        if path.is_file():
            path.read_bytes()
            return None
    except OSError:
        pass  # a disk that cannot read it any more, or a file of somebody else
    return set_aside_file(path)


def set_aside_file(path: Path, word: str = "damaged") -> Path:
    """The same in any case, for a directory too; word: that is added to the name."""
    aside = path.with_name(f"{path.name}.{word}")
    number = 1
    while aside.exists():
        number += 1
        aside = path.with_name(f"{path.name}.{word}-{number}")
    return path.rename(aside)


def parse_line(line: bytes) -> Row | None:
    """The JSON object of a line; None: it is damaged."""
    try:
        return parse_row(line)
    except ValueError:
        return None


def parse_row(line: bytes) -> Row:
    """The JSON object of a line. Raises ValueError: why it is damaged, in one line."""
    row = loads_json(line)
    if not isinstance(row, dict):
        raise ValueError(f"it holds a {type(row).__name__}, not an object")
    return row


def _encode(row: Mapping[str, Any]) -> bytes:
    return json_text(row).encode() + b"\n"


_TIME_FORMAT = "%Y-%m-%dT%H:%M:%SZ"


def utc_text(seconds: float | None = None) -> str:
    """Text of s since the epoch; None: now."""
    return time.strftime(_TIME_FORMAT, time.gmtime(seconds))


def utc_seconds(text: str) -> float:
    """The inverse, s since the epoch. Raises ValueError."""
    return float(calendar.timegm(time.strptime(text, _TIME_FORMAT)))
