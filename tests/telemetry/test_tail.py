"""Following a file that another process writes, against a reader of whole files that shares none of its state."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

import pytest

from kinetix_dist.telemetry.json_lines import append_line, read_lines
from kinetix_dist.telemetry.tail import Tail


def write(path: Path, content: bytes, mode: str = "ab") -> None:
    with path.open(mode) as file:
        file.write(content)


def updates(rows: list[dict]) -> list[int]:
    return [row["update"] for row in rows]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "metrics.jsonl"


def test_a_file_that_comes_later_is_followed(path: Path) -> None:
    tail = Tail(path)
    assert tail.poll().rows == []
    append_line(path, {"update": 1})
    assert updates(tail.poll().rows) == [1]
    assert tail.poll().rows == []
    append_line(path, {"update": 2})
    found = tail.poll()
    assert updates(found.rows) == [2] and not found.is_restarted


def test_half_a_line_waits_for_its_rest(path: Path) -> None:
    tail = Tail(path)
    write(path, b'{"update": 1}\n{"upd')
    assert updates(tail.poll().rows) == [1]
    write(path, b'ate": 2}')
    assert updates(tail.poll().rows) == [2], "an object is whole when it ends, as for json_lines"
    write(path, b"\n")
    assert tail.poll().rows == [] and tail.num_damaged == 0


def test_what_follows_an_object_on_its_line_makes_it_damaged(path: Path) -> None:
    tail = Tail(path)
    write(path, b'{"update": 1}')
    assert updates(tail.poll().rows) == [1]
    write(path, b' and more\n{"update": 2}\n')
    found = tail.poll()
    assert found.is_restarted and updates(found.rows) == [2] and tail.num_damaged == 1


@pytest.mark.parametrize("junk", [b"not json\n", b"\0\0\0\0\n", b"[1, 2]\n", b'"text"\n', b"\xff\xfe\n", b'{"a": \n'])
def test_damaged_lines_are_counted_and_passed(path: Path, junk: bytes) -> None:
    write(path, b'{"update": 1}\n' + junk + b'{"update": 2}\n')
    tail = Tail(path)
    assert updates(tail.poll().rows) == [1, 2] and tail.num_damaged == 1


def test_an_object_that_is_no_row_is_damaged(path: Path) -> None:
    write(path, b'{"update": 1}\n{"other": 1}\n')
    tail = Tail(path, is_row=lambda row: "update" in row)
    assert updates(tail.poll().rows) == [1] and tail.num_damaged == 1


@pytest.mark.parametrize(
    "content",
    [b"", b'{"update": 9}\n', b'{"update": 7}\n' * 20],
    ids=["emptied", "shorter", "longer"],
)
def test_a_file_rewritten_in_place_is_read_again(path: Path, content: bytes) -> None:
    write(path, b'{"update": 1}\n{"update": 2}\n{"update": 3}\n')
    tail = Tail(path)
    tail.poll()
    write(path, content, "wb")
    found = tail.poll()
    assert found.is_restarted and found.rows == read_lines(path).rows


def test_a_file_replaced_by_a_rename_is_read_again(path: Path) -> None:
    write(path, b'{"update": 1}\n{"update": 2}\n')
    tail = Tail(path)
    tail.poll()
    other = path.with_suffix(".new")
    write(other, b'{"update": 1}\n{"update": 2}\n{"update": 3}\n')
    os.replace(other, path)
    found = tail.poll()
    assert found.is_restarted and updates(found.rows) == [1, 2, 3]


def test_a_file_that_goes_voids_its_rows(path: Path) -> None:
    write(path, b'{"update": 1}\n')
    tail = Tail(path)
    tail.poll()
    path.unlink()
    assert tail.poll().is_restarted and not tail.poll().is_restarted


def test_a_directory_of_that_name_is_an_error_and_can_be_mended(path: Path) -> None:
    path.mkdir()
    tail = Tail(path)
    with pytest.raises(OSError):
        tail.poll()
    path.rmdir()
    append_line(path, {"update": 1})
    assert updates(tail.poll().rows) == [1]


def test_a_poll_reads_no_more_than_it_may_and_says_what_is_left(path: Path) -> None:
    content = b"".join(b'{"update": %d}\n' % k for k in range(1000))
    write(path, content)
    tail, found = Tail(path), []
    while True:
        poll = tail.poll(max_bytes=100)
        assert 0 < len(poll.rows) <= 100 // 14 or poll.bytes_left == 0
        found += poll.rows
        if not poll.bytes_left:
            break
    assert updates(found) == list(range(1000))


def test_a_line_longer_than_a_poll_is_read(path: Path) -> None:
    write(path, json.dumps({"update": 1, "text": "x" * 5000}).encode() + b"\n" + b'{"update": 2}\n')
    tail, found = Tail(path), []
    for _ in range(10):
        found += tail.poll(max_bytes=64).rows
    assert updates(found) == [1, 2]


PIECES = (b'{"update": 1}', b"\n", b"{", b"}", b'"', b"\0", b'{"update": 22, "x": [1, {"y": "}"}]}\n', b"junk", b"\n\n")


@pytest.mark.parametrize("seed", range(200))
def test_rows_are_those_of_a_reader_of_the_whole_file(path: Path, seed: int) -> None:
    """Random pieces appended, files rewritten, cut and rotated, polls of random sizes in between."""
    chance = random.Random(seed)
    tail, rows = Tail(path), []

    def poll(max_bytes: int) -> int:
        nonlocal rows
        found = tail.poll(max_bytes)
        rows = found.rows if found.is_restarted else rows + found.rows
        return found.bytes_left

    for _ in range(60):
        action = chance.random()
        content = b"".join(chance.choices(PIECES, k=chance.randint(1, 6)))
        if action < 0.75 or not path.exists():
            if chance.random() < 0.3:  # byte by byte, with a look after each
                for k in range(len(content)):
                    write(path, content[k : k + 1])
                    poll(chance.choice((1, 7, 10_000)))
            else:
                write(path, content)
        elif action < 0.8:
            # Another content at the end, which is all that a rewrite in place can be told by.
            write(path, content + b'{"update": %d}\n' % chance.getrandbits(200), "wb")
        elif action < 0.85:
            other = path.with_suffix(".new")
            write(other, content + b'{"update": %d}\n' % chance.getrandbits(200), "wb")
            os.replace(other, path)
        elif action < 0.9:
            os.truncate(path, chance.randint(0, path.stat().st_size))
        poll(chance.choice((3, 50, 10_000)))
    while poll(10_000):
        pass
    whole = read_lines(path)
    assert rows == whole.rows
    if whole.is_ended:
        assert tail.num_damaged == len(whole.damaged)
