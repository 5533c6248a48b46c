"""Versions that the lock pins: of JAX, none that is known to compute wrong results or to be slow."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.helpers import PATIENCE_S, REPOSITORY

BAD_JAX = {
    "0.10.2": "wrong sums on CPUs, jax-ml/jax#39103",
    "0.11.1": "scans on CPUs copy whole arrays at every step, jax-ml/jax#40101",
}


def test_neither_range_nor_lock_has_a_jax_that_computes_wrong_or_slowly() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    jax = next(r for r in map(Requirement, project["dependencies"]) if r.name == "jax")
    locked = re.findall(r"^jax(?:lib)?==([\d.]+)", (REPOSITORY / "requirements.lock").read_text(), re.MULTILINE)
    assert len(locked) >= 4  # jax and jaxlib, for Python 3.11 and for later ones
    for version, why in BAD_JAX.items():
        assert not jax.specifier.contains(version), why
        assert version not in locked, why
    assert all(jax.specifier.contains(version) for version in locked)


@pytest.mark.parametrize(
    ("found", "chosen"),
    [
        (("python3.11", "python3.12", "python3.13"), "python3.12"),
        (("python3.11", "python3.13"), "python3.13"),
        (("python3.11", "python3"), "python3.11"),
    ],
)
def test_installation_takes_the_best_supported_python_that_works(
    tmp_path: Path, found: tuple[str, ...], chosen: str
) -> None:
    for name in found:
        _interpreter(tmp_path / name, works=True)
    assert chosen in _install(tmp_path)


def test_installation_passes_over_a_python_that_does_not_start(tmp_path: Path) -> None:
    _interpreter(tmp_path / "python3.12", works=False)  # as pyenv leaves for a version that is not chosen
    _interpreter(tmp_path / "python3.11", works=True)
    assert "python3.11" in _install(tmp_path)


def _interpreter(path: Path, *, works: bool) -> None:
    """An executable that passes for a supported Python, names itself, and makes no environment."""
    lines = {True: f'case "$1" in -c) exit 0;; --version) echo {path.name};; *) exit 7;; esac', False: "exit 127"}
    path.write_text(f"#!/bin/sh\n{lines[works]}\n")
    path.chmod(0o755)


def _install(path: Path) -> str:
    """The line by which `.ci/install` says which Python it took; that one then refuses to make an environment."""
    done = subprocess.run(
        ["/bin/bash", ".ci/install", str(path / "venv")],
        cwd=REPOSITORY,
        env={"PATH": str(path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1, done
    return done.stdout
