"""Replacement of files: through links, of read-only files, and by several writers at once."""

from __future__ import annotations

import multiprocessing
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from kinetix_dist.atomic_files import compare_and_replace, replace_file

ROUNDS, WRITERS = 10, 8


def accept(content: bytes | None) -> None:
    """Take any content."""


def replace_checked(path: Path, content: bytes) -> None:
    compare_and_replace(path, content, accept)


replacements = pytest.mark.parametrize("replace", [replace_file, replace_checked])
Replace = Callable[[Path, bytes], None]


@replacements
def test_a_link_stays_and_its_target_gets_the_content(replace: Replace, tmp_path: Path) -> None:
    target, link = tmp_path / "folder" / "target", tmp_path / "link"
    target.parent.mkdir()
    target.write_bytes(b"old")
    link.symlink_to("folder/target")
    replace(link, b"new")
    assert link.is_symlink() and target.read_bytes() == b"new"
    target.unlink()
    replace(link, b"made")
    assert link.is_symlink() and target.read_bytes() == b"made"
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["folder", "link", "target"]


@replacements
def test_links_in_a_circle_are_an_error(replace: Replace, tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match="symbolic links"):
        replace(tmp_path / "a", b"new")
    assert (tmp_path / "a").is_symlink()


@replacements
def test_a_read_only_file_is_refused_and_other_permissions_stay(replace: Replace, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    path.chmod(0o440)
    with pytest.raises(PermissionError, match="read-only; make it writable"):
        replace(path, b"new")
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["file"]
    path.chmod(0o640)
    replace(path, b"new")
    assert path.read_bytes() == b"new" and stat.S_IMODE(path.stat().st_mode) == 0o640


def write_once(path: Path, number: int, before: bytes | None, start: threading.Barrier) -> bool:
    """Replace the file if it is as before, when all writers are there. Return True for the one that wins."""

    class Refused(Exception):
        pass

    def check(content: bytes | None) -> None:
        if content != before:
            raise Refused

    start.wait()
    try:
        compare_and_replace(path, b"%d" % number, check)
    except Refused:
        return False
    return True


@pytest.mark.parametrize("exists", [True, False])
def test_of_several_processes_that_saw_the_same_content_one_wins(exists: bool, tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, context.Pool(WRITERS) as pool:
        for attempt in range(ROUNDS):
            path = tmp_path / f"{attempt}"
            before = b"old" if exists else None
            if before is not None:
                path.write_bytes(before)
            start = manager.Barrier(WRITERS)
            won = pool.starmap(write_once, [(path, number, before, start) for number in range(WRITERS)], chunksize=1)
            assert sum(won) == 1 and path.read_bytes() == b"%d" % won.index(True)
    assert len(os.listdir(tmp_path)) == ROUNDS  # no drafts
