"""Linter, formatter and type checker see every Python file of the repository, and git ignores none of its files."""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

pytestmark = pytest.mark.skipif(
    not (REPOSITORY / ".git").exists() or shutil.which("git") is None, reason="not a git checkout"
)

BIN = Path(sysconfig.get_path("scripts"))
# Programs of peers run in environments of their own, where other packages have the names of ours.
UNTYPED = "bench/peers/"


def output(*command: str | Path) -> str:
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout


def tracked() -> set[str]:
    """Python files that git tracks and that exist, relative to the repository."""
    files = output("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.py").split("\0")
    return {file for file in files if file and (REPOSITORY / file).exists()}


def relative(lines: str) -> set[str]:
    """Python files of absolute paths, one a line."""
    paths = [Path(line.strip()) for line in lines.splitlines() if line.strip().startswith("/")]
    return {path.relative_to(REPOSITORY).as_posix() for path in paths if path.suffix == ".py"}


def test_ruff_lints_every_python_file() -> None:
    assert relative(output(BIN / "ruff", "check", "--show-files", ".")) == tracked()


def test_ruff_formats_every_python_file() -> None:
    """The formatter lists no files: it counts those that its settings do not exclude."""
    files = tracked()
    command = [BIN / "ruff", "format", "--check", "--force-exclude", *sorted(files)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    counts = re.findall(r"(\d+) files? (?:would be reformatted|already formatted)", done.stdout)
    assert sum(map(int, counts)) == len(files), done.stdout[-500:] + done.stderr


def test_pyrefly_checks_every_python_file_but_those_of_peers() -> None:
    checked = relative(output(BIN / "pyrefly", "dump-config", "--max-files", "all", "--color", "never"))
    assert checked == {file for file in tracked() if not file.startswith(UNTYPED)}


def test_git_ignores_no_file_that_it_tracks() -> None:
    """Ruff and the wheel leave out what .gitignore matches."""
    assert output("git", "ls-files", "--cached", "--ignored", "--exclude-standard") == ""


@pytest.mark.parametrize("name", ["build", "dist", "runs"])
def test_a_package_may_have_the_name_of_a_folder_of_results(name: str) -> None:
    file = f"kinetix_dist/studio/{name}/page.py"
    ignored = subprocess.run(["git", "check-ignore", "--quiet", file], cwd=REPOSITORY, check=False)
    assert ignored.returncode == 1
    assert subprocess.run(["git", "check-ignore", "--quiet", f"{name}/page.py"], cwd=REPOSITORY).returncode == 0
