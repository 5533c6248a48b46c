"""Engines of other revisions and of variants, beside the working tree."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY, python_path


def compare(*arguments: str, cwd: Path = REPOSITORY) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(REPOSITORY / "bench" / "compare_revisions.py"), *arguments]
    environment = os.environ | {"PYTHONPATH": python_path(), "JAX_PLATFORMS": "cpu"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=cwd, timeout=900)


TINY = ("--sizes", "s", "--worlds", "4", "--steps", "4", "--repeats", "1")


@pytest.mark.slow
def test_a_variant_runs_beside_the_working_tree(tmp_path: Path) -> None:
    done = compare("run", "--variants", "--only", "blocks of 128", *TINY, "--json", str(tmp_path / "out.json"))
    assert done.returncode == 0, done.stderr
    records = json.loads((tmp_path / "out.json").read_text())["records"]
    assert [record["name"] for record in records] == ["blocks of 128", "working tree"]
    assert records[0]["bits_of_working_tree"]  # a CPU knows no blocks
    assert records[1]["of_working_tree"] == 1.0


@pytest.mark.slow
def test_an_exported_revision_runs_without_git(tmp_path: Path) -> None:
    if not (REPOSITORY / ".git").exists():
        pytest.skip("no git history here: nothing to export")
    folder = str(tmp_path / "revisions")
    assert compare("export", "HEAD", "--folder", folder).returncode == 0
    done = compare("run", "--folder", folder, *TINY, "--json", str(tmp_path / "out.json"))
    assert done.returncode == 0, done.stderr
    records = json.loads((tmp_path / "out.json").read_text())["records"]
    assert [record["name"] for record in records] == ["HEAD", "working tree"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "--folder", "nowhere"), "nowhere/revisions.json does not exist; run"),
        (("run", "--variants", "--only", "magic"), "--only has 'magic'; there are blocks of 32"),
        (("run", "--sizes", "xl"), "--sizes has 'xl'; give s, m, l, or a number of shapes"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(arguments: tuple[str, ...], said: str) -> None:
    done = compare(*arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
