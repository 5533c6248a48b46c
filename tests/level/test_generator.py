"""Random levels: properties that every one of hundreds must have, and frequencies of what is drawn by chance."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import JointKind
from jax2d.checks import check_scene
from jax2d.scene import Capacity
from kinetix_dist.level.generator import (
    GeneratorConfig,
    generate_filtered,
    generate_level,
    generate_levels,
    keep_unsolved,
)
from kinetix_dist.level.level import NUM_WALLS, SIZES, Level, Role
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.walls import empty_level

NUM_LEVELS = 512


@functools.cache
def levels_of(size: str) -> Level:
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(1), NUM_LEVELS, SIZES[size], GeneratorConfig()))


@pytest.fixture(params=list(SIZES), scope="module")
def size(request: pytest.FixtureRequest) -> str:
    return request.param


def test_every_level_has_one_green_one_blue_and_at_most_one_red(size: str) -> None:
    levels = levels_of(size)
    for role, most in ((Role.GREEN, 1), (Role.BLUE, 1), (Role.RED, 1)):
        count = (levels.scene.shapes.active & (levels.shape_role == role)).sum(axis=1)
        assert count.max() <= most
        if role != Role.RED:
            assert count.min() == 1


def test_every_level_has_something_to_control(size: str) -> None:
    scene = levels_of(size).scene
    motors = scene.joints.active & scene.joints.motor_on & ~scene.joints.is_kind(JointKind.FIXED)
    assert (motors.any(axis=1) | scene.thrusters.active.any(axis=1)).all()


def test_walls_are_in_the_first_four_slots_and_never_move(size: str) -> None:
    levels, empty = levels_of(size), empty_level(SIZES[size])
    np.testing.assert_array_equal(
        levels.scene.shapes.vertices[:, :NUM_WALLS], empty.scene.shapes.vertices[None, :NUM_WALLS].repeat(NUM_LEVELS, 0)
    )
    np.testing.assert_array_equal(
        levels.position[:, :NUM_WALLS], empty.position[None, :NUM_WALLS].repeat(NUM_LEVELS, 0)
    )
    assert (levels.scene.shapes.inverse_mass[:, :NUM_WALLS] == 0).all()
    assert levels.scene.shapes.active[:, :NUM_WALLS].all()


def test_green_and_blue_are_not_both_fixed(size: str) -> None:
    levels = levels_of(size)
    moves = levels.scene.shapes.inverse_mass > 0
    either = (levels.shape_role == Role.GREEN) | (levels.shape_role == Role.BLUE)
    assert (moves & either & levels.scene.shapes.active).any(axis=1).all()


def test_everything_moves_in_size_s() -> None:
    levels = levels_of("s")
    assert (levels.scene.shapes.inverse_mass[:, NUM_WALLS:] > 0)[levels.scene.shapes.active[:, NUM_WALLS:]].all()


def test_anchors_of_a_joint_meet_in_the_world(size: str) -> None:
    levels = levels_of(size)
    scene = levels.scene
    rows = np.arange(NUM_LEVELS)[:, None]

    def world(body: np.ndarray, anchor: np.ndarray) -> np.ndarray:
        angle = levels.angle[rows, body]
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = anchor[..., 0], anchor[..., 1]
        return levels.position[rows, body] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    gap = np.linalg.norm(
        world(scene.joints.a, scene.joints.anchor_a) - world(scene.joints.b, scene.joints.anchor_b), axis=-1
    )
    assert gap[scene.joints.active].max() < 1e-5
    ends = np.stack([scene.joints.a, scene.joints.b], axis=-1)[scene.joints.active]
    assert (ends >= NUM_WALLS).all() and (ends[:, 0] != ends[:, 1]).all()
    active = scene.shapes.active[rows, scene.joints.a] & scene.shapes.active[rows, scene.joints.b]
    assert active[scene.joints.active].all()
    assert not scene.shapes.can_touch[rows, scene.joints.a, scene.joints.b][scene.joints.active].any()


def test_thrusters_sit_inside_shapes_that_move(size: str) -> None:
    levels = levels_of(size)
    scene, rows = levels.scene, np.arange(NUM_LEVELS)[:, None]
    assert (scene.shapes.inverse_mass[rows, scene.thrusters.body] > 0)[scene.thrusters.active].all()
    assert np.linalg.norm(scene.thrusters.position, axis=-1)[scene.thrusters.active].max() < 1.0
    assert (scene.thrusters.power > 0)[scene.thrusters.active].all()


def test_limits_hold_the_starting_pose_and_powers_are_in_range(size: str) -> None:
    levels = levels_of(size)
    scene, rows = levels.scene, np.arange(NUM_LEVELS)[:, None]
    held = scene.joints.active
    bend = levels.angle[rows, scene.joints.b] - levels.angle[rows, scene.joints.a] - scene.joints.rest_angle
    np.testing.assert_allclose(bend[held], 0.0, atol=1e-5)
    limited = held & scene.joints.has_limits
    assert (scene.joints.lower_limit <= 0)[limited].all() and (scene.joints.upper_limit >= 0)[limited].all()
    config = GeneratorConfig()
    driven = held & scene.joints.is_kind(JointKind.REVOLUTE)
    for values, low, high in (
        (np.abs(scene.joints.motor_speed), config.motor_speed_min, config.motor_speed_max),
        (scene.joints.motor_power, config.motor_power_min, config.motor_power_max),
    ):
        assert values[driven].min() >= low and values[driven].max() <= high
    has_circle = (scene.joints.a >= SIZES[size].polygons) | (scene.joints.b >= SIZES[size].polygons)
    assert scene.joints.motor_power[held & has_circle].max() <= config.wheel_power_max + 1e-6


def test_every_scene_is_one_that_engines_take(size: str) -> None:
    check_scene(levels_of(size).scene, SIZES[size], np.dtype(np.float32), batch=(NUM_LEVELS,))


def test_shapes_are_finite_and_start_inside_the_box(size: str) -> None:
    levels = levels_of(size)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(levels) if leaf.dtype.kind == "f")
    free = levels.scene.shapes.active[:, NUM_WALLS:]
    inside = ((levels.position[:, NUM_WALLS:] > 0) & (levels.position[:, NUM_WALLS:] < 5)).all(axis=-1)
    assert inside[free].mean() > 0.98  # the fewest overlaps of eight proposals is not always none


def test_few_shapes_overlap_at_the_start(size: str) -> None:
    levels, capacity = levels_of(size), SIZES[size]
    scene = levels.scene

    def overlaps(level: Level) -> jax.Array:
        vertices = jnp.concatenate([level.scene.shapes.vertices, jnp.zeros((capacity.circles, capacity.vertices, 2))])
        radius = jnp.concatenate([jnp.zeros(capacity.polygons), level.scene.shapes.radius])
        corners = world_corners(level.position, level.angle, vertices)
        against = jax.vmap(separation, in_axes=(None, None, 0, 0))
        gap = jax.vmap(lambda own, r: against(own, r, corners, radius))(corners, radius)
        both = level.scene.shapes.active[:, None] & level.scene.shapes.active[None, :]
        return ((gap < 0) & both & level.scene.shapes.can_touch).sum() / 2

    mean_overlaps = np.mean(jax.jit(jax.vmap(overlaps))(levels))
    assert mean_overlaps < {"s": 0.1, "m": 0.15, "l": 0.8}[size], scene.shapes.active.sum()


def test_chances_are_those_of_the_config() -> None:
    levels = levels_of("m")
    floor = levels.shape_role[:, 0]
    # 512 draws: three standard deviations of a share p are 3 sqrt(p (1 - p) / 512)
    assert abs((floor == Role.RED).mean() - 0.08) < 0.036
    assert abs((floor == Role.BLUE).mean() - 0.02) < 0.019
    assert not (floor == Role.GREEN).any()
    scene = levels.scene
    forced_motor = (scene.joints.active & scene.joints.motor_on & ~scene.joints.is_kind(JointKind.FIXED)).any(axis=1)
    assert forced_motor.mean() > 2 / 3 - 0.07
    assert scene.thrusters.active.any(axis=1).mean() > 2 / 3 - 0.07
    green_x = levels.position[..., 0][(levels.shape_role == Role.GREEN) & scene.shapes.active]
    assert abs(green_x.mean() - 2.5) < 0.2  # swapping leaves no side to green


def test_slots_are_in_random_order() -> None:
    levels = levels_of("l")
    free_polygons = levels.scene.shapes.active[:, NUM_WALLS : SIZES["l"].polygons]
    share = free_polygons.mean(axis=0)
    assert share.max() - share.min() < 0.15
    assert (levels.scene.thrusters.active[:, 0] & ~levels.scene.thrusters.active[:, 1]).any()
    assert (levels.scene.thrusters.active[:, 1] & ~levels.scene.thrusters.active[:, 0]).any()


def test_a_level_depends_on_its_key_and_number_alone() -> None:
    few = generate_levels(jax.random.key(1), 8, SIZES["s"], GeneratorConfig())
    for leaf, other in zip(jax.tree.leaves(few), jax.tree.leaves(levels_of("s"))):
        np.testing.assert_allclose(leaf, other[:8], rtol=1e-6, atol=1e-6)
    other_key = generate_levels(jax.random.key(2), 8, SIZES["s"], GeneratorConfig())
    assert not np.allclose(few.position, other_key.position)


def test_triangles_appear_when_counts_for_and_have_their_centroid_at_the_origin() -> None:
    levels = generate_levels(jax.random.key(3), 64, SIZES["s"], GeneratorConfig(triangle_chance=1.0))
    is_free = np.asarray(levels.scene.shapes.active)[:, 4]
    assert (np.asarray(levels.scene.shapes.num_vertices)[is_free, 4] == 3).all()
    corners = np.asarray(levels.scene.shapes.vertices)[is_free, 4]
    np.testing.assert_allclose(corners[:, :3].mean(axis=1), 0.0, atol=1e-6)
    np.testing.assert_array_equal(corners[:, 3], corners[:, 2])


def test_bad_parameters_and_capacities_are_refused_with_their_numbers() -> None:
    with pytest.raises(ValueError, match=r"motor_on_chance is 1\.5; it must be from 0 to 1"):
        GeneratorConfig(motor_on_chance=1.5)
    with pytest.raises(ValueError, match="add up to more than 1"):
        GeneratorConfig(joined_shape_chance=0.7, free_shape_chance=0.7)
    with pytest.raises(ValueError, match="the generator needs room for 3 shapes"):
        generate_level(jax.random.key(0), Capacity(polygons=4, circles=4, joints=1, thrusters=1), GeneratorConfig())


def test_filtering_keeps_unsolved_levels_in_the_order_drawn() -> None:
    is_solved = jnp.array([True, False, True, False, False, True])
    levels = jax.tree.map(lambda x: x[:6], levels_of("s"))
    unsolved = keep_unsolved(levels, is_solved, 3)
    np.testing.assert_array_equal(unsolved.position, levels.position[[1, 3, 4]])
    most_solved = keep_unsolved(levels, jnp.array([True, True, True, True, False, True]), 3)
    np.testing.assert_array_equal(most_solved.position, levels.position[[4, 0, 1]])


def test_filtering_draws_twice_as_many_and_asks_which_are_solved() -> None:
    counts = []

    def every_other(levels: Level) -> jax.Array:
        counts.append(levels.position.shape[0])
        return jnp.arange(levels.position.shape[0]) % 2 == 0

    unsolved = generate_filtered(jax.random.key(1), 4, "s", GeneratorConfig(), every_other)
    assert counts == [8]
    np.testing.assert_allclose(unsolved.position, levels_of("s").position[1:8:2], rtol=1e-6, atol=1e-6)


def test_generator_config_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        GeneratorConfig().num_proposals = 3  # type: ignore[misc]
