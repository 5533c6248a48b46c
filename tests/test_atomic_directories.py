"""Directories that appear whole or not at all, with processes that are really killed."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from kinetix_dist.atomic_directories import PREFIX, new_directory
from tests.helpers import REPOSITORY

KILLED = """
import os, signal, sys
from pathlib import Path
from kinetix_dist.atomic_directories import new_directory

with new_directory(Path({path!r})) as draft:
    (draft / "a.txt").write_text("a")
    {then}
"""
KILL = "os.kill(os.getpid(), signal.SIGKILL)"
WAIT = "print('ready', flush=True); sys.stdin.read()"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("exists", [False, True])
def test_a_killed_process_leaves_no_directory_and_its_draft_does_not_hinder_the_next(
    tmp_path: Path, exists: bool
) -> None:
    path = tmp_path / "made"
    if exists:
        path.mkdir()
    code = KILLED.format(path=str(path), then=KILL)
    assert subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, check=False).returncode == -signal.SIGKILL
    assert path.exists() == exists
    [left] = list((path if exists else tmp_path).glob(f"{PREFIX}*"))
    assert (left / "a.txt").read_text() == "a", "the process was killed while it wrote"
    with new_directory(path) as draft:
        (draft / "b.txt").write_text("b")
    assert names(path) == ["b.txt"] and names(tmp_path) == ["made"]


def test_the_draft_of_a_running_process_stays_and_the_first_of_two_wins(tmp_path: Path) -> None:
    path = tmp_path / "made"
    code = KILLED.format(path=str(path), then=WAIT)
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=REPOSITORY, stdin=-1, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        with new_directory(path) as draft:
            (draft / "b.txt").write_text("b")
        assert len(names(tmp_path)) == 2, "the other process still has its draft"
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and "was made by another process meanwhile" in errors
    assert names(path) == ["b.txt"] and names(tmp_path) == ["made"]


def test_an_error_removes_the_draft_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="no"), new_directory(tmp_path / "made"):
        raise ValueError("no")
    assert names(tmp_path) == ["mine.txt"]


def test_what_is_there_already_stays(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="is a file; name a new directory"), new_directory(file):
        pass
    with pytest.raises(FileExistsError, match="is not empty; name a new directory"), new_directory(tmp_path):
        pass
    assert names(tmp_path) == ["file"] and file.read_text() == "mine"


def test_the_working_directory_can_be_filled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with new_directory(Path()) as draft:
        (draft / "a.txt").write_text("a")
    assert names(Path()) == names(tmp_path) == ["a.txt"]
