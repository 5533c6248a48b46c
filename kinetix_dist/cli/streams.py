"""Standard streams of a command: closed, without a reader, with a hanging reader, or with another encoding than UTF-8.

None of these is a reason for a command to fail: its results are files and its exit status. Characters that the
encoding of a stream lacks are shown as "?". Output at the exit of a command waits for no hanging reader.

Names of files, and texts in them, come from anywhere. Standard output and `say` escape their control characters, so
that none of them moves the cursor, renames the window or reaches the clipboard. Colours, which a terminal gets from
tables, pass.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
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
    """Otherwise a file that is opened later would get the number of a standard stream, and the printed text."""
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
    return _EscapingText(file, encoding=stream.encoding, errors="replace", **like)


class _EscapingText(io.TextIOWrapper):
    """Text stream that escapes control characters."""

    def write(self, text: str) -> int:
        super().write(_escaped(text, keeps_colours=self.isatty()))
        return len(text)


# A colour; or a control character but for tab and line feed, or a mark that reverses the direction of text.
_CONTROL = re.compile("(\x1b\\[[0-9;]*m)|[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def _escaped(text: str, *, keeps_colours: bool) -> str:
    def shown(found: re.Match[str]) -> str:
        return found[0] if keeps_colours and found[1] else found[0].encode("unicode_escape").decode()

    return _CONTROL.sub(shown, text)


class _DroppingFile(io.FileIO):
    """A pipe that accepts writes after its reader has ended, as /dev/null does."""

    def write(self, content: Any) -> int | None:
        try:
            return super().write(content)
        except BrokenPipeError:
            return memoryview(content).nbytes


PATIENCE_S = 1.0  # for a reader to empty the pipe
_CHUNK_BYTES = 512  # POSIX: a pipe that is ready for writing takes this number of bytes without blocking


def say(text: str, stream: TextIO) -> None:
    """Write lines to a standard stream. Text that a full pipe does not take within PATIENCE_S is left out."""
    try:
        number = stream.fileno()
        pipe = None if stream.isatty() else number
    except (OSError, ValueError):  # no file, but an object that collects text
        pipe = None
    text = _escaped(text, keeps_colours=pipe is None)
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
    """End this process if a standard stream is full: Python would wait for it, or fail, at exit."""
    if not all(_is_writable(stream.fileno(), 0.0) for stream in (sys.stdout, sys.stderr)):
        os._exit(status)


def exit_now(status: int) -> NoReturn:
    """Flush the streams, then end this process without the usual end of Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _is_writable(number: int, seconds: float) -> bool:
    """Return True if a descriptor takes data, as files always do. A pipe without a reader does, too: writing fails."""
    return bool(select.select([], [number], [], seconds)[1])
