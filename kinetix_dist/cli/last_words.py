"""What a command says at its end, also into a pipe whose reader hangs: its work is done, and nobody is to wait."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from typing import TextIO

PATIENCE_S = 1.0  # for a reader to make room
_CHUNK_BYTES = 512  # POSIX: where a pipe is ready for writing, so many bytes do not block


def say(text: str, stream: TextIO) -> None:
    """Writes a line, or several, to a standard stream. What a pipe has no room for within PATIENCE_S is left out."""
    try:
        number = stream.fileno()
        is_pipe = not stream.isatty()
    except (OSError, ValueError):  # no file, but what collects text
        is_pipe = False
    if not is_pipe:
        print(text, file=stream, flush=True)
        return
    content = f"{text}\n".encode(stream.encoding or "utf-8", errors="replace")
    with contextlib.suppress(OSError):  # nobody reads any more, or the disk is full
        if _has_room(number, PATIENCE_S):
            stream.flush()
        while content and _has_room(number, PATIENCE_S):
            content = content[os.write(number, content[:_CHUNK_BYTES]) :]


def leave(status: int) -> None:
    """Ends this process where a standard stream has no room: Python would wait for it, or fail, on its way out."""
    if not all(_has_room(stream.fileno(), 0.0) for stream in (sys.stdout, sys.stderr)):
        os._exit(status)


def _has_room(number: int, seconds: float) -> bool:
    """Of a descriptor. Files always have, and so has a pipe without a reader: writing tells."""
    return bool(select.select([], [number], [], seconds)[1])
