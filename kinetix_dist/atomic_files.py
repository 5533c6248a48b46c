"""Files that change as a whole or not at all, whatever the disk or a kill of the process does.

AtomicAppender(path).append(data)           a disk that fills up leaves no half row
replace_file(path, content)                 a reader has the old or the new content
compare_and_replace(path, content, check)   of several writers that read the same content one wins
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import stat
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any


def append_atomically(file: io.FileIO, data: bytes, start: int) -> None:
    """Write all of `data` at `start`, the end of the file.

    Raises:
        OSError: if the disk takes less; the file is as before.
    """
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]
    except OSError:
        with contextlib.suppress(OSError):  # the first error is reported
            file.truncate(start)
        raise


class AtomicAppender:
    """Append to a file, without a buffer: written data survives a kill of the process."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a+b", buffering=0)

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._file.seek(0, os.SEEK_END)

    def _last_byte(self) -> bytes:
        """Return b"" if the file is empty."""
        if not self.size:
            return b""
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) or b""

    def append(self, data: bytes) -> None:
        """Append all of `data`. Raises OSError if the disk takes less; the file is then as before."""
        append_atomically(self._file, data, self.size)

    def append_line(self, line: bytes) -> None:
        """Append a line. After an unfinished line it begins a new one."""
        self.append(line if self._last_byte() in (b"", b"\n") else b"\n" + line)

    def close(self) -> None:
        self._file.close()


def replace_file(path: Path, content: bytes, *, is_shared: bool = False) -> None:
    """Give a file new content: a reader has the old or the new one, whole, even if this process is killed.

    A symbolic link stays and its target gets the content. A file keeps its permissions.

    Args:
        is_shared: others may do so at the same time; the last of them wins.

    Raises:
        OSError: also if the file is read-only. It is as before, and no draft stays.
    """
    target = _followed(path)
    _refuse_read_only(target)
    draft = _draft(target, content, is_shared=is_shared)
    _move(draft, target, os.replace)


def compare_and_replace(path: Path, content: bytes, check: Callable[[bytes | None], None]) -> None:
    """Replace a file, as `replace_file` does, if `check` accepts its current content.

    No other call of this function, in any process, changes the file between check and replacement. So of several
    writers that require the same content, one wins.

    Args:
        check: receives the content, None if there is no file; raises an exception to refuse.

    Raises:
        OSError: also if the file is read-only.
    """
    target = _followed(path)
    _refuse_read_only(target)
    while True:
        with _locked(target) as file:
            check(None if file is None else file.read())
            draft = _draft(target, content, is_shared=True)
            if file is not None:
                return _move(draft, target, os.replace)
            with contextlib.suppress(FileExistsError):  # another writer was quicker: check again
                return _move(draft, target, _link_and_remove)


@contextlib.contextmanager
def _locked(path: Path) -> Generator[io.BufferedRandom | None]:
    """Open a file under an exclusive lock; None if there is no file.

    The lock is that of the inode. A writer that waited for it gets one that was replaced, and takes the next.
    """
    while True:
        try:
            file = path.open("rb+")
        except FileNotFoundError:
            yield None
            return
        with file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if _is_same_file(file.fileno(), path):
                yield file
                return


def _is_same_file(number: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(number), path.stat())
    except FileNotFoundError:
        return False


def _followed(path: Path) -> Path:
    """Return the file that a symbolic link leads to, which may be missing."""
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return target


def _refuse_read_only(path: Path) -> None:
    """Raise PermissionError if the permissions of a file, if it exists, let nobody here write.

    A replacement needs the permission of the directory only, and root has every permission.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_IMODE(mode) & 0o222 or not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, "it is read-only; make it writable with `chmod u+w`", str(path))


def _draft(path: Path, content: bytes, *, is_shared: bool) -> Path:
    """Write the content to a file in the same directory, with the permissions of the file that it will replace."""
    own = f".{os.getpid()}-{threading.get_ident()}" if is_shared else ""
    draft = path.with_name(f".{path.name}{own}.draft")
    try:
        with draft.open("wb") as file:
            with contextlib.suppress(FileNotFoundError):  # a new file has the permissions of the process
                _copy_permissions(path, file.fileno())
            file.write(content)
            flush_to_disk(file)
    except OSError:
        _remove(draft)
        raise
    return draft


def _copy_permissions(path: Path, to: int) -> None:
    """Give an open file the permissions of another one. Some file systems have the same for all and refuse changes."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode != stat.S_IMODE(os.fstat(to).st_mode):
        os.fchmod(to, mode)


def _move(draft: Path, path: Path, move: Callable[[Path, Path], None]) -> None:
    try:
        move(draft, path)
    except OSError:
        _remove(draft)
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _link_and_remove(draft: Path, path: Path) -> None:
    """Rename a file unless the new name is taken. Raises FileExistsError."""
    os.link(draft, path)
    draft.unlink()


def _remove(draft: Path) -> None:
    with contextlib.suppress(OSError):  # the first error is reported
        draft.unlink()  # a full disk has better uses


def flush_to_disk(file: Any) -> None:
    """Wait until the disk has everything that was written to an open file."""
    file.flush()
    os.fsync(file.fileno())
