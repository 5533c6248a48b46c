"""Samples of offline data that the public Kinetix package wrote of its own states, and what it reads of them.

Stored: tests/data/kinetix_offline_s, six trajectories of 48 steps, and kinetix_offline_s.npz, what the package's loader
and its observation make of them; `python -m tests.data.kinetix_sample` writes both again. Others are written where
$KINETIX_PACKAGE_PYTHON is a Python with kinetix-env 3.0.2.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import REPOSITORY
from tests.kinetix_package import VARIABLE

PROGRAM = REPOSITORY / "bench" / "peers" / "kinetix_offline.py"
STORED = REPOSITORY / "tests" / "data" / "kinetix_offline_s"
ANSWER = STORED.with_suffix(".npz")


def package(*arguments: str | Path) -> None:
    """Runs the program in the package's environment. Skips the test without the package."""
    if not (python := os.environ.get(VARIABLE)):
        pytest.skip(f"the public package is not here: set {VARIABLE} to a Python with kinetix-env 3.0.2")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHONPATH", "XLA_FLAGS", "JAX_"))
    }
    ended = subprocess.run(
        [python, str(PROGRAM), *map(str, arguments)],
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]


def write_sample(folder: Path, answer: Path, *sample: str) -> None:
    """sample: size, trajectories, steps, and "continuous" or nothing."""
    package("write", folder, *sample)
    package("read", folder, answer)


def answer_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return {name: archive[name] for name in archive.files}


if __name__ == "__main__":
    shutil.rmtree(STORED, ignore_errors=True)
    write_sample(STORED, ANSWER, "s", "6", "48")
