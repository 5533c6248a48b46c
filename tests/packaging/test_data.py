"""Directories of levels and pretrained policies: in the package of a wheel, else at the top of the checkout."""

from __future__ import annotations

from pathlib import Path

import pytest

from kinetix_dist import installation
from kinetix_dist.checkpoint import CheckpointError, load_checkpoint
from kinetix_dist.checkpoint.store import find_checkpoint, pretrained_names
from kinetix_dist.level.level_data import LEVELS_VARIABLE, levels_root
from tests.helpers import REPOSITORY


def test_a_checkout_has_its_data_at_its_top(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LEVELS_VARIABLE, raising=False)
    assert levels_root() == REPOSITORY / "levels"
    assert installation.data_directory("pretrained") == REPOSITORY / "pretrained"


def test_a_wheel_has_its_data_inside_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a directory `levels` beside it in site-packages is another package's."""
    monkeypatch.delenv(LEVELS_VARIABLE, raising=False)
    package = tmp_path / "site-packages" / "kinetix_dist"
    for folder in (package / "data" / "levels", tmp_path / "site-packages" / "levels"):
        folder.mkdir(parents=True)
        (folder / "schema.json").write_text("{}")
    monkeypatch.setattr(installation, "PACKAGE", package)
    assert levels_root() == package / "data" / "levels"


def test_the_variable_names_other_levels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "schema.json").write_text("{}")
    monkeypatch.setenv(LEVELS_VARIABLE, str(tmp_path))
    assert levels_root() == tmp_path
    monkeypatch.setenv(LEVELS_VARIABLE, str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match=LEVELS_VARIABLE):
        levels_root()


def test_a_pretrained_policy_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "generalist" in pretrained_names()
    monkeypatch.chdir(tmp_path)
    checkpoint = load_checkpoint(Path("generalist"))
    assert checkpoint.path == REPOSITORY / "pretrained" / "generalist"
    assert checkpoint.description["config"]["env"]["size"] == "l"
    with pytest.raises(CheckpointError, match=r"no checkpoint generalists; did you mean 'generalist'\?"):
        load_checkpoint(Path("generalists"))


def test_a_directory_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_checkpoint(Path("some/generalist")) == Path("some/generalist")
    (tmp_path / "generalist").mkdir()
    assert find_checkpoint(Path("generalist")) == Path("generalist")
