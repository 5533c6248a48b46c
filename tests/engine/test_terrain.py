"""Terrain: what slides or rolls over joints feels none, by the formulas of a polyline; and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jax2d import Capacity, Engine, SceneBuilder, SceneError, SceneFullError
from jax2d.fidelity import Trajectory, record_worlds

pytestmark = pytest.mark.also_gpu

CAPACITY = Capacity(polygons=30, circles=1, joints=0, thrusters=0, vertices=6)
HALF, G = 0.4, 9.81  # m, half the width of what moves; m/s^2
SPEEDS = (1.0, 5.0, 10.0, 18.0)  # m/s; faster, a disc would turn at more than the limit of 50 rad/s


LOOP = [(3.87, 0.5), (3.87, 1.5), (3, 2), (2.13, 1.5), (2.13, 0.5)]


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(CAPACITY)


def line(turn: float, tiles: int = 28, first: float = 0.0) -> np.ndarray:
    """Points 1 m apart; the line turns by `turn` at each."""
    angles = first + turn * np.arange(tiles)
    return np.concatenate([[(0.0, 0.0)], np.cumsum(np.stack([np.cos(angles), np.sin(angles)], -1), 0)])


def on(points: np.ndarray, kind: str, speed: float, gravity: float, origin=(0.0, 0.0)):
    """A box or a disc that slides without friction, or a disc that rolls, from near the beginning of a terrain."""
    b = SceneBuilder(CAPACITY, gravity=(0.0, -gravity))
    mu = 1.0 if kind == "rolling disc" else 0.0
    b.add_terrain(points + np.array(origin), friction=mu)
    along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    normal = np.array([-along[1], along[0]])
    options = {"position": origin + 0.5 * along + HALF * normal, "velocity": speed * along, "friction": mu}
    if kind == "box":
        b.add_box(width=2 * HALF, height=2 * HALF, angle=math.atan2(along[1], along[0]), **options)
    else:
        spin = -speed / HALF if mu else 0.0
        b.add_circle(radius=HALF, angular_velocity=spin, **options)
    return b.build()


def moving(trajectory: Trajectory) -> int:
    return int(np.flatnonzero(trajectory.is_movable)[0])


@pytest.mark.parametrize("origin", [(0.0, 0.0), (1e4, -3e3)])
@pytest.mark.parametrize("kind", ["box", "disc", "rolling disc"])
def test_a_flat_line_of_tiles_is_one_floor(engine: Engine, kind: str, origin: tuple[float, float]):
    far = origin != (0.0, 0.0)
    for speed, m in zip(
        SPEEDS, record_worlds(engine, [on(line(0.0), kind, v, G, origin) for v in SPEEDS], seconds=1.4)
    ):
        i = moving(m)
        assert np.abs(m.velocity[:, i, 1]).max() < (0.05 if far else 5e-3)
        assert m.velocity[-1, i, 0] == pytest.approx(speed, rel=1e-3 if far else 1e-4)
        # Positions in float32 are 1 mm apart at 10 km.
        assert np.ptp(m.position[:, i, 1]) < (3e-3 if far else 2e-4)


@pytest.mark.parametrize("turn", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("kind", ["box", "disc", "rolling disc"])
def test_in_a_valley_each_joint_takes_what_the_polyline_says(engine: Engine, kind: str, turn: float):
    """Weightless, so that every speed shows the same: at a joint the part of the speed into the new face is lost, of a
    disc that rolls as much as its spin does not make up for."""
    share = math.cos(turn) if kind != "rolling disc" else (math.cos(turn) + 0.5) / 1.5
    for speed, m in zip(SPEEDS, record_worlds(engine, [on(line(turn), kind, v, 0.0) for v in SPEEDS], seconds=1.4)):
        i = moving(m)
        velocity = m.velocity[:, i]
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        joints = round(heading[-1] / turn)
        assert joints >= speed
        speed_left = np.linalg.norm(velocity[-1])
        # A box straddles a joint for a while, and turns meanwhile: it loses less.
        assert speed_left == pytest.approx(speed * share**joints, rel=0.02 if kind == "box" else 1e-3)
        if kind != "box":
            assert (np.diff(heading) > -1e-4).all()  # nothing throws it back


@pytest.mark.parametrize("kind", ["box", "disc", "rolling disc"])
@pytest.mark.parametrize("turn", [0.01, 0.02])
def test_over_a_hill_no_energy_is_lost_at_crests(engine: Engine, kind: str, turn: float):
    """Slow enough to stay on it where that can be; faster bodies fly, and come down later than the end."""
    speeds = (3.0, 6.0, 10.0)
    worlds = [on(line(-turn, first=0.0), kind, v, G) for v in speeds]
    for speed, m in zip(speeds, record_worlds(engine, worlds, seconds=1.2)):
        i = moving(m)
        kinetic = 0.5 * m.masses()[0][i] * speed**2
        energy = m.energy()
        assert energy[-1] == pytest.approx(energy[0], abs=0.03 * kinetic)
        assert energy.max() < energy[0] + 0.005 * kinetic


def test_ways_over_hills_and_valleys_are_the_same_in_both_directions(engine: Engine):
    rng = np.random.default_rng(1)
    ups = np.cumsum(rng.uniform(-0.12, 0.12, 28))
    points = np.stack([np.arange(28.0), ups - ups[0]], -1)
    mirrored = points[::-1] * [-1, 1]
    mirrored = mirrored - mirrored[0]
    for kind in ("box", "disc"):
        for way in (points, mirrored):
            (m,) = record_worlds(engine, [on(way, kind, 8.0, G)], seconds=2.0)
            i = moving(m)
            assert m.position[-1, i, 0] > 6  # nothing stops it
            gained = m.energy() - m.energy()[0]
            assert gained.max() < 0.01 * 0.5 * m.masses()[0][i] * 64


def test_tiles_are_fixed_and_what_was_asked_for():
    b = SceneBuilder(CAPACITY)
    b.add_box(width=1, height=1)
    points = [(0, 0), (2, 0), (3, 1), (4, 1), (6, 0)]
    shapes = b.add_terrain(points, thickness=0.4, friction=0.3, restitution=0.2)
    scene = b.build().scene
    assert shapes == [1, 2, 3, 4]
    assert not np.asarray(scene.shapes.inverse_mass)[shapes].any()
    np.testing.assert_allclose(scene.shapes.friction[shapes], 0.3)
    assert scene.shapes.num_vertices[shapes].tolist() == [4, 5, 6, 5]
    b.add_terrain([(0, 5), (1, 5)])  # one segment is a box
    assert b.build().scene.shapes.num_vertices[5] == 4


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(0, 0)], r"terrain has points of shape \(1, 2\); give a list of two or more"),
        ([1, 2, 3], r"points of shape \(3,\)"),
        ([(0, 0), (1, "a")], r"points of shape \(0,\)"),
        ([(0, 0), (1, math.nan)], "points hold NaN"),
        ([(0, 0), (1, 0), (1, 0), (2, 0)], "points 1 and 2 of the terrain are the same; drop one of them"),
        ([(0, 0), (2, 0), (1, 0.1)], "folds back at point 1, by 174 degrees"),
        ([(0, 0), (3, 0), *LOOP, (2.5, -1)], "crosses itself: points 0 to 1 and 6 to 7; make two terrains of it"),
        ([(0, 0), (3, 0), *LOOP, (2.3, 0)], "crosses itself: points 0 to 1 and 6 to 7"),
        ([(0, 0), (1, 0), (1.2, 0.9), (1.5, 1), (1.8, 0.9), (2, 0)], "comes out at points"),
    ],
)
def test_lines_that_make_no_ground_are_refused_and_add_nothing(points, message: str):
    b = SceneBuilder(CAPACITY)
    with pytest.raises(SceneError, match=message) as error:
        b.add_terrain(points)
    assert "\n" not in str(error.value)
    assert not b.build().scene.shapes.active.any()


@pytest.mark.parametrize(
    ("points", "thickness", "message"),
    [
        ([(0, 0), (1, 0), (1.0005, 0)], 1e-5, r"below points 1 and 2 .* an area of 5\.\d+e-09.*; give a thickness"),
        ([(0, 0), (1, 0), (1.00001, 0)], 1e-4, r"a thickness of 0\.0001 the tile below points 1 and 2 .* an area of"),
        ([(0, 0), (1, 0), (2, 0.1)], 1e9, r"a thickness of 1e\+09 the tile below points 0 and 1 .* are the same point"),
        ([(0, 0), (1, 0), (2, 0.1)], 1e-7, r"a thickness of 1e-07 the tile below points 0 and 1 .* are the same point"),
    ],
)
def test_tiles_that_make_no_polygon_are_refused_before_any_is_added(points, thickness: float, message: str):
    b = SceneBuilder(CAPACITY)
    with pytest.raises(SceneError, match=message) as error:
        b.add_terrain(points, thickness=thickness)
    assert "\n" not in str(error.value)
    assert not b.build().scene.shapes.active.any()
    assert b.add_box(width=1, height=1) == 0


def test_capacity_that_does_not_suffice_is_named():
    points = [(0, 0), (1, 0), (2, -0.2), (3, -0.6)]
    with pytest.raises(SceneFullError, match=r"terrain of 3 tiles, and 0 of 2 .* Capacity\(polygons=3\)"):
        SceneBuilder(Capacity(polygons=2, circles=0, joints=0, thrusters=0, vertices=6)).add_terrain(points)
    with pytest.raises(SceneError, match=r"tiles of 6 vertices; use Capacity\(vertices=6\)"):
        SceneBuilder(Capacity(polygons=3, circles=0, joints=0, thrusters=0)).add_terrain(points)
    with pytest.raises(SceneError, match="thickness is 0"):
        SceneBuilder(CAPACITY).add_terrain(points, thickness=0)


def test_ground_takes_the_options_of_shapes_but_stays_where_it_is():
    b = SceneBuilder(Capacity(polygons=2, circles=0, joints=0, thrusters=0, extended_shapes=True))
    shapes = b.add_terrain([(0, 0), (1, 0), (2, 0)], surface_speed=2.0, friction_coefficient=0.4)
    np.testing.assert_allclose(b.build().scene.shapes.surface_speed[shapes], 2.0)
    for option in ("position", "angle", "velocity", "kinematic"):
        with pytest.raises(SceneError, match=f"{option} of terrain, which is where its points are"):
            b.add_terrain([(0, 0), (1, 0)], **{option: 0})
