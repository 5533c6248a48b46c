"""Rays and points against an oracle of its own: edges crossed one by one in float64, discs by the quadratic formula."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, SceneBuilder, cast_rays, index_worlds, point_in_shapes, stack_worlds
from tests.engine.oracle import corners_of, faces

pytestmark = pytest.mark.also_gpu

CAPACITY = Capacity(polygons=5, circles=4, joints=0, thrusters=0, vertices=6)
WORLDS, RAYS = 12, 64


class Place(NamedTuple):
    """Positions and angles of shapes: all that a query needs of a state."""

    position: Any
    angle: Any


def place(built) -> Place:
    return Place(built.position, built.angle)


def random_world(rng: np.random.Generator, middle: float, slots: int = 5):
    """Shapes of 3 to 6 corners and discs, in any pose, some in each other; the last slots stay empty."""
    b = SceneBuilder(CAPACITY)
    for _ in range(slots - 1):
        turns = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        if np.diff(np.append(turns, turns[0] + 2 * np.pi)).max() > 0.9 * np.pi or np.diff(turns).min() < 0.1:
            turns = np.arange(5) * 2 * np.pi / 5
        corners = rng.uniform(0.2, 1.5) * np.stack([np.cos(turns), np.sin(turns)], -1)
        b.add_polygon(corners, position=middle + rng.uniform(-4, 4, 2), angle=rng.uniform(-9, 9))
    for _ in range(CAPACITY.circles - 1):
        b.add_circle(radius=rng.uniform(0.05, 1.0), position=middle + rng.uniform(-4, 4, 2))
    return b.build()


@pytest.fixture(scope="module", params=[0.0, 1e4], ids=["at the origin", "10 km away"])
def cast(request):
    rng = np.random.default_rng(7)
    worlds = [random_world(rng, request.param) for _ in range(WORLDS)]
    scene, state = stack_worlds([w.scene for w in worlds]), stack_worlds([place(w) for w in worlds])
    origins = (request.param + rng.uniform(-5, 5, (WORLDS, RAYS, 2))).astype(np.float32)
    ends = (request.param + rng.uniform(-5, 5, (WORLDS, RAYS, 2))).astype(np.float32)
    return worlds, scene, state, origins, ends - origins


def oracle(world, origin, way, ignore=()):
    """(distance m, shape, normal) of what a ray meets first, float64; (length, -1, 0) if nothing."""
    origin, way = np.asarray(origin, np.float64), np.asarray(way, np.float64)
    length = float(np.hypot(*way))
    best = (length, -1, np.zeros(2))
    for shape in np.flatnonzero(world.scene.shapes.active).tolist():
        if shape in ignore:
            continue
        centre = np.asarray(world.position[shape], np.float64)
        if shape < CAPACITY.polygons:
            corners = corners_of(world, shape, centre, float(world.angle[shape]))
            normals, _ = faces(corners)
            if (((origin - corners) * normals).sum(1) < 0).all():
                continue  # it begins inside
            for normal, start, end in zip(normals, corners, np.roll(corners, -1, 0)):
                matrix = np.stack([way, start - end], 1)
                if abs(np.linalg.det(matrix)) < 1e-14:
                    continue
                along, beside = np.linalg.solve(matrix, start - origin)
                if 0 <= along <= 1 and 0 <= beside <= 1 and along * length < best[0]:
                    best = (along * length, shape, normal)
        else:
            radius = float(world.scene.shapes.radius[shape - CAPACITY.polygons])
            away = origin - centre
            roots = np.roots([way @ way, 2 * away @ way, away @ away - radius**2])
            if away @ away < radius**2 or np.iscomplex(roots).any():
                continue
            along = float(roots.real.min())
            if 0 <= along <= 1 and along * length < best[0]:
                best = (along * length, shape, (away + along * way) / radius)
    return best


def test_rays_meet_what_the_oracle_says(cast):
    worlds, scene, state, origins, ways = cast
    hits = jax.tree.map(np.asarray, cast_rays(scene, state, origins, ways))
    compared = 0
    for w, world in enumerate(worlds):
        for r in range(RAYS):
            origin, way = origins[w, r].astype(np.float64), ways[w, r].astype(np.float64)
            distance, shape, normal = oracle(world, origin, way)
            aside = 1e-5 * np.array([-way[1], way[0]]) / np.hypot(*way)
            if {oracle(world, origin + side, way)[1] for side in (aside, -aside)} != {shape}:
                continue  # it passes a corner within float32's rounding
            compared += 1
            assert hits.shape[w, r] == shape
            assert hits.hit[w, r] == (shape >= 0)
            # Directions and normals in float32, at grazing angles divided by their sine.
            tolerance = 3e-6 / max(0.02, abs(normal @ way) / np.hypot(*way)) if shape >= 0 else 3e-6
            assert hits.distance[w, r] == pytest.approx(distance, abs=tolerance)
            np.testing.assert_allclose(hits.normal[w, r], normal, atol=1e-3 if shape >= CAPACITY.polygons else 1e-5)
    assert compared > 0.97 * WORLDS * RAYS
    assert 0.3 < hits.hit.mean() < 0.95
    assert not hits.invalid.any()
    np.testing.assert_allclose(hits.fraction, hits.distance / np.linalg.norm(ways, axis=-1), rtol=1e-5)
    expected = origins + hits.fraction[..., None] * ways
    np.testing.assert_allclose(hits.point, expected, rtol=2e-7, atol=1e-5)


def test_points_are_in_the_shapes_that_the_oracle_says(cast):
    worlds, scene, state, points, _ = cast
    inside = np.asarray(point_in_shapes(scene, state, points))
    for w, world in enumerate(worlds):
        for shape in range(CAPACITY.shapes):
            if not world.scene.shapes.active[shape]:
                assert not inside[w, :, shape].any()
                continue
            centre = world.position[shape].astype(np.float64)
            if shape < CAPACITY.polygons:
                normals, starts = faces(corners_of(world, shape, centre, float(world.angle[shape])))
                depth = -((points[w].astype(np.float64)[:, None] - starts) * normals).sum(-1).max(1)
            else:
                radius = float(world.scene.shapes.radius[shape - CAPACITY.polygons])
                depth = radius - np.linalg.norm(points[w].astype(np.float64) - centre, axis=-1)
            clear = np.abs(depth) > 1e-5
            np.testing.assert_array_equal(inside[w, clear, shape], depth[clear] > 0)
    assert inside.any()


def test_a_world_alone_in_jit_and_under_vmap_gets_the_same_bits(cast):
    _, scene, state, origins, ways = cast
    batch = cast_rays(scene, state, origins, ways)
    for w in (0, 5, WORLDS - 1):
        single = cast_rays(*index_worlds((scene, state, origins, ways), w))
        jax.tree.map(np.testing.assert_array_equal, single, index_worlds(batch, w))
        few = cast_rays(*index_worlds((scene, state, origins[:, 3:10], ways[:, 3:10]), w))
        jax.tree.map(lambda x, y, w=w: np.testing.assert_array_equal(x, y[w, 3:10]), few, batch)
    mapped = jax.jit(jax.vmap(cast_rays))(scene, state, origins, ways)
    jax.tree.map(np.testing.assert_array_equal, mapped, batch)


# By hand


def box_and_disc():
    b = SceneBuilder(CAPACITY)
    box = b.add_box(width=2, height=1, position=(3, 0))
    disc = b.add_circle(radius=0.5, position=(6, 0))
    world = b.build()
    return world.scene, place(world), box, disc


def one_ray(origin, way, **options):
    scene, state, *_ = box_and_disc()
    return jax.tree.map(lambda x: np.asarray(x)[0], cast_rays(scene, state, [origin], [way], **options))


def test_a_ray_meets_the_nearest_face():
    hit = one_ray((0, 0.25), (8, 0))
    assert (hit.shape, hit.hit) == (0, True)
    assert hit.distance == pytest.approx(2.0)
    assert hit.fraction == pytest.approx(0.25)
    assert hit.point == pytest.approx([2, 0.25])
    assert hit.normal == pytest.approx([-1, 0])


def test_a_ray_that_begins_inside_sees_what_lies_behind():
    scene, _, _, disc = box_and_disc()
    hit = one_ray((3, 0), (8, 0))
    assert hit.shape == disc and hit.distance == pytest.approx(2.5)
    assert scene.shapes.active[disc]
    hit = one_ray((6, 0), (8, 0))
    assert not hit.hit and hit.shape == -1
    assert (hit.fraction, hit.distance) == (1, 8)
    assert hit.point == pytest.approx([14, 0]) and hit.normal == pytest.approx([0, 0])


def test_rays_pass_what_they_ignore():
    n = CAPACITY.shapes
    scene, state, box, disc = box_and_disc()
    assert one_ray((0, 0), (8, 0), ignore=np.arange(n) == box).shape == disc
    each = np.stack([np.arange(n) == box, np.arange(n) == disc])
    hits = cast_rays(scene, state, [(0, 0), (0, 0)], [(8, 0), (8, 0)], ignore=each)
    assert np.asarray(hits.shape).tolist() == [disc, box]
    batch = stack_worlds([scene, scene]), stack_worlds([state, state])
    rays = np.zeros((2, 1, 2)), np.full((2, 1, 2), (8.0, 0.0))
    hits = cast_rays(*batch, *rays, ignore=each[:, None])
    assert np.asarray(hits.shape)[:, 0].tolist() == [disc, box]


@pytest.mark.parametrize("miss", [1e-4, -1e-4])
def test_rays_that_graze_a_corner_or_a_disc_meet_it_or_pass_it(miss):
    up = np.array([0, 1.0])
    assert one_ray((0, 0.5 - miss), (4.9, 0)).hit == (miss > 0)  # the top of the box
    assert one_ray((5, 0.5 - miss), (8, 0)).hit == (miss > 0)  # the top of the disc
    corner, slope = np.array([2, 0.5]), np.array([1, 1]) / math.sqrt(2)
    aside = np.array([1, -1]) / math.sqrt(2)
    assert one_ray(corner + aside * miss - slope, 2 * slope).hit == (miss > 0)
    assert one_ray((2 + miss, 2) - 0 * up, (0, -4)).hit == (miss > 0)


def test_rays_of_any_length_are_rays():
    for length in (1e-6, 1e-30, 1e30):
        hit = one_ray((1.9999999 if length < 1 else 0, 0), (length, 0))
        assert not hit.invalid and hit.hit == (length > 1e-10)


# Wrong input


def test_no_rays_are_refused_in_one_line_and_marked_inside_jit():
    scene, state, *_ = box_and_disc()
    origins, ways = np.zeros((3, 2)), np.array([[8.0, 0], [0, 0], [np.nan, 1]])
    with pytest.raises(ValueError, match=r"ray 1 goes from \[0.0, 0.0\] by \[0.0, 0.0\]; a ray has") as error:
        cast_rays(scene, state, origins, ways)
    assert "\n" not in str(error.value)
    hits = jax.jit(cast_rays)(scene, state, origins, ways)
    assert np.asarray(hits.invalid).tolist() == [False, True, True]
    assert np.asarray(hits.hit).tolist() == [True, False, False]
    assert np.asarray(hits.shape).tolist() == [0, -1, -1]
    for x in jax.tree.leaves(hits):
        assert np.isfinite(np.asarray(x, float)).all()


def test_a_point_that_is_not_finite_is_in_no_shape():
    scene, state, _, disc = box_and_disc()
    points = [(x, y) for x in (6, np.nan, np.inf, -np.inf) for y in (0, np.nan, np.inf)]
    inside = np.asarray(point_in_shapes(scene, state, points))
    assert np.argwhere(inside).tolist() == [[0, disc]]
    batch = stack_worlds([scene, scene]), stack_worlds([state, state])
    np.testing.assert_array_equal(point_in_shapes(*batch, np.stack([points, points])), np.stack([inside, inside]))


def test_what_is_no_state_or_no_points_is_named():
    scene, state, *_ = box_and_disc()
    rays: Any = np.zeros((3, 2)), np.ones((3, 2))
    nothing: Any = None
    with pytest.raises(TypeError, match=r"^state is of type NoneType, without position; give a State of the scene$"):
        cast_rays(scene, nothing, *rays)
    with pytest.raises(TypeError, match=r"^translations is None; give points in metres"):
        cast_rays(scene, state, rays[0], nothing)
    with pytest.raises(TypeError, match=r"^points is None"):
        point_in_shapes(scene, state, nothing)
    with pytest.raises(ValueError, match=r"^points has complex numbers"):
        point_in_shapes(scene, state, rays[0] + 1j)


def test_wrong_shapes_are_named():
    scene, state, *_ = box_and_disc()
    rays = np.zeros((3, 2)), np.ones((3, 2))
    with pytest.raises(ValueError, match=r"origins have shape \(2,\); worlds of this scene need \[R, 2\]"):
        cast_rays(scene, state, (0, 0), (1, 1))
    with pytest.raises(ValueError, match="give as many of both"):
        cast_rays(scene, state, rays[0], rays[1][:2])
    with pytest.raises(ValueError, match=r"ignore is float64 of shape \(9,\)|ignore is float32 of shape \(9,\)"):
        cast_rays(scene, state, *rays, ignore=np.zeros(9))
    with pytest.raises(ValueError, match=r"ignore is bool of shape \(4,\)"):
        cast_rays(scene, state, *rays, ignore=np.zeros(4, bool))
    with pytest.raises(ValueError, match=r"state.position has shape"):
        cast_rays(stack_worlds([scene, scene]), state, *rays)
    with pytest.raises(TypeError, match="scene is of type"):
        cast_rays(state, state, *rays)  # type: ignore[arg-type]


def test_gradient_of_a_distance_is_that_of_the_way_to_the_face():
    scene, state, *_ = box_and_disc()

    def distance(x):
        return cast_rays(scene, state, jnp.array([[x, 0.1]]), jnp.array([[8.0, 0.0]])).distance[0]

    assert jax.grad(distance)(0.5) == pytest.approx(-1.0)


def test_a_ray_without_length_is_refused_under_grad_as_elsewhere():
    scene, state, *_ = box_and_disc()

    def distance(way):
        return cast_rays(scene, state, jnp.zeros((1, 2)), way[None]).distance[0]

    for transformed in (jax.grad(distance), lambda way: jax.jvp(distance, (way,), (way,))):
        with pytest.raises(ValueError, match=r"ray 0 goes from \[0.0, 0.0\] by \[0.0, 0.0\]; a ray has"):
            transformed(jnp.zeros(2))
