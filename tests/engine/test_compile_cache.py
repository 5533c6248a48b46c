"""A process loads what another has compiled."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import PATIENCE_S, python_path

STEP = """
import jax
from jax2d import Capacity, Engine, SceneBuilder, effects_of
b = SceneBuilder(Capacity(polygons=1, circles=1, joints=0, thrusters=0))
b.add_circle(radius=0.5)
world = b.build()
engine = Engine(b.capacity, effects=effects_of(world.scene))
step = jax.jit(lambda scene, state: engine.step(scene, state, num_steps=3)[0].position)
print(step(world.scene, engine.initial_state(*world)))
"""


def compiled_files(folder: Path) -> dict[str, int]:
    """Times at which the files of the caches were written, but for the notes of when each was last read."""
    files = [file for file in folder.rglob("*") if file.is_file() and not file.name.endswith("-atime")]
    return {str(file.relative_to(folder)): file.stat().st_mtime_ns for file in files}


@pytest.mark.long
@pytest.mark.also_gpu
def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    environment = os.environ | {
        "WARP_CACHE_PATH": str(tmp_path / "warp"),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "PYTHONPATH": python_path(),
    }
    printed, written = [], []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", STEP], env=environment, capture_output=True, text=True, timeout=PATIENCE_S
        )
        assert done.returncode == 0, done.stderr
        assert "CUDA" not in done.stderr  # Warp writes a line of its own on machines without a GPU
        printed.append(done.stdout)
        written.append(compiled_files(tmp_path))
    assert any(name.startswith("warp") for name in written[0]) and any(name.startswith("jax") for name in written[0])
    assert written[1] == written[0]
    assert printed[1] == printed[0]
