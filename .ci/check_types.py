"""Check types: packages have no error, and each package of tests at most its allowance, which can only shrink.

Run pyrefly on the project in the current directory, with the settings of its pyproject.toml. The allowances are in
`.ci/type_allowance.toml`. The check fails if a package has more errors than it may have, if it has fewer (lower the
allowance then), and if an allowance is higher than in the last commit or in the one before. Only Python 3.11 checks for
fewer errors: with other versions, the lock has other versions of NumPy and JAX, whose types differ a little.

Usage: python .ci/check_types.py        from the root of the repository
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

ALLOWANCES = Path(".ci/type_allowance.toml")
PACKAGE_OF_TESTS = re.compile(r"tests/\w+")
# A shallow clone has no parent, and an unpacked release has no history: both skip the comparison with earlier commits.
EARLIER_COMMITS = ("HEAD", "HEAD^")
CHECKED_WHOLLY = ("jax2d", "kinetix_dist", "bench", "examples")
IGNORE = re.compile(r"#\s*(?:type|pyrefly|pyright|mypy):\s*ignore")
EXPLAINED = re.compile(r"# pyrefly: ignore ?\[[\w-]+\]  # \S")
COUNTED_WITH = (3, 11)  # version of Python with which an allowance must be exact


class TypeCheckError(Exception):
    """The check cannot be made."""


class Message(TypedDict):
    """An error of pyrefly's JSON output, with the parts that are read here."""

    path: str
    line: int
    column: int
    name: str
    description: str


def main() -> int:
    try:
        allowances = read_allowances(ALLOWANCES.read_text())
        errors = by_package(run_pyrefly())
    except (TypeCheckError, OSError) as error:
        print(f"check_types: {error}", file=sys.stderr)
        return 2
    failures = list(excesses(errors, allowances))
    failures += unexplained_ignores()
    failures += growth(
        allowances, [earlier for commit in EARLIER_COMMITS if (earlier := committed(commit)) is not None]
    )
    for failure in failures:
        print(f"check_types: {failure}", file=sys.stderr)
    return 1 if failures else 0


def read_allowances(text: str) -> dict[str, int]:
    """Return the number of errors that each package of tests may have."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TypeCheckError(f"{ALLOWANCES} is no TOML: {error}") from None
    for package, number in table.items():
        if not PACKAGE_OF_TESTS.fullmatch(package):
            raise TypeCheckError(f"{ALLOWANCES}: {package} may have no allowance, only a package of tests (tests/NAME)")
        if type(number) is not int or number < 1:
            raise TypeCheckError(f"{ALLOWANCES}: {package} must be an integer of 1 or more (none: remove its line)")
    return table


def run_pyrefly() -> list[Message]:
    """Return the errors of the project in the current directory."""
    command = [sys.executable, "-m", "pyrefly", "check", "--python-interpreter-path", sys.executable]
    done = subprocess.run([*command, "--output-format", "json"], capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1) or not done.stdout:
        raise TypeCheckError(f"pyrefly ended with status {done.returncode}: {done.stderr.strip()}")
    errors: list[Message] = json.loads(done.stdout)["errors"]
    if bool(errors) != bool(done.returncode):
        raise TypeCheckError(f"pyrefly ended with status {done.returncode} and reports {len(errors)} errors")
    return errors


def by_package(errors: Sequence[Message]) -> dict[str, list[Message]]:
    """Group errors by "jax2d", "bench", ..., and "tests/NAME"; files directly in tests/ belong to "tests"."""
    groups = defaultdict(list)
    for error in errors:
        top, *rest = Path(error["path"]).parts
        groups[f"tests/{rest[0]}" if top == "tests" and len(rest) > 1 else top].append(error)
    return groups


def excesses(errors: Mapping[str, Sequence[Message]], allowances: Mapping[str, int]) -> list[str]:
    """Print the messages of packages with too many errors; return a line for each package whose count is wrong."""
    lines = []
    for package in sorted({*errors, *allowances}):
        number, allowed = len(errors.get(package, ())), allowances.get(package, 0)
        if number > allowed:
            for error in errors[package]:
                print(f"{error['path']}:{error['line']}:{error['column']}: {error['description']} [{error['name']}]")
            lines.append(f"{package} has {counted(number)}, and may have {allowed or 'none'}; fix the new ones")
        elif number < allowed and sys.version_info[:2] == COUNTED_WITH:
            remedy = f"lower its allowance of {allowed} to {number}" if number else "remove its allowance"
            lines.append(f"{package} has {counted(number)}; {remedy} in {ALLOWANCES}")
    return lines


def counted(number: int) -> str:
    return f"{number or 'no'} type error{'' if number == 1 else 's'}"


def unexplained_ignores() -> list[str]:
    """Return a line for each ignore outside tests that does not name one kind of error and a reason."""
    lines = []
    files = sorted(path for package in CHECKED_WHOLLY for path in Path(package).rglob("*.py"))
    for path in files:
        if any(part.startswith(".") for part in path.parts):  # bench/.peers: packages of others
            continue
        for number, text in enumerate(path.read_text().splitlines(), start=1):
            if IGNORE.search(text) and not EXPLAINED.search(text):
                lines.append(f"{path}:{number} must be written as `# pyrefly: ignore[KIND]  # REASON`")
    return lines


def growth(allowances: Mapping[str, int], earlier: Sequence[Mapping[str, int]]) -> list[str]:
    """Return a line for each allowance that is higher than in one of the earlier tables."""
    lines = []
    for package, number in sorted(allowances.items()):
        before = min((table.get(package, 0) for table in earlier), default=number)
        if number > before:
            lines.append(f"the allowance of {package} grew from {before} to {number}; fix the new errors instead")
    return lines


def committed(commit: str) -> dict[str, int] | None:
    """Return the allowances of a commit; None if it, the file in it or git is missing."""
    try:
        done = subprocess.run(
            ["git", "show", f"{commit}:./{ALLOWANCES.as_posix()}"], capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return None
    return read_allowances(done.stdout) if done.returncode == 0 else None


if __name__ == "__main__":
    sys.exit(main())
