"""Shards of a data set and their index, `shards.jsonl`: which there are, and that each is whole.

    shard-000007.parquet   written under another name, flushed to the disk, renamed
    shards.jsonl           then a line: number, file, rows, bytes, SHA-256

A kill at any byte leaves a shard without its line, or half a line: neither is counted, and the shard is made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.data.manifest import DatasetError
from kinetix_dist.telemetry.json_lines import append_line, read_lines

INDEX = "shards.jsonl"


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


def write_shard(folder: Path, number: int, content: bytes, counts: dict[str, int]) -> Shard:
    """Writes a shard and its line. Raises OSError, and leaves the data set as it was."""
    name = f"shard-{number:06d}.parquet"
    replace_file(folder / name, content)
    shard = Shard(shard=number, file=name, bytes=len(content), sha256=hashlib.sha256(content).hexdigest(), **counts)
    append_line(folder / INDEX, dataclasses.asdict(shard))
    return shard


def read_index(folder: Path) -> list[Shard]:
    """Shards in order of their numbers. Lines that are not whole are passed over: their shards are not counted."""
    shards = {row["shard"]: Shard(**row) for row in read_lines(folder / INDEX, _is_shard).rows}
    return [shards[number] for number in sorted(shards)]


def _is_shard(row: dict[str, Any]) -> bool:
    fields = {field.name for field in dataclasses.fields(Shard)}
    return set(row) == fields and all(isinstance(row[name], int) for name in fields - {"file", "sha256"})


def read_content(folder: Path, shard: Shard) -> bytes:
    """Bytes of a shard. Raises DatasetError, naming it, where it is missing or damaged."""
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


REMEDY = "; collect it again (delete its line of shards.jsonl), or leave it out with skip_damaged"
