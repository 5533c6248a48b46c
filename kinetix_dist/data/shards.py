"""Shards of a data set and their index, `shards.jsonl`: which there are, and that each is whole.

    shard-000007.parquet   written under another name, flushed to the disk, renamed
    shards.jsonl           then a line: number, file, rows, bytes, SHA-256

A kill leaves a shard without its line or a torn last line. Neither counts, and `collect` makes the shard again. Any
other line that cannot be used is a fault, as is a gap in the numbers: both would lose rows.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import itertools
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.data.manifest import DatasetError, quoted
from kinetix_dist.telemetry.json_lines import append_line, mend_lines, parse_row
from kinetix_dist.text_files import MAX_INTEGER

INDEX = "shards.jsonl"
REMEDY = "; collect it again (delete its line of shards.jsonl), or leave it out with skip_damaged"
SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shard:
    """Line of the index."""

    shard: int  # number, from 0 on
    file: str
    rows: int
    bytes: int
    sha256: str
    episodes: int  # that ended
    solved: int  # of these


class Index(NamedTuple):
    """Content of the index."""

    shards: list[Shard]  # by number
    faults: list[str]  # one line each: a line that cannot be used, numbers that have no line


def file_of(number: int) -> str:
    """Return the file name of a shard."""
    return f"shard-{number:06d}.parquet"


def write_shard(folder: Path, number: int, content: bytes, counts: dict[str, int]) -> Shard:
    """Writes a shard and its line. Raises OSError, and leaves the data set as it was."""
    name = file_of(number)
    replace_file(folder / name, content)
    shard = Shard(shard=number, file=name, bytes=len(content), sha256=hashlib.sha256(content).hexdigest(), **counts)
    append_line(folder / INDEX, dataclasses.asdict(shard))
    return shard


def read_index(folder: Path, max_rows: int) -> Index:
    """Return the shards and the faults of the index.

    Of several lines of one shard the last one counts.

    Args:
        folder: the data set.
        max_rows: of a shard, from the manifest.

    Raises:
        DatasetError: the file cannot be read.
    """
    path = folder / INDEX
    shards, faults = {}, []
    *lines, torn = _read(path).split(b"\n")
    for number, line in enumerate(lines, 1):
        if line:
            try:
                shard = parse_shard(parse_row(line), max_rows)
            except ValueError as error:
                faults.append(f"{path}: line {number} cannot be used: {error}")
            else:
                shards[shard.shard] = shard
    if (shard := _parsed(torn, max_rows)) is not None:  # whole but for its line end
        shards[shard.shard] = shard
    gaps = list(_gaps(sorted(shards)))
    if sum(len(gap) for gap in gaps) > len(faults):  # else the faulty lines belong to the missing shards
        faults += [f"{path}: there is no line of {_in_words(gap)}" for gap in gaps]
    return Index([shards[number] for number in sorted(shards)], faults)


def parse_shard(row: dict[str, Any], max_rows: int) -> Shard:
    """Return a line of the index. Raises ValueError, which names the first field that is wrong."""
    names = [field.name for field in dataclasses.fields(Shard)]
    for name in names:
        if name not in row:
            raise ValueError(f"{name} is missing")
    if unknown := sorted(set(row) - set(names)):
        raise ValueError(f"{unknown[0][:40]!r} is unknown")
    for name in ("shard", "rows", "bytes", "episodes", "solved"):
        if type(row[name]) is not int or row[name] < 0:
            raise ValueError(f"{name} is {quoted(row[name])}, not a count")
    if row["file"] != (expected := file_of(row["shard"])):
        raise ValueError(f"file is {quoted(row['file'])}; shard {row['shard']} is {expected}")
    if not isinstance(row["sha256"], str) or not SHA256.fullmatch(row["sha256"]):
        raise ValueError(f"sha256 is {quoted(row['sha256'])}, not 64 hexadecimal digits")
    if (row["shard"] + 1) * max_rows > MAX_INTEGER:
        raise ValueError(f"shard is {row['shard']}: the numbers of its rows have more than 64 bits")
    if not 1 <= row["rows"] <= max_rows:
        raise ValueError(f"rows is {row['rows']:,}; a shard of this data set has 1 to {max_rows:,}")
    if not row["solved"] <= row["episodes"] <= row["rows"]:
        raise ValueError(f"{row['solved']:,} of {row['episodes']:,} episodes in {row['rows']:,} rows are solved")
    return Shard(**row)


@contextmanager
def locked_index(folder: Path, max_rows: int) -> Iterator[None]:
    """Hold the lock of the writer of a data set, whose index has only whole lines then.

    A torn last line is cut off. Other lines that cannot be used are moved to `shards.damaged`.

    Raises:
        DatasetError: another process writes to the folder.
        OSError: the index cannot be written.
    """
    path = folder / INDEX
    while True:
        with path.open("ab") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise DatasetError(
                    f"{folder} is being written by another process; wait for it, or name another"
                ) from None
            content = _read(path)
            torn = content.rpartition(b"\n")[2]
            if torn and _parsed(torn, max_rows) is None:
                lock.truncate(len(content) - len(torn))
            mend_lines(path, is_row=lambda row: _is_shard(row, max_rows), keep=lambda row: True)
            if os.path.samestat(os.fstat(lock.fileno()), path.stat()):  # else it was replaced, and the lock is void
                yield
                return


def read_content(folder: Path, shard: Shard) -> bytes:
    """Bytes of a shard. Raises DatasetError, which names it, if it is missing or damaged."""
    path = folder / shard.file
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"shard {path} is missing{REMEDY}") from None
    except OSError as error:
        raise DatasetError(f"shard {path} cannot be read: {error.strerror}{REMEDY}") from None
    if len(content) != shard.bytes or hashlib.sha256(content).hexdigest() != shard.sha256:
        raise DatasetError(
            f"shard {path} is damaged: {len(content):,} bytes whose SHA-256 is not that of the index, of "
            f"{shard.bytes:,}{REMEDY}"
        )
    return content


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}; copy the data set again") from None


def _parsed(line: bytes, max_rows: int) -> Shard | None:
    try:
        return parse_shard(parse_row(line), max_rows)
    except ValueError:
        return None


def _is_shard(row: dict[str, Any], max_rows: int) -> bool:
    try:
        parse_shard(row, max_rows)
    except ValueError:
        return False
    return True


def _gaps(numbers: Iterable[int]) -> Iterator[range]:
    """Yield the ranges of numbers from 0 on that are missing."""
    for before, after in itertools.pairwise([-1, *numbers]):
        if after > before + 1:
            yield range(before + 1, after)


def _in_words(gap: range) -> str:
    return f"shard {gap[0]}" if len(gap) == 1 else f"shards {gap[0]} to {gap[-1]}"
