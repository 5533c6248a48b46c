"""Files that change as a whole or not at all, whatever the disk or a kill of the process does.

AtomicAppender(path).append(data)   a disk that fills up leaves no half row
replace_file(path, content)         a reader has the old or the new content
"""

from __future__ import annotations

import contextlib
import io
import os
import threading
from pathlib import Path
from typing import Any


def append_atomically(file: io.FileIO, data: bytes, start: int) -> None:
    """Writes all of `data` at `start`, the end of the file. Where the disk takes less, the file is as before and
    OSError is raised."""
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]
    except OSError:
        with contextlib.suppress(OSError):  # the first error is the one to report
            file.truncate(start)
        raise


class AtomicAppender:
    """Appends to a file, without a buffer of its own: written data survives a kill of the process."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a+b", buffering=0)

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._file.seek(0, os.SEEK_END)

    def _last_byte(self) -> bytes:
        """b"" of an empty file."""
        if not self.size:
            return b""
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) or b""

    def append(self, data: bytes) -> None:
        """Appends all of `data`; where the disk takes less, the file is as before and OSError is raised."""
        append_atomically(self._file, data, self.size)

    def append_line(self, line: bytes) -> None:
        """Appends a line, on a line of its own also after an unfinished one."""
        self.append(line if self._last_byte() in (b"", b"\n") else b"\n" + line)

    def close(self) -> None:
        self._file.close()


def replace_file(path: Path, content: bytes, *, is_shared: bool = False) -> None:
    """Gives a file new content: a reader has the old or the new one, whole, whenever this is killed.

    is_shared: others may do so at the same time; the last of them wins. Raises OSError, and leaves no draft then.
    """
    own = f".{os.getpid()}-{threading.get_ident()}" if is_shared else ""
    draft = path.with_name(f".{path.name}{own}.draft")
    try:
        with draft.open("wb") as file:
            file.write(content)
            flush_to_disk(file)
        os.replace(draft, path)
    except OSError:
        with contextlib.suppress(OSError):  # the first error is the one to report
            draft.unlink()  # a full disk has better uses
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def flush_to_disk(file: Any) -> None:
    """Waits until the disk has everything that was written to an open file."""
    file.flush()
    os.fsync(file.fileno())
