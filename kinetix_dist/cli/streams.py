"""Standard streams of a command: closed ones, those without a reader, hanging ones, and those that are not UTF-8.

None of these is a reason for a command to fail: its work is files, and its exit status says how that went. Text that
the encoding of a stream does not have is shown as "?". Output at the exit of a command waits for no hanging reader.
"""

from __future__ import annotations

import contextlib
import io
import os
import select
import sys
from typing import Any, NoReturn, TextIO

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


PATIENCE_S = 1.0  # for a reader to empty the pipe
_CHUNK_BYTES = 512  # POSIX: where a pipe is ready for writing, so many bytes do not block


def say(text: str, stream: TextIO) -> None:
    """Writes lines to a standard stream. Text that a full pipe does not take within PATIENCE_S is left out."""
    try:
        number = stream.fileno()
        pipe = None if stream.isatty() else number
    except (OSError, ValueError):  # no file: an object that collects text
        pipe = None
    if pipe is None:
        print(text, file=stream, flush=True)
        return
    content = f"{text}\n".encode(stream.encoding or "utf-8", errors="replace")
    with contextlib.suppress(OSError):  # the reader is gone, or the disk is full
        if _is_writable(pipe, PATIENCE_S):
            stream.flush()
        while content and _is_writable(pipe, PATIENCE_S):
            content = content[os.write(pipe, content[:_CHUNK_BYTES]) :]


def exit_now_if_blocked(status: int) -> None:
    """Ends this process where a standard stream is full: Python would wait for it, or fail, at exit."""
    if not all(_is_writable(stream.fileno(), 0.0) for stream in (sys.stdout, sys.stderr)):
        os._exit(status)


def exit_now(status: int) -> NoReturn:
    """Ends this process without the usual end of Python, after what was printed."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _is_writable(number: int, seconds: float) -> bool:
    """True where a descriptor takes data. Files always do, and so does a pipe without a reader: writing fails there."""
    return bool(select.select([], [number], [], seconds)[1])
