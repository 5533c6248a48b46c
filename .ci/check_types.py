"""Check types: no package has an error, and each ignored error outside tests names its kind and a reason.

Run pyrefly on the project in the current directory, with the settings of its pyproject.toml.

Usage: python .ci/check_types.py        from the root of the repository
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

PACKAGES = ("jax2d", "kinetix_dist", "bench", "examples")
IGNORE = re.compile(r"#\s*(?:type|pyrefly|pyright|mypy):\s*ignore")
EXPLAINED = re.compile(r"# pyrefly: ignore ?\[[\w-]+\]  # \S")


def main() -> int:
    """Return the exit status: 1 for a type error or an ignored error without a reason, else that of pyrefly."""
    command = [sys.executable, "-m", "pyrefly", "check", "--python-interpreter-path", sys.executable]
    status = subprocess.run([*command, "--output-format", "min-text"], check=False).returncode
    unexplained = unexplained_ignores()
    for line in unexplained:
        print(f"check_types: {line}", file=sys.stderr)
    return status or int(bool(unexplained))


def unexplained_ignores() -> list[str]:
    """Return a line for each ignored error outside tests that does not name one kind of error and a reason."""
    lines = []
    files = sorted(path for package in PACKAGES for path in Path(package).rglob("*.py"))
    for path in files:
        if any(part.startswith(".") for part in path.parts):  # bench/.peers: packages of others
            continue
        for number, text in enumerate(path.read_text().splitlines(), start=1):
            if IGNORE.search(text) and not EXPLAINED.search(text):
                lines.append(f"{path}:{number} must be written as `# pyrefly: ignore[KIND]  # REASON`")
    return lines


if __name__ == "__main__":
    sys.exit(main())
