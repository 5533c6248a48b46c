"""The rasteriser: areas, positions, edges and errors of pictures of worlds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, ImageSequence
from PIL.GifImagePlugin import GifImageFile

from jax2d import Capacity, SceneBuilder
from jax2d.builder_options import BodyKeywords
from jax2d.display_list import belt_arrows, shape_colours
from jax2d.draw import draw
from jax2d.images import film_strip, write_gif, write_png
from jax2d.palette import BACKGROUND, ROLE_PALETTE
from tests.telemetry.worlds import CAPACITY, START, rectangle, scene

GREY = ROLE_PALETTE[0]


def world(**active: bool):
    """A scene with one grey shape: `polygon=True`, a 1 x 0.5 m rectangle, or a circle of 0.35 m radius."""
    base = scene()
    shape = 2 if active.get("polygon") else CAPACITY.polygons
    only = np.arange(CAPACITY.shapes) == shape
    quiet = {"joints": {"active": np.zeros(2, bool)}, "thrusters": {"active": np.zeros(2, bool)}}
    return base.replace(shapes={"active": only}, **quiet), shape


def at(place: tuple[float, float], angle: float, shape: int) -> SimpleNamespace:
    position, angles = START.copy(), np.zeros(CAPACITY.shapes)
    position[shape], angles[shape] = place, angle
    return SimpleNamespace(position=position, angle=angles)


def painted_area(image: np.ndarray, scale: float) -> float:
    """Area that is not background, m^2; pixels at an edge count by how much they differ from the background."""
    background = np.asarray(BACKGROUND, float)
    share = np.abs(image - background).sum(-1) / np.abs(np.asarray(GREY) * 0.6 - background).sum()
    return float(np.clip(share, 0, 1).astype(bool).sum()) / scale**2


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0, -1.3])
def test_a_rectangle_covers_its_area_at_any_angle(angle: float) -> None:
    one, shape = world(polygon=True)
    image = draw(one, at((2.5, 2.5), angle, shape))
    # One row of half-covered pixels around the 3 m edge: at most 3 m x 0.01 m more.
    assert painted_area(image, 100) == pytest.approx(0.5, abs=0.03)


def test_a_circle_covers_its_area() -> None:
    one, shape = world()
    image = draw(one, at((2.5, 2.5), 0.0, shape))
    assert painted_area(image, 100) == pytest.approx(np.pi * 0.35**2, abs=2 * np.pi * 0.35 * 0.01)


def test_a_shape_turns_counter_clockwise_and_y_is_up() -> None:
    one, shape = world(polygon=True)
    image = draw(one, at((1.0, 4.0), np.pi / 2, shape), view=(0, 0, 5, 5))
    rows, columns = np.nonzero((image != BACKGROUND).any(-1))
    assert (rows.min() + rows.max()) / 2 == pytest.approx(100, abs=1)  # y = 4 of 5 m
    assert (columns.min() + columns.max()) / 2 == pytest.approx(100, abs=1)
    assert rows.max() - rows.min() == pytest.approx(100, abs=2)  # 1 m wide, now upright
    assert columns.max() - columns.min() == pytest.approx(50, abs=2)
    triangle = one.replace(
        shapes={
            "vertices": one.shapes.vertices.copy(),
            "num_vertices": np.where(np.arange(5) == 2, 3, one.shapes.num_vertices),
        }
    )
    triangle.shapes.vertices[2] = [[0, 0], [1, 0], [0, 1], [0, 1]]
    image = draw(triangle, at((2.0, 2.0), np.pi / 6, shape), view=(0, 0, 5, 5))
    # (0.2, 0.05) lies inside; turned by 30 degrees counter-clockwise it is (0.148, 0.143).
    assert tuple(image[500 - 214, 214]) == GREY
    assert tuple(image[500 - 186, 214]) == BACKGROUND  # its mirror image below the corner


def test_shapes_outside_of_the_view_or_not_finite_are_left_out() -> None:
    one, shape = world(polygon=True)
    for place in ((50.0, 2.0), (np.nan, 1.0), (1e30, 0.0)):
        assert (draw(one, at(place, 0.0, shape)) == BACKGROUND).all()


def test_a_batch_of_worlds_is_refused() -> None:
    with pytest.raises(ValueError, match="one world"):
        draw(scene(), SimpleNamespace(position=START[None], angle=np.zeros((1, CAPACITY.shapes))))


def test_a_role_without_colour_is_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.\.3"):
        draw(scene(), at((1, 1), 0.0, 1), np.full(CAPACITY.shapes, 4))


def test_png_keeps_every_pixel(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 11, 3)).astype(np.uint8)
    write_png(tmp_path / "a.png", image)
    with Image.open(tmp_path / "a.png") as png:
        assert png.format == "PNG"
        np.testing.assert_array_equal(np.asarray(png), image)
    with pytest.raises(ValueError, match="float64"):
        write_png(tmp_path / "b.png", image / 255.0)


def test_gif_shows_every_picture_for_its_time(tmp_path: Path) -> None:
    images = [np.full((8, 12, 3), (40 * k, 0, 200), np.uint8) for k in range(5)]
    write_gif(tmp_path / "a.gif", images, seconds=[1 / 30] * 4 + [1.0])
    with Image.open(tmp_path / "a.gif") as gif:
        assert isinstance(gif, GifImageFile) and gif.n_frames == 5
        durations = []
        for k, frame in enumerate(ImageSequence.Iterator(gif)):
            durations.append(frame.info["duration"])
            np.testing.assert_array_equal(np.asarray(frame.convert("RGB")), images[k])
    assert durations == [30, 40, 30, 30, 1000]  # ms; four frames end 3 ms from 4/30 s
    with pytest.raises(ValueError, match="one duration a picture"):
        write_gif(tmp_path / "b.gif", images, seconds=[1.0])


def test_a_strip_lays_pictures_out_in_rows() -> None:
    images = [np.full((20, 60, 3), 40 * k, np.uint8) for k in range(5)]
    strip = film_strip(images, ["0.5 s"] * 5, columns=3)
    assert {int(value) for value in np.unique(strip)} >= {0, 40, 80, 120, 160}
    assert strip.shape[0] < strip.shape[1]
    with pytest.raises(ValueError, match="captions"):
        film_strip(images, ["0.5 s"])


def test_rectangles_of_the_test_world_are_counter_clockwise() -> None:
    corners = np.array(rectangle(2, 1))
    following = np.roll(corners, -1, axis=0)
    assert (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum() / 2 == pytest.approx(2.0)


def test_belts_have_arrows_where_they_go_and_kinematic_shapes_a_shade_of_their_own():
    capacity = Capacity(polygons=3, circles=1, joints=0, thrusters=0, extended_shapes=True)
    b = SceneBuilder(capacity)
    states: list[BodyKeywords] = [{}, {"kinematic": True}, {"fixed": True}]
    shades = [b.add_box(width=1, height=0.4, **state) for state in states]
    belt = b.add_circle(radius=0.5, fixed=True, surface_speed=-2.0)
    scene = b.build().scene
    free, kinematic, fixed = shape_colours(scene)[shades, 0]
    assert free > kinematic > fixed
    for arrow in belt_arrows(scene, belt):
        tip, *base = arrow
        ahead = tip - np.mean(base, axis=0)
        middle = arrow.mean(0)
        assert middle[0] * ahead[1] - middle[1] * ahead[0] > 0  # counter-clockwise: the speed is negative
        assert np.linalg.norm(arrow, axis=1).max() < 0.5
