"""Programs that are not commands of kinetix-dist: help is help, and bad input is one line and exit code 2."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from bench import published_steps
from jax2d.fidelity import hard_table, references

PROGRAMS = [hard_table.main, references.main, published_steps.main]


@pytest.mark.parametrize("main", PROGRAMS, ids=lambda main: main.__module__)
def test_help_is_printed(main: Callable, capsys):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: python -m {main.__module__}")


@pytest.mark.parametrize(
    ("main", "arguments", "says"),
    [
        (hard_table.main, ["nosuch"], "unknown preset 'nosuch'; known: standard, fine, draft, paper"),
        (hard_table.main, ["standard", "reference"], "unknown preset 'reference'"),
        (references.main, ["nosuch"], "'nosuch'"),
        (published_steps.main, [], "arguments are required"),
        (published_steps.main, ["nosuch.npz", "to.npz"], "nosuch.npz does not exist"),
        (published_steps.main, ["other.npz", "to.npz"], "no excerpt of other.npz in to.npz"),
        (published_steps.main, ["text.npz", "to.npz"], "no excerpt of text.npz in to.npz"),
    ],
)
def test_bad_input_is_one_line(main: Callable, arguments: list[str], says: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("text.npz").write_text("steps")
    with zipfile.ZipFile("other.npz", "w"):
        pass
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
