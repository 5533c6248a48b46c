"""The type check, `.ci/check_types.py`, fails as it should. Each test makes a small project with our settings."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import PATIENCE_S, REPOSITORY

# Kind of an error, and a module with that error only.
WRONG = {
    "bad-assignment": 'x: int = "a"\n',
    "bad-argument-type": 'def double(x: int) -> int:\n    return 2 * x\n\n\ny = double("a")\n',
    "bad-argument-count": "def double(x: int) -> int:\n    return 2 * x\n\n\ny = double(1, 2)\n",
    "bad-return": 'def name() -> int:\n    return "a"\n',
}
RIGHT = "def double(x: int) -> int:\n    return 2 * x\n"
OTHER_PACKAGES = ("jax2d", "bench", "examples", "tests/engine", "tests")


def project(directory: Path, files: dict[str, str]) -> Path:
    """Return a directory with the project's settings of pyrefly, the gate and these files."""
    for name in ("pyproject.toml", ".ci/check_types.py"):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, directory / name)
    for name, text in {"jax2d/right.py": RIGHT, **files}.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(text)
    return directory


def run(directory: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*command],
        cwd=directory,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
        stdin=subprocess.DEVNULL,
    )


def gate(directory: Path) -> subprocess.CompletedProcess[str]:
    return run(directory, sys.executable, ".ci/check_types.py")


@pytest.mark.parametrize("kind", WRONG)
def test_the_checker_finds_each_wrong_type(kind: str, tmp_path: Path) -> None:
    project(tmp_path, {"kinetix_dist/wrong.py": WRONG[kind]})
    done = run(tmp_path, sys.executable, "-m", "pyrefly", "check", "--output-format", "min-text")
    assert done.returncode == 1 and f"[{kind}]" in done.stdout


@pytest.mark.parametrize(
    ("kind", "package"),
    [*((kind, "kinetix_dist") for kind in WRONG), *(("bad-return", package) for package in OTHER_PACKAGES)],
)
def test_each_wrong_type_fails_the_gate_in_each_package(kind: str, package: str, tmp_path: Path) -> None:
    done = gate(project(tmp_path, {f"{package}/wrong.py": WRONG[kind]}))
    assert done.returncode == 1
    assert done.stdout.count("ERROR") == 1 and f"{package}/wrong.py:" in done.stdout and f"[{kind}]" in done.stdout


def test_right_types_pass(tmp_path: Path) -> None:
    done = gate(project(tmp_path, {}))
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_checker_that_fails_is_no_pass(tmp_path: Path) -> None:
    project(tmp_path, {})
    (tmp_path / "pyproject.toml").write_text('[tool.pyrefly]\nproject-includes = ["nothing_here"]\n')
    done = gate(tmp_path)
    assert done.returncode != 0


@pytest.mark.parametrize(
    ("comment", "is_explained"),
    [
        ("# pyrefly: ignore[bad-assignment]  # because", True),
        ("# pyrefly: ignore[bad-assignment]", False),
        ("# pyrefly: ignore  # because", False),
        ("# type: ignore", False),
        ("# type: ignore[assignment]  # because", False),
    ],
)
def test_an_ignore_names_a_kind_and_a_reason(comment: str, is_explained: bool, tmp_path: Path) -> None:
    done = gate(project(tmp_path, {"bench/ignored.py": f'x: int = "a"  {comment}\n'}))
    line = "check_types: bench/ignored.py:1 must be written as `# pyrefly: ignore[KIND]  # REASON`\n"
    assert done.returncode == (0 if is_explained else 1)
    assert (line in done.stderr) == (not is_explained)


def test_packages_of_others_may_ignore_what_they_like(tmp_path: Path) -> None:
    assert gate(project(tmp_path, {"bench/.peers/other.py": "x = 1  # type: ignore\n"})).returncode == 0


def test_an_ignore_of_a_whole_file_is_refused(tmp_path: Path) -> None:
    done = gate(project(tmp_path, {"bench/ignored.py": '# pyrefly: ignore-errors\nx: int = "a"\n'}))
    assert done.returncode == 1 and "bench/ignored.py:1 must be written" in done.stderr


def test_make_check_runs_the_gate() -> None:
    done = run(REPOSITORY, "make", "--dry-run", "check")
    assert done.returncode == 0, done.stderr
    assert ".venv/bin/python .ci/check_types.py" in done.stdout.splitlines()
