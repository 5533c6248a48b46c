"""Directories that appear whole or not at all, even if the process is killed.

with new_directory(Path("levels")) as draft:  # levels/ does not exist yet
    write_files(draft)
# levels/ exists, with every file
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Generator
from pathlib import Path

# No user chooses such names by accident.
PREFIX = ".kinetix-dist-"
LOCKED, UNLOCKED = f"{PREFIX}draft-", f"{PREFIX}new-"
NUM_DIGITS = 8


@contextlib.contextmanager
def new_directory(path: Path) -> Generator[Path]:
    """Yield an empty draft directory that becomes `path` when the block ends without an exception.

    A block that raises removes its draft. A killed process leaves one behind; the next call for the same `path` removes
    it. Drafts are locked, so the draft of a running process stays.

    An empty directory may exist at `path`. It could be a mount point or the working directory of a shell, so it stays:
    the files move into it one after another, and only a kill between these renames leaves a part of them.

    Raises:
        FileExistsError: `path` is a file or a directory with files. Nothing is changed.
        OSError: the directory cannot be written.
    """
    exists = path.is_dir()
    parent, name = (path, "") if exists else (path.parent, path.name)
    if exists:
        _remove_dead_drafts(parent, name)
        if any(not entry.name.startswith(PREFIX) for entry in path.iterdir()):
            raise FileExistsError(f"{path} is not empty; name a new directory")
    elif os.path.lexists(path):
        raise FileExistsError(f"{path} is a file; name a new directory")
    else:
        parent.mkdir(parents=True, exist_ok=True)
        _remove_dead_drafts(parent, name)
    draft, lock = _locked_draft(parent, name)
    try:
        yield draft
        flush_tree(draft)
        _publish(draft, path)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
    finally:
        if lock is not None:
            os.close(lock)
    flush_directory(parent)


def _publish(draft: Path, path: Path) -> None:
    if draft.parent == path:
        for entry in sorted(draft.iterdir()):
            entry.rename(path / entry.name)
        draft.rmdir()
        return
    try:
        draft.rename(path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise FileExistsError(f"{path} was made by another process meanwhile; name another directory") from None
        raise


def _locked_draft(parent: Path, name: str) -> tuple[Path, int | None]:
    """Return a new draft and the descriptor that locks it, `None` if the file system has no locks.

    The directory gets its final name after the lock, so no other process takes it for a dead draft.
    """
    number = secrets.token_hex(NUM_DIGITS // 2)
    unlocked = parent / f"{UNLOCKED}{name}-{number}"
    unlocked.mkdir()
    lock = _try_lock(unlocked)
    return unlocked.rename(parent / f"{LOCKED}{name}-{number}"), lock


def _remove_dead_drafts(parent: Path, name: str) -> None:
    """Remove the drafts of `parent / name` that no process has locked."""
    for draft in parent.iterdir():
        if draft.name[:-NUM_DIGITS] == f"{LOCKED}{name}-" and draft.is_dir() and not draft.is_symlink():
            lock = _try_lock(draft)
            if lock is not None:
                shutil.rmtree(draft, ignore_errors=True)
                os.close(lock)


def _try_lock(directory: Path) -> int | None:
    """Return a descriptor that locks `directory`; `None` if it is gone, locked, or on a file system without locks."""
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def flush_tree(directory: Path) -> None:
    """Wait until the disk has every file below `directory`."""
    for path in directory.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        else:
            flush_directory(path)
    flush_directory(directory)


def flush_directory(path: Path) -> None:
    """Wait until the disk has the entries of a directory."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
