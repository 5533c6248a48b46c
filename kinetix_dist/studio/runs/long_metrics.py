"""Reader of a long metrics.jsonl, in a process of its own and by Arrow, so that the server goes on responding.

    read_long --python -m kinetix_dist.studio.runs.long_metrics PATH--> {"done": bytes} ... {"names": ..., ...} columns

A piece of the file that Arrow does not read as columns of numbers (a damaged line, a run that went back) is read line
by line, as `Tail` and `SeriesTable` do: the table is the same.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from kinetix_dist.child_python import command_of
from kinetix_dist.json_text import json_text
from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.telemetry.json_lines import parse_line
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row
from kinetix_dist.telemetry.tail import COMPARED_BYTES, Tail
from kinetix_dist.text_files import MAX_INTEGER

LONG_BYTES = 32 << 20  # from here on it pays to start a process: a second
PIECE_BYTES = 32 << 20
BLOCK_BYTES = 8 << 20  # of a piece, for a thread of Arrow

ROW_BYTES = np.dtype(np.float64).itemsize


@dataclasses.dataclass(frozen=True)
class LongRead:
    """Table of the whole lines of a file up to `offset`."""

    table: SeriesTable
    offset: int
    inode: int
    tail_bytes: bytes  # the last bytes before the offset
    num_damaged: int

    def hand_over(self, tail: Tail) -> None:
        """Lets `tail` go on from the offset."""
        tail.go_on(inode=self.inode, offset=self.offset, last_bytes=self.tail_bytes, num_damaged=self.num_damaged)


def read_long(path: Path, report: Callable[[int], None]) -> LongRead | None:
    """Reads the whole lines of a file; report(bytes) receives how many are left.

    None: the process failed (the file is gone, or memory ran out), and nothing was read.
    """
    size = path.stat().st_size
    command = command_of("kinetix_dist.studio.runs.long_metrics", path)
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        found = None
        for line in process.stdout:
            about = json.loads(line)
            if "done" in about:
                report(max(size - about["done"], 0))
                continue
            found = _received(about, process.stdout)
    return found if process.returncode == 0 else None


def _received(about: dict[str, Any], stream: IO[bytes]) -> LongRead | None:
    rows = about["rows"]
    content = stream.read(ROW_BYTES * rows * len(about["names"]))
    if len(content) < ROW_BYTES * rows * len(about["names"]):
        return None  # the process was killed while it wrote
    table = SeriesTable()
    if rows:
        columns = np.frombuffer(content, np.float64).reshape(-1, rows)
        table.extend(dict(zip(about["names"], columns, strict=True)))
    tail_bytes = bytes.fromhex(about["tail_bytes"])
    return LongRead(table, about["offset"], about["inode"], tail_bytes, about["damaged"])


def main(path: Path, out: IO[bytes]) -> None:
    """Main function of the process."""
    table, offset, damaged, tail_bytes = SeriesTable(), 0, 0, b""
    with path.open("rb") as file:
        inode = os.fstat(file.fileno()).st_ino
        while piece := _whole_lines(file, offset):
            columns = _columns(piece)
            if columns is None or not table.can_extend(columns):
                rows = [parse_line(line) for line in filter(None, piece.split(b"\n"))]
                good = [row for row in rows if row is not None and is_metrics_row(row)]
                damaged += len(rows) - len(good)
                table.append(good)
            else:
                table.extend(columns)
            offset += len(piece)
            tail_bytes = (tail_bytes + piece)[-COMPARED_BYTES:]
            _write_line(out, {"done": offset})
    names = ["update", *table.names]
    about = {"names": names, "rows": table.num_rows, "offset": offset, "inode": inode, "damaged": damaged}
    _write_line(out, about | {"tail_bytes": tail_bytes.hex()})
    for name in names:
        out.write(np.ascontiguousarray(table.column(name)).data)
    out.flush()


def _write_line(out: IO[bytes], content: dict[str, Any]) -> None:
    out.write(json_text(content).encode() + b"\n")
    out.flush()


def _whole_lines(file: IO[bytes], offset: int) -> bytes:
    """Next whole lines; empty at the end of the file."""
    length = PIECE_BYTES
    while True:
        file.seek(offset)
        content = file.read(length)
        whole = content[: content.rfind(b"\n") + 1]
        if whole or len(content) < length:
            return whole
        length *= 2  # one line longer than a piece


def _columns(piece: bytes) -> dict[str, np.ndarray] | None:
    """Columns [rows] float64 by name, nan where a row has no number; None if Arrow reads a line as no row."""
    import pyarrow as pa
    import pyarrow.json

    try:
        options = pyarrow.json.ReadOptions(block_size=BLOCK_BYTES)
        table = pyarrow.json.read_json(pa.BufferReader(piece), read_options=options)
    except pa.ArrowInvalid:
        return None
    is_whole = table.num_rows == piece.count(b"\n") and "update" in table.column_names
    if not is_whole or table["update"].type != pa.int64() or table["update"].null_count:
        return None
    numbers: dict[str, np.ndarray] = {}
    for name in table.column_names:
        kind = table[name].type
        if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
            chunks = table[name].cast(pa.float64(), safe=False).chunks
            numbers[name] = np.concatenate([_values_of(chunk) for chunk in chunks if len(chunk)])
            if (np.abs(numbers[name]) > MAX_INTEGER).any():  # 1e999 is infinite here
                return None
    return numbers


def _values_of(chunk: Any) -> np.ndarray:
    """Values [n] of an Arrow array of float64, nan for null. Its own to_numpy imports pandas: 1.2 s of CPU time."""
    validity, values = chunk.buffers()
    wanted = slice(chunk.offset, chunk.offset + len(chunk))
    numbers = np.frombuffer(values, np.float64)[wanted]
    if not chunk.null_count:
        return numbers
    return np.where(np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[wanted], numbers, np.nan)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.stdout.buffer)
