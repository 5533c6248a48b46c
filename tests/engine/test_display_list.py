"""Display lists: pictures are as before there were any, poses and thrust are all that changes, JSON says all."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jax2d import palette
from jax2d.display_list import DISC, LINE, POLYGON, RAIL, SPRING, DisplayList, Primitive, display_list, world_points
from jax2d.draw import draw
from jax2d.images import film_strip
from jax2d.rasteriser import rasterise
from tests.engine import drawn_worlds
from tests.helpers import present

PICTURES = Path(__file__).parent / "pictures"


def stored(name: str) -> np.ndarray:
    """A picture painted by the code that had no display list (commit a157544)."""
    with Image.open(PICTURES / name) as image:
        return np.asarray(image)


def assert_same_picture(found: np.ndarray, expected: np.ndarray) -> None:
    """Equal but for one level in a few values: sine and cosine of another processor may differ in the last bit."""
    difference = np.abs(found.astype(int) - expected)
    assert difference.max() <= 1
    assert np.count_nonzero(difference) <= 1e-5 * difference.size


def of_everything(**changes: Any) -> DisplayList:
    world = drawn_worlds.everything() | changes
    names = ("motor_colours", "thruster_colours")
    return display_list(world["scene"], world["roles"], **{name: world[name] for name in names})


def test_pictures_are_those_from_before() -> None:
    assert_same_picture(draw(**drawn_worlds.everything()), stored("everything.png"))
    levels = drawn_worlds.levels()
    strip = film_strip([draw(**level) for level in levels.values()], list(levels), columns=4)
    assert_same_picture(strip, stored("levels.png"))


def test_a_list_of_one_pose_paints_all_poses() -> None:
    world = drawn_worlds.everything()
    display, draws = of_everything(), np.random.default_rng(0)
    for _ in range(3):
        position = np.asarray(world["state"].position, float) + draws.normal(0, 0.3, world["state"].position.shape)
        angle, thrust = draws.uniform(-3, 3, len(position)), draws.uniform(0, 1, 2)
        moved = world | {"state": SimpleNamespace(position=position, angle=angle), "thrust": thrust, "trails": ()}
        options = {name: moved[name] for name in ("view", "pixels_per_metre", "thrust")}
        np.testing.assert_array_equal(rasterise(display, position, angle, **options), draw(**moved))


def test_all_kinds_are_there_and_shapes_come_first() -> None:
    display = of_everything()
    assert {primitive.kind for primitive in display.primitives} == {POLYGON, DISC, LINE, RAIL, SPRING}
    parts = [primitive.part[0] for primitive in display.primitives]
    assert parts == sorted(parts, key=["shape", "thruster", "spring", "joint"].index)


def test_points_move_with_their_body() -> None:
    corner = Primitive(kind=POLYGON, part=("shape", 0), body=0, points=np.array([[1.0, 0.0]]), fill=(0, 0, 0))
    position, angle = np.array([[2.0, 3.0], [5.0, 5.0]]), np.array([np.pi / 2, 0.0])
    np.testing.assert_allclose(present(world_points(corner, position, angle)), [[2.0, 4.0]], atol=1e-12)
    cross = Primitive(
        kind=LINE,
        part=("joint", 0),
        body=0,
        points=np.array([[0.1, 0.1]]),
        upright=np.array([1.0, 0.0]),
        fill=(0, 0, 0),
    )
    np.testing.assert_allclose(present(world_points(cross, position, angle)), [[2.1, 4.1]], atol=1e-12)


def test_a_flame_is_as_long_as_its_thrust() -> None:
    flame = next(p for p in of_everything().primitives if p.thruster == 0)
    body, base = np.zeros((10, 2)), np.asarray(flame.scale_from)
    lengths = []
    for thrust in (1.0, 0.5):
        points = world_points(flame, body, np.zeros(10), [thrust, 0.0])
        assert points is not None
        lengths.append(np.linalg.norm(points - base, axis=1).max())
    assert lengths[0] == pytest.approx(palette.FLAME_SHARE * palette.THRUSTER_LENGTH_M)
    assert lengths[1] == pytest.approx(lengths[0] / 2)
    assert world_points(flame, body, np.zeros(10), [0.0, 1.0]) is None
    assert world_points(flame, body, np.zeros(10)) is None


def test_a_rail_without_ends_follows_the_other_body() -> None:
    rail = next(p for p in of_everything().primitives if p.kind == RAIL)
    world = drawn_worlds.everything()["state"]
    position, angle = np.asarray(world.position, float).copy(), np.asarray(world.angle, float)
    before = world_points(rail, position, angle)
    position[rail.other] += [0.7, 0.2]
    after = world_points(rail, position, angle)
    assert before is not None and after is not None
    np.testing.assert_allclose(after - before, [[0.7, 0.0]] * 2, atol=1e-6)  # along its axis only
    assert np.linalg.norm(after[1] - after[0]) == pytest.approx(2 * palette.RAIL_M)


def test_json_says_all_that_a_picture_takes() -> None:
    display = of_everything()
    document = json.loads(json.dumps(display.to_json(), allow_nan=False))
    assert document["num_shapes"] == display.num_shapes
    arrays = ("points", "upright", "scale_from", "other_point")
    read = []
    for entry in document["primitives"]:
        values: dict[str, Any] = {name: np.array(value) if name in arrays else value for name, value in entry.items()}
        read.append(Primitive(**values | {"part": tuple(entry["part"])}))
    world = drawn_worlds.everything()
    again = rasterise(
        DisplayList(num_shapes=display.num_shapes, primitives=tuple(read)),
        np.asarray(world["state"].position, float),
        np.asarray(world["state"].angle, float),
        **{name: world[name] for name in ("thrust", "view", "pixels_per_metre", "trails")},
    )
    assert_same_picture(again, stored("everything.png"))


def test_the_palette_is_json() -> None:
    document = json.loads(json.dumps(palette.as_json(), allow_nan=False))
    assert document["role_palette"][1] == list(palette.ROLE_PALETTE[1])
    assert document["joint_radius_m"] == palette.JOINT_RADIUS_M
    assert all(name == name.lower() for name in document)
