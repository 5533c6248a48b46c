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


def project(directory: Path, files: dict[str, str], allowances: str = "") -> Path:
    """Return a directory with the project's settings of pyrefly, the gate, these files and these allowances."""
    for name in ("pyproject.toml", ".ci/check_types.py"):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, directory / name)
    for name, text in {"jax2d/right.py": RIGHT, **files, ".ci/type_allowance.toml": allowances}.items():
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


def git(directory: Path, *arguments: str) -> None:
    identity = ("-c", "user.name=tests", "-c", "user.email=tests@localhost", "-c", "commit.gpgsign=false")
    done = run(directory, "git", *identity, *arguments)
    assert done.returncode == 0, done.stderr


def commit(directory: Path) -> None:
    git(directory, "add", "--all")
    git(directory, "commit", "--quiet", "--message", "A commit")


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
    assert done.stdout.count("\n") == 1 and f"{package}/wrong.py:" in done.stdout and f"[{kind}]" in done.stdout
    assert done.stderr == f"check_types: {package} has 1 type error, and may have none; fix the new ones\n"


def test_right_types_and_as_many_errors_as_allowed_pass(tmp_path: Path) -> None:
    done = gate(project(tmp_path, {"tests/engine/wrong.py": WRONG["bad-return"]}, '"tests/engine" = 1\n'))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_more_errors_than_allowed_fail(tmp_path: Path) -> None:
    files = {f"tests/engine/wrong_{number}.py": WRONG["bad-return"] for number in range(2)}
    done = gate(project(tmp_path, files, '"tests/engine" = 1\n'))
    assert done.returncode == 1 and done.stdout.count("[bad-return]") == 2
    assert done.stderr == "check_types: tests/engine has 2 type errors, and may have 1; fix the new ones\n"


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="other versions of Python do not check this")
@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        (1, "tests/engine has 1 type error; lower its allowance of 2 to 1 in .ci/type_allowance.toml"),
        (0, "tests/engine has no type errors; remove its allowance in .ci/type_allowance.toml"),
    ],
)
def test_an_allowance_that_is_too_high_fails(wrong: int, line: str, tmp_path: Path) -> None:
    files = {f"tests/engine/wrong_{number}.py": WRONG["bad-return"] for number in range(wrong)}
    done = gate(project(tmp_path, files, '"tests/engine" = 2\n'))
    assert (done.returncode, done.stderr) == (1, f"check_types: {line}\n")


def test_an_allowance_cannot_grow_with_the_errors(tmp_path: Path) -> None:
    project(tmp_path, {"tests/engine/wrong.py": WRONG["bad-return"]}, '"tests/engine" = 1\n')
    git(tmp_path, "init", "--quiet")
    commit(tmp_path)
    assert gate(tmp_path).returncode == 0

    more = {f"tests/{name}/wrong_too.py": WRONG["bad-assignment"] for name in ("engine", "level")}
    project(tmp_path, more, '"tests/engine" = 2\n"tests/level" = 1\n')
    lines = [
        "check_types: the allowance of tests/engine grew from 1 to 2; fix the new errors instead",
        "check_types: the allowance of tests/level grew from 0 to 1; fix the new errors instead",
    ]
    assert gate(tmp_path).stderr.splitlines() == lines
    commit(tmp_path)
    done = gate(tmp_path)
    assert (done.returncode, done.stderr.splitlines()) == (1, lines), "a commit hid the growth"


@pytest.mark.parametrize(
    ("allowances", "problem"),
    [
        ("jax2d = 3\n", "jax2d may have no allowance"),
        ('"tests/engine" = 0\n', "tests/engine must be an integer of 1 or more"),
        ('"tests/engine" = true\n', "tests/engine must be an integer of 1 or more"),
        ("tests/engine = 3\n", "is no TOML"),
    ],
)
def test_a_wrong_table_of_allowances_is_refused_in_one_line(allowances: str, problem: str, tmp_path: Path) -> None:
    done = gate(project(tmp_path, {}, allowances))
    assert done.returncode == 2 and problem in done.stderr and done.stderr.count("\n") == 1


def test_a_checker_that_fails_is_no_pass(tmp_path: Path) -> None:
    project(tmp_path, {})
    (tmp_path / "pyproject.toml").write_text('[tool.pyrefly]\nproject-includes = ["nothing_here"]\n')
    done = gate(tmp_path)
    assert done.returncode == 2 and "pyrefly ended with status" in done.stderr


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
    assert (done.returncode, done.stderr) == ((0, "") if is_explained else (1, line))


def test_packages_of_others_may_ignore_what_they_like(tmp_path: Path) -> None:
    assert gate(project(tmp_path, {"bench/.peers/other.py": "x = 1  # type: ignore\n"})).returncode == 0


def test_an_ignore_of_a_whole_file_is_refused(tmp_path: Path) -> None:
    done = gate(project(tmp_path, {"bench/ignored.py": '# pyrefly: ignore-errors\nx: int = "a"\n'}))
    assert done.returncode == 1 and "bench/ignored.py:1 must be written" in done.stderr


def test_make_check_runs_the_gate() -> None:
    done = run(REPOSITORY, "make", "--dry-run", "check")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == ".venv/bin/python .ci/check_types.py"
