"""The command itself: help, what it says when it is given something wrong, and what it does not import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kinetix_dist.cli.main import COMMANDS, main
from kinetix_dist.errors import UserError, one_line, user_errors
from tests.helpers import PATIENCE_S, REPOSITORY


def run_command(*arguments: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Runs `python -m kinetix_dist` in a new process; modules in `path` come before all installed ones."""
    places = [str(path)] if path else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*places, str(REPOSITORY)])}
    command = [sys.executable, "-m", "kinetix_dist", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)


def assert_one_line(error: str, *words: str) -> None:
    assert error.count("\n") == 1, f"one line expected:\n{error}"
    assert "Traceback" not in error
    for word in words:
        assert word in error


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in COMMANDS:
        assert name in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert f"usage: kinetix-dist {name}" in capsys.readouterr().out


def test_an_unknown_command_is_one_line_with_the_nearest_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trian"]) == 2
    assert_one_line(capsys.readouterr().err, "'trian'", "'train'")


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_option_is_one_line_in_every_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--no-such-option", "1"]) == 2
    assert_one_line(capsys.readouterr().err, f"kinetix-dist {name} --help")


def test_a_value_outside_the_choices_is_one_line_that_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "engine", "--sizes", "xl"]) == 2
    assert_one_line(capsys.readouterr().err, "'xl'", "'s', 'm', 'l'")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_current_directory_that_was_removed_is_one_line(name, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main([name]) == 2
    assert_one_line(capsys.readouterr().err, "the current directory was removed")


def test_importing_the_command_imports_nothing_heavy() -> None:
    check = "import sys, kinetix_dist.cli.main; print([m for m in ('jax', 'ray', 'warp', 'tyro') if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, cwd=REPOSITORY, check=True, timeout=PATIENCE_S
    )
    assert done.stdout.strip() == "[]"


def test_a_missing_package_is_one_line_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "jax.py").write_text("raise ModuleNotFoundError(\"No module named 'jax'\", name='jax')\n")
    done = run_command("bench", "engine", path=tmp_path)
    assert done.returncode == 2
    assert_one_line(done.stderr, "jax")


def test_expected_errors_become_user_errors_and_others_stay_what_they_are() -> None:
    with pytest.raises(UserError, match="bad level"), user_errors(ValueError):
        raise ValueError("bad\nlevel")
    with pytest.raises(KeyError), user_errors(ValueError):
        raise KeyError("a bug")


def test_one_line_joins_lines_and_names_errors_without_text() -> None:
    assert one_line("a\n  b") == "a b"
    assert one_line(OSError()) == "OSError"
