"""TorchRL wraps the environments, in a virtual environment of its own: torch is no dependency of this package."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

PACKAGES = ["torch~=2.15.0", "torchrl~=0.14.1"]
VENV = REPOSITORY / ".cache" / f"torchrl-{sys.version_info.major}.{sys.version_info.minor}"
INSTALL_S = 1200  # gigabytes: torch for Linux comes with CUDA
PLAY_S = 600


def run(*command: str | Path, timeout: float, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        list(map(str, command)), env=os.environ | variables, capture_output=True, text=True, timeout=timeout
    )


@pytest.fixture(scope="module")
def python() -> Path:
    """The interpreter of an environment with TorchRL and the packages of this one. Skips if it cannot be installed."""
    python, stamp = VENV / "bin" / "python", VENV / "installed"
    if not stamp.exists() or stamp.read_text() != " ".join(PACKAGES):
        made = run(sys.executable, "-m", "venv", "--clear", VENV, timeout=INSTALL_S)
        assert made.returncode == 0, made.stderr
        installed = run(python, "-m", "pip", "install", "--retries=0", "--timeout=60", *PACKAGES, timeout=INSTALL_S)
        if installed.returncode != 0:
            pytest.skip(f"TorchRL cannot be installed: {installed.stderr.strip().splitlines()[-1]}")
        ours = sysconfig.get_path("purelib")
        theirs = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", timeout=60).stdout.strip()
        Path(theirs, "packages_of_the_project.pth").write_text(ours + "\n")  # after its own
        stamp.write_text(" ".join(PACKAGES))
    return python


@pytest.mark.slow
def test_specs_of_single_worlds_and_vectors_hold(python: Path):
    played = run(python, REPOSITORY / "tests/env/torchrl_program.py", timeout=PLAY_S, PYTHONPATH=str(REPOSITORY))
    assert played.returncode == 0, played.stderr[-4000:]
    assert played.stdout.strip().endswith("all specs hold")
