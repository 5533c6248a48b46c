"""Standard streams of a command: closed ones, those without a reader, and those that are not UTF-8.

None of these is a reason for a command to fail: its work is files, and its exit status says how that went. What cannot
be shown in the encoding of a stream is shown as "?".
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any

_NAMES = ("stdin", "stdout", "stderr")  # by descriptor


def prepare_streams() -> None:
    """Once a process, before anything is printed or opened."""
    for number, name in enumerate(_NAMES):
        if getattr(sys, name) is None:  # it was closed when Python started
            _open_nothing_at(number)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    sys.stdout = _for_any_reader(sys.stdout)
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="replace")


def _open_nothing_at(number: int) -> None:
    """A file that is opened later would otherwise get the number of a standard stream, and what is printed."""
    nothing = os.open(os.devnull, os.O_RDWR)
    if nothing != number:
        os.dup2(nothing, number)
        os.close(nothing)


def _for_any_reader(stream: Any) -> Any:
    """The same stream, which drops text without a reader; another class of stream stays as it is."""
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    stream.flush()
    file: Any = _DroppingFile(stream.fileno(), "w", closefd=False)
    if not stream.write_through:  # as with PYTHONUNBUFFERED
        file = io.BufferedWriter(file)
    like = {"line_buffering": stream.line_buffering, "write_through": stream.write_through}
    return io.TextIOWrapper(file, encoding=stream.encoding, errors="replace", **like)


class _DroppingFile(io.FileIO):
    """A pipe that takes what is written after its reader has ended, as /dev/null does."""

    def write(self, content: Any) -> int | None:
        try:
            return super().write(content)
        except BrokenPipeError:
            return memoryview(content).nbytes
