"""Level files of the command line: what may be named, and that nothing is lost when a file is saved."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from kinetix_dist.studio.server.level_files import ConflictError, FileNameError, LevelFiles, hash_of


@pytest.fixture
def files(tmp_path: Path) -> LevelFiles:
    (tmp_path / "folder").mkdir()
    for name in ("a.json", "folder/b.json", ".hidden.json", "text.txt"):
        (tmp_path / name).write_text(name)
    return LevelFiles(directory=tmp_path)


def test_files_of_the_directory_and_its_folders_are_listed_and_read(files: LevelFiles) -> None:
    assert files.names() == ["a.json", "folder/b.json"]
    assert files.read("folder/b.json").text == "folder/b.json"


@pytest.mark.parametrize(
    "name",
    ["../a.json", "/etc/passwd.json", "a/b/c.json", ".hidden.json", "a.txt", "", "folder/../../a.json", "a\0.json"],
)
def test_other_names_are_refused_and_nothing_is_written(files: LevelFiles, name: str, tmp_path: Path) -> None:
    before = sorted(tmp_path.parent.rglob("*"))
    with pytest.raises(FileNameError):
        files.save(name, "{}", was=None)
    with pytest.raises(FileNameError):
        files.read(name)
    assert sorted(tmp_path.parent.rglob("*")) == before


def test_a_link_out_of_the_directory_is_refused(files: LevelFiles, tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "out.json").symlink_to(tmp_path / "a.json")
    with pytest.raises(FileNameError, match="leads out"):
        LevelFiles(directory=inside).read("out.json")


def test_a_file_is_saved_over_what_was_read_and_nothing_else(files: LevelFiles, tmp_path: Path) -> None:
    os.chmod(tmp_path / "a.json", 0o640)
    read = files.read("a.json")
    saved = files.save("a.json", "new", was=read.hash)
    assert (tmp_path / "a.json").read_text() == "new" and saved == hash_of(b"new")
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o640
    with pytest.raises(ConflictError, match="changed elsewhere") as found:
        files.save("a.json", "newer", was=read.hash)
    assert found.value.hash == saved and (tmp_path / "a.json").read_text() == "new"
    with pytest.raises(ConflictError, match="is there already"):
        files.save("a.json", "newer", was=None)
    (tmp_path / "a.json").unlink()
    with pytest.raises(ConflictError, match="is gone"):
        files.save("a.json", "newer", was=saved)
    files.save("c.json", "made", was=None)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden.json", "c.json", "folder", "text.txt"]


def test_a_disk_that_fills_up_leaves_the_file_as_it_was(
    files: LevelFiles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        files.save("a.json", "new", was=files.read("a.json").hash)
    assert (tmp_path / "a.json").read_text() == "a.json"
    assert not list(tmp_path.glob("*.tmp")) and not list(tmp_path.glob(".*.tmp"))


def test_only_the_file_that_was_named(tmp_path: Path) -> None:
    files = LevelFiles(directory=tmp_path, only="mine.json")
    (tmp_path / "other.json").write_text("{}")
    assert files.names() == []
    with pytest.raises(FileNameError, match=r"not the file that was named on the command line, mine\.json"):
        files.read("other.json")
    files.save("mine.json", "{}", was=None)
    assert files.names() == ["mine.json"]
