"""A file to whose end data is added as a whole or not at all: a disk that fills up leaves no half row."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path


def write_whole(file: io.FileIO, data: bytes, start: int) -> None:
    """All of `data` at `start`, the end of the file; where the disk takes less, the file is as before and OSError
    is raised."""
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]
    except OSError:
        with contextlib.suppress(OSError):  # the first error is the one to report
            file.truncate(start)
        raise


class WholeWrites:
    """Appends to a file, without a buffer of its own: what was written survives a kill of the process."""

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

    def write(self, data: bytes) -> None:
        """All of `data`; where the disk takes less, the file is as before and OSError is raised."""
        write_whole(self._file, data, self.size)

    def write_line(self, line: bytes) -> None:
        """The same, on a line of its own also after an unfinished one."""
        self.write(line if self._last_byte() in (b"", b"\n") else b"\n" + line)

    def close(self) -> None:
        self._file.close()
