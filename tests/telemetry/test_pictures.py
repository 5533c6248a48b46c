"""Pictures of a rollout: what is where has the colour of its role."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from PIL.GifImagePlugin import GifImageFile

from jax2d.palette import FIXED_SHADE, ROLE_PALETTE, THRUSTER_PALETTE
from jax2d.rasteriser import DEFAULT_VIEW
from kinetix_dist.level.level import Role
from kinetix_dist.telemetry.pictures import moment_picture, rollout_picture, write_rollout_gif, write_rollout_picture
from tests.telemetry.worlds import GREY_TRIANGLE, falling_rollout


def pixel(image: np.ndarray, x: float, y: float, scale: float = 100.0) -> tuple[int, ...]:
    """Colour at a place of the world, m."""
    row, column = (DEFAULT_VIEW[3] - y) * scale, (x - DEFAULT_VIEW[0]) * scale
    return tuple(int(value) for value in image[int(row), int(column)])


def test_shapes_have_the_colours_of_their_roles() -> None:
    image = moment_picture(falling_rollout(20), 0)
    assert pixel(image, 1.0, 3.1) == ROLE_PALETTE[Role.GREEN]
    assert pixel(image, 3.0, 2.0) == ROLE_PALETTE[Role.BLUE]
    assert pixel(image, 4.2, 1.5) == ROLE_PALETTE[Role.NONE]
    assert pixel(image, 2.0, 0.8) == tuple(int(c * FIXED_SHADE) for c in ROLE_PALETTE[Role.RED])  # fixed: darker
    assert pixel(image, 2.5, 0.1) == tuple(int(c * FIXED_SHADE) for c in ROLE_PALETTE[Role.NONE])  # the floor


def test_a_falling_body_is_drawn_where_it_has_fallen() -> None:
    rollout = falling_rollout(15)
    fallen = 9.81 * 0.5**2 / 2  # after 15 steps of 1/30 s
    grey = ROLE_PALETTE[Role.NONE]
    assert pixel(moment_picture(rollout, 15), 4.2, 1.5 - fallen) == grey
    assert pixel(moment_picture(rollout, 15), 4.2, 1.5) != grey
    assert rollout.position[15, GREY_TRIANGLE, 1] == pytest.approx(1.5 - fallen, abs=1e-5)


def test_a_flame_is_drawn_in_the_step_that_fired() -> None:
    rollout = falling_rollout(20)  # fires in odd steps; state k shows step k - 1
    below_nozzle = (1.045, 2.68)
    assert pixel(moment_picture(rollout, 2), *below_nozzle) == THRUSTER_PALETTE[0]
    assert pixel(moment_picture(rollout, 3), *below_nozzle) != THRUSTER_PALETTE[0]


def test_the_picture_file_is_a_png_of_all_moments(tmp_path: Path) -> None:
    rollout = falling_rollout(20)
    write_rollout_picture(tmp_path / "a.png", rollout, num_moments=3)
    with Image.open(io.BytesIO((tmp_path / "a.png").read_bytes())) as png:
        assert png.format == "PNG"
        np.testing.assert_array_equal(np.asarray(png), rollout_picture(rollout, num_moments=3))


def test_a_short_rollout_shows_no_moment_twice() -> None:
    one, five = rollout_picture(falling_rollout(0)), rollout_picture(falling_rollout(20), num_moments=5)
    assert five.shape[1] == pytest.approx(5 * one.shape[1], rel=0.05)


def test_a_gif_plays_the_rollout_in_real_time(tmp_path: Path) -> None:
    rollout = falling_rollout(20)  # steps of 1/30 s
    write_rollout_gif(tmp_path / "a.gif", rollout, pixels_per_metre=20.0)
    with Image.open(tmp_path / "a.gif") as gif:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(gif)]
        assert isinstance(gif, GifImageFile) and gif.n_frames == 11  # every second state
    assert sum(durations[:-1]) == pytest.approx(1000 * 20 / 30, abs=5)
    assert durations[-1] == 1000
