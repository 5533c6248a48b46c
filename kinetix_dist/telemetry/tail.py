"""Follows a file of JSON lines that another process writes, by asking for its size now and then.

Notifications of the kernel (inotify) see nothing of what another machine writes to a shared disk, so `Tail.poll` looks
and reads what is new. What it has handed out stays true as long as the file only grows. A file that became another
(rotated, rewritten, shortened) is read again from its start, and `Tailed.is_restarted` says so:

| what happened to the file | noticed by |
|---|---|
| another file has its name (written aside and renamed) | inode |
| shorter than what was read | size |
| rewritten in place, as long or longer | the last bytes that were read are others now |

Lines are whole or damaged as `json_lines` has it: a line is whole when it is a JSON object, also before its line end is
there; an unfinished last line waits for its rest.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO

from kinetix_dist.telemetry.json_lines import Row, parse_line

COMPARED_BYTES = 64  # before the position that is read next; compared at every poll
MAX_BYTES = 8 << 20  # of one poll: about 7,000 rows of metrics, 0.15 s


@dataclasses.dataclass(frozen=True)
class Tailed:
    """Result of a poll."""

    rows: list[Row]  # new ones, in order
    is_restarted: bool  # rows of earlier polls are void: these begin at the start of the file
    bytes_left: int  # that a further poll would read now


class Tail:
    """Follows one file; it may be missing, and come later."""

    def __init__(self, path: Path, is_row: Callable[[Row], bool] = lambda row: True) -> None:
        """is_row: of a JSON object, whether it is what the file should hold; others count as damaged."""
        self._path = path
        self._is_row = is_row
        self._start_again()

    def _start_again(self) -> None:
        self._inode = -1
        self._offset = 0  # all before it was handed out, or counted as damaged
        self._last_bytes = b""  # the bytes just before the offset
        self._is_after_whole_line = True  # False: the offset is behind an object that has no line end yet
        self._damaged = 0

    @property
    def num_damaged(self) -> int:
        """Lines of the file, as far as it was read, that are no rows."""
        return self._damaged

    def go_on(self, *, inode: int, offset: int, last_bytes: bytes, num_damaged: int) -> None:
        """Goes on behind whole lines that another reader has read: up to `offset`; `last_bytes` are those before."""
        self._start_again()
        self._inode, self._offset, self._last_bytes, self._damaged = (
            inode,
            offset,
            last_bytes[-COMPARED_BYTES:],
            num_damaged,
        )

    def poll(self, max_bytes: int = MAX_BYTES) -> Tailed:
        """New rows. An absent file has none. Raises OSError where it cannot be read; the next poll tries again."""
        try:
            with self._path.open("rb") as file:
                status = os.fstat(file.fileno())
                is_restarted = self._offset > 0 and not self._is_same(file, status)
                if is_restarted:
                    self._start_again()
                self._inode = status.st_ino
                file.seek(self._offset)
                return self._read(file.read(max_bytes), status.st_size, is_restarted, max_bytes)
        except FileNotFoundError:
            is_restarted = self._offset > 0
            self._start_again()
            return Tailed(rows=[], is_restarted=is_restarted, bytes_left=0)

    def _is_same(self, file: IO[bytes], status: os.stat_result) -> bool:
        if status.st_ino != self._inode or status.st_size < self._offset:
            return False
        file.seek(self._offset - len(self._last_bytes))
        # Behind an object without a line end nothing but one may follow, or it was no whole line.
        following = file.read(len(self._last_bytes) + 1)
        is_ended = self._is_after_whole_line or following[len(self._last_bytes) :] in (b"", b"\n")
        return following[: len(self._last_bytes)] == self._last_bytes and is_ended

    def _read(self, content: bytes, size: int, is_restarted: bool, max_bytes: int) -> Tailed:
        whole_bytes = content.rfind(b"\n") + 1
        rows: list[Row] = []
        for line in filter(None, content[:whole_bytes].split(b"\n")):
            self._take(line, rows)
        rest = content[whole_bytes:]
        consumed = whole_bytes
        if rest and self._is_whole(rest):
            self._take(rest, rows)
            consumed = len(content)
        if consumed:
            self._is_after_whole_line = consumed == whole_bytes
            self._last_bytes = (self._last_bytes + content[:consumed])[-COMPARED_BYTES:]
            self._offset += consumed
        elif len(content) == max_bytes:
            return self._read_long_line(size, is_restarted, max_bytes)
        return Tailed(rows=rows, is_restarted=is_restarted, bytes_left=max(size - self._offset - len(rest), 0))

    def _read_long_line(self, size: int, is_restarted: bool, max_bytes: int) -> Tailed:
        """A line longer than a poll may read: with twice as much."""
        with self._path.open("rb") as file:
            file.seek(self._offset)
            content = file.read(2 * max_bytes)
        if len(content) <= max_bytes:
            return Tailed(rows=[], is_restarted=is_restarted, bytes_left=0)
        return self._read(content, size, is_restarted, 2 * max_bytes)

    def _is_whole(self, line: bytes) -> bool:
        return line.endswith(b"}") and parse_line(line) is not None

    def _take(self, line: bytes, rows: list[Row]) -> None:
        row = parse_line(line)
        if row is not None and self._is_row(row):
            rows.append(row)
        else:
            self._damaged += 1
