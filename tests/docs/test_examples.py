"""The examples run and draw what they promise."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from PIL import Image

from tests.helpers import REPOSITORY


def run_example(name: str, *arguments: str) -> str:
    """What it prints."""
    command = [sys.executable, str(REPOSITORY / "examples" / name), *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_drawn(*pictures: Path) -> None:
    for path in pictures:
        with Image.open(path) as image:
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 5  # something is drawn


def test_catapult_draws_the_best_throw_and_the_map(tmp_path: Path) -> None:
    picture = tmp_path / "throw.png"
    assert "36 variations" in run_example("catapult.py", "--to", str(picture), "--per-axis", "6")
    assert_drawn(picture, tmp_path / "throw_map.png")


def test_belt_lift_and_platform_carry_both_boxes_away(tmp_path: Path) -> None:
    picture = tmp_path / "platforms.png"
    assert "2 boxes ride on the platform at 0.70 m/s" in run_example("platforms.py", "--to", str(picture))
    assert_drawn(picture)


def test_rover_drives_and_its_lidar_sees_the_ground(tmp_path: Path) -> None:
    picture = tmp_path / "rover.png"
    assert "rays meet something" in run_example("rover.py", "--to", str(picture))
    assert_drawn(picture)
