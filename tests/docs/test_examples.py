"""The examples run and draw what they promise."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from PIL import Image

from tests.helpers import REPOSITORY


def test_catapult_draws_the_best_throw_and_the_map(tmp_path: Path) -> None:
    picture = tmp_path / "throw.png"
    command = [sys.executable, str(REPOSITORY / "docs/examples/catapult.py"), "--to", str(picture), "--per-axis", "6"]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "36 variations" in done.stdout
    for path in (picture, tmp_path / "throw_map.png"):
        with Image.open(path) as image:
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 5  # something is drawn


def test_rover_drives_and_its_lidar_sees_the_ground(tmp_path: Path) -> None:
    picture = tmp_path / "rover.png"
    command = [sys.executable, str(REPOSITORY / "docs/examples/rover.py"), "--to", str(picture)]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "rays meet something" in done.stdout
    with Image.open(picture) as image:
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 5
