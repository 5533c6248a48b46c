"""A long file read by a process of its own is the table that reading line by line gives, whatever is in the file."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.studio.runs import long_metrics, run_reader
from kinetix_dist.studio.runs.run_reader import RunReader

PLAIN = [{"update": k, "a": k / 7, "b": k if k % 2 else k / 2, "c": None if k % 3 else 1e-9 * k} for k in range(1, 400)]
FILES = {
    "plain": [json.dumps(row) for row in PLAIN],
    "a metric that comes late": [json.dumps(row | ({"late": 1.5} if row["update"] > 200 else {})) for row in PLAIN],
    "a run that went back": [json.dumps(row) for row in PLAIN + PLAIN[150:]],
    "a damaged line": [*map(json.dumps, PLAIN[:20]), '{"update": 21, "a', *map(json.dumps, PLAIN[20:])],
    "an object that is no row": [*map(json.dumps, PLAIN), '{"a": 3}', "", '{"update": 1.5}'],
    "text and truth": [json.dumps(row | {"d": "text", "e": row["update"] > 9}) for row in PLAIN],
    "numbers and text": [json.dumps(row | {"d": "x" if row["update"] > 300 else 2}) for row in PLAIN],
    "not finite": [json.dumps(row | {"d": float("nan") if row["update"] % 2 else float("inf")}) for row in PLAIN],
    "infinite in float64": [*map(json.dumps, PLAIN), '{"update": 400, "a": 1e999}', '{"update": 401, "a": 1.0}'],
    "more than 64 bits": [*map(json.dumps, PLAIN), f'{{"update": 400, "a": {10**30}}}', '{"update": 401, "a": 1}'],
    "one unfinished line": [],
}


def write(run: Path, lines: list[str], end: str = '{"update": 9000, "a"') -> None:
    (run / "metrics").mkdir()
    (run / "metrics" / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines) + end)


def same(a: RunReader, b: RunReader) -> None:
    assert set(a.table.names) == set(b.table.names) and a.table.num_rows == b.table.num_rows
    for name in ("update", *a.table.names):
        np.testing.assert_array_equal(a.table.column(name), b.table.column(name), name)
    assert a.problems == b.problems


@pytest.mark.parametrize("name", FILES)
def test_the_table_is_that_of_reading_line_by_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    write(tmp_path, FILES[name])
    by_line = RunReader(tmp_path)
    by_line.read_first(lambda left: None)
    monkeypatch.setattr(run_reader, "LONG_BYTES", 0)
    reader, left = RunReader(tmp_path), []
    reader.read_first(left.append)
    same(reader, by_line)
    assert left == sorted(left, reverse=True) and (left or not FILES[name])
    with (tmp_path / "metrics" / "metrics.jsonl").open("a") as file:  # and both go on where they are
        file.write(': 0.5}\n{"update": 9001, "a": 1.5}\n')
    for one in (reader, by_line):
        one.poll()
    assert reader.table.column("a")[-2:].tolist() == [0.5, 1.5]
    same(reader, by_line)


def test_pieces_end_at_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces end at lines, also where one line is longer than a piece."""
    long = json.dumps({"update": 1000, "text": "x" * 5000})
    write(tmp_path, [*FILES["plain"], long, json.dumps({"update": 1001, "a": 2.0})])
    file = tmp_path / "metrics" / "metrics.jsonl"
    monkeypatch.setattr(long_metrics, "PIECE_BYTES", 300)
    out = io.BytesIO()
    long_metrics.main(file, out)
    about = json.loads(out.getvalue().split(b"\n")[out.getvalue().count(b'{"done"')])
    assert about["rows"] == len(PLAIN) + 2 and about["damaged"] == 0
    assert file.read_bytes()[about["offset"] :] == b'{"update": 9000, "a"'


def test_where_the_process_cannot_be_the_file_is_read_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, FILES["plain"])
    monkeypatch.setattr(run_reader, "LONG_BYTES", 0)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    reader = RunReader(tmp_path)
    reader.read_first(lambda left: None)
    assert reader.table.num_rows == len(PLAIN)
