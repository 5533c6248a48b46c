"""Entity and flat observations of hand-built worlds: order of features, masks, connectivity."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.fields import empty
from jax2d.scene import Capacity, JointKind, Scene
from kinetix_dist.env.action_spaces.space import bound_colours
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.env.observations.entities import (
    JOINT_COLOUR,
    THRUSTER_COLOUR,
    DynamicObs,
    EntityObs,
    StaticObs,
    dynamic_obs,
    observe,
    static_obs,
)
from kinetix_dist.env.observations.flat import flat_size, flatten
from kinetix_dist.env.observations.observation import Moving
from kinetix_dist.level.canonical import swap_ends
from kinetix_dist.level.derive import connections
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, SIZES, Level, Role
from tests.env.worlds import BOX, DISC_1, DISC_2, MOTOR_JOINT, RADIUS_M, THRUSTER, batch, small_level


def observe_start(levels: Level, touching: np.ndarray | None = None) -> EntityObs:
    bits = jnp.zeros((*levels.angle.shape, 1), jnp.uint32) if touching is None else jnp.asarray(touching)
    return observe(static_obs(levels), dynamic_obs(moving_of(levels, bits)))


def moving_of(levels: Level, touching: jax.Array) -> Moving:
    fields = {name: getattr(levels, name) for name in ("position", "angle", "velocity", "angular_velocity")}
    return Moving(**fields, touching=touching, has_stepped=jnp.zeros(len(touching), bool))


def test_polygon_row_has_the_27_features_in_the_published_order() -> None:
    level = small_level(gravity=-9.81, velocity={BOX: (0.5, -0.25)})
    angle = np.zeros(7, np.float32)
    angle[BOX] = 0.3
    spin = np.zeros(7, np.float32)
    spin[BOX] = -5.0
    level = dataclasses.replace(level, angle=angle, angular_velocity=spin)
    row = observe_start(batch(level)).polygons[0, BOX]
    mass, inertia = 0.25, 0.25 * 0.25 / 6
    vertices = [-0.25, -0.25, 0.25, -0.25, 0.25, 0.25, -0.25, 0.25]
    expected = [
        1.0,
        1.0,
        0.5,
        -0.25,
        0.2 * np.log1p(1 / mass),
        0.2 * np.log1p(1 / inertia),
        1.0,
        np.tanh(-0.5),
        0,
        1,
        0,
        0,
    ]
    expected += [np.sin(0.3), np.cos(0.3), 0.5, 0.0, 0.0, *vertices, 0.0, -0.981]
    assert row.shape == (27,)
    np.testing.assert_allclose(row, expected, rtol=1e-6)  # float32


def test_circle_row_has_the_19_features_in_the_published_order() -> None:
    row = observe_start(batch(small_level(gravity=-9.81))).circles[0, 0]
    mass = np.pi * RADIUS_M**2
    expected = [
        3,
        1,
        0,
        0,
        0.2 * np.log1p(1 / mass),
        0.2 * np.log1p(2 / (mass * RADIUS_M**2)),
        1,
        0,
        0,
        0,
        1,
        0,
        0,
        1,
        0.5,
        0,
        RADIUS_M,
        1,
        -0.981,
    ]
    assert row.shape == (19,)
    np.testing.assert_allclose(row, expected, rtol=1e-6)


def test_triangle_has_minus_one_in_its_unused_vertex_and_the_triangle_flag() -> None:
    level = small_level()
    scene = level.scene.replace(shapes={"num_vertices": np.array([4, 4, 4, 4, 3], np.int32)})
    row = observe_start(batch(dataclasses.replace(level, scene=scene))).polygons[0, BOX]
    np.testing.assert_array_equal(row[23:26], [-1.0, -1.0, 1.0])


LIMITS = {
    "joints.has_limits": True,
    "joints.lower_limit": -0.5,
    "joints.upper_limit": 1.0,
    "joints.rest_angle": 0.2,
}


def test_a_joint_gives_two_rows_of_which_the_second_sees_it_from_its_other_end() -> None:
    obs = observe_start(batch(small_level(joint={**MOTOR_JOINT, **LIMITS})))
    power_on_and_colour = [2.0, 1, 1, 0, 0, 1, 0]
    from_a = [1, 0, 0.5, 0.1, -0.2, 0.3, np.sin(0.2), np.cos(0.2), 1.5, *power_on_and_colour]
    from_a += [np.sin(-0.5), np.cos(-0.5), np.sin(1.0), np.cos(1.0), -0.7, 0.8, 0, 0, 0]
    from_b = [1, 0, -0.2, 0.3, 0.5, 0.1, np.sin(-0.2), np.cos(0.2), -1.5, *power_on_and_colour]
    from_b += [np.sin(-1.0), np.cos(1.0), np.sin(0.5), np.cos(0.5), -0.8, 0.7, 0, 0, 0]
    assert obs.joints.shape == (1, 2, 25)
    np.testing.assert_allclose(obs.joints[0], [from_a, from_b], rtol=1e-6)
    np.testing.assert_array_equal(obs.joint_from[0], [BOX, DISC_1])
    np.testing.assert_array_equal(obs.joint_to[0], [DISC_1, BOX])


def test_a_slider_has_its_axis_in_the_frame_of_either_end_and_its_limits_in_metres() -> None:
    slider = {"joints.kind": JointKind.PRISMATIC, "joints.axis_angle": 0.7}
    obs = observe_start(batch(small_level(joint={**MOTOR_JOINT, **LIMITS, **slider})))
    motor = [1.5, 2.0, 1, 1, 0, 0, 1, 0]
    axis = 0.7 - 0.2 + np.pi  # of a against b
    from_a = [1, 0, 0.5, 0.1, -0.2, 0.3, np.sin(0.2), np.cos(0.2), *motor]
    from_a += [0, 0, 0, 0, -0.5, 1.0, 1, np.sin(0.7), np.cos(0.7)]
    from_b = [1, 0, -0.2, 0.3, 0.5, 0.1, np.sin(-0.2), np.cos(0.2), *motor]
    from_b += [0, 0, 0, 0, -0.5, 1.0, 1, np.sin(axis), np.cos(axis)]
    np.testing.assert_allclose(obs.joints[0], [from_a, from_b], rtol=1e-6)


@pytest.mark.parametrize("kind", JointKind)
def test_the_rows_of_a_joint_are_the_same_whichever_end_is_called_a(kind: JointKind) -> None:
    level = small_level(joint={**MOTOR_JOINT, **LIMITS, "joints.kind": kind, "joints.axis_angle": 0.7})
    other = dataclasses.replace(level, scene=level.scene.replace(joints=swapped(level)))
    one, two = observe_start(batch(level)), observe_start(batch(other))
    np.testing.assert_allclose(one.joints[0], two.joints[0, ::-1], atol=1e-6)  # the axis has turned round twice
    np.testing.assert_array_equal(one.joint_from, two.joint_from[:, ::-1])


def swapped(level: Level) -> dict[str, np.ndarray]:
    """Fields of a level's joints after `swap_ends`."""
    joints = swap_ends(level.scene.joints)
    return {field.name: np.asarray(getattr(joints, field.name)) for field in dataclasses.fields(joints)}


def test_motor_and_limit_features_of_a_fixed_joint_are_zero() -> None:
    joint = {**MOTOR_JOINT, "joints.kind": JointKind.FIXED, "joints.has_limits": True, "joints.upper_limit": 1.0}
    row = observe_start(batch(small_level(joint=joint))).joints[0, 0]
    np.testing.assert_array_equal(row[:2], [1, 1])
    np.testing.assert_array_equal(row[8:], np.zeros(17))


def test_features_of_limits_and_the_rest_angle_of_a_hinge_without_limits_are_zero() -> None:
    joint = {**MOTOR_JOINT, "joints.upper_limit": 1.0, "joints.rest_angle": 0.3}
    row = observe_start(batch(small_level(joint=joint))).joints[0, 0]
    np.testing.assert_array_equal(row[6:8], np.zeros(2))
    np.testing.assert_array_equal(row[16:], np.zeros(9))


def test_speed_power_and_colour_of_a_motor_that_is_off_are_zero() -> None:
    row = observe_start(batch(small_level(joint={**MOTOR_JOINT, "joints.motor_on": False}))).joints[0, 0]
    np.testing.assert_array_equal(row[8:16], np.zeros(8))


@pytest.mark.long
@pytest.mark.parametrize("observation", ["entity", "entity_kinetix"])
def test_colours_are_where_the_read_out_by_colour_looks_for_them(observation: str) -> None:
    levels = generate_levels(jax.random.key(0), 64, SIZES["s"], GeneratorConfig(thruster_chance=1.0))
    static: Any = OBSERVATIONS[observation].static(levels)
    rows: StaticObs = getattr(static, "entities", static)
    joints = levels.scene.joints
    drives = joints.active & joints.motor_on & (joints.kind == JointKind.REVOLUTE)
    motors = jax.nn.one_hot(levels.motor_colour, NUM_MOTOR_COLOURS)
    for half in np.split(np.asarray(rows.joints[..., JOINT_COLOUR]), 2, axis=1):
        np.testing.assert_array_equal(half[drives], motors[drives])
    thrusters = levels.scene.thrusters.active
    of_thrusters = jax.nn.one_hot(levels.thruster_colour, NUM_THRUSTER_COLOURS)
    np.testing.assert_array_equal(rows.thrusters[..., THRUSTER_COLOUR][thrusters], of_thrusters[thrusters])
    assert drives.sum() > 20 and thrusters.sum() > 20


@pytest.mark.long
@pytest.mark.parametrize("observation", ["entity", "flat", "pixels", "entity_kinetix"])
def test_a_motor_that_runs_by_itself_has_the_colour_of_no_action(observation: str) -> None:
    """And of the public package's observation nothing changes, which does not tell."""
    obeys = batch(small_level(joint=MOTOR_JOINT))
    runs = dataclasses.replace(obeys, motor_auto=np.ones_like(obeys.motor_auto))
    one, other = (_seen(observation, levels) for levels in (obeys, runs))
    if observation == "entity_kinetix":
        jax.tree.map(np.testing.assert_array_equal, one, other)
        return
    if observation == "entity":
        without = one.joints.at[..., JOINT_COLOUR].set(0.0)
        assert one.joints[..., JOINT_COLOUR].any()
        jax.tree.map(np.testing.assert_array_equal, other, dataclasses.replace(one, joints=without))
    else:
        differs = np.asarray(one != other)
        assert differs.any() and differs.mean() < 0.02
    assert bound_colours(obeys).any() and not bound_colours(runs)[:, :NUM_MOTOR_COLOURS].any()


def _seen(observation: str, levels: Level) -> Any:
    parts = OBSERVATIONS[observation]
    dynamic = parts.dynamic(moving_of(levels, jnp.zeros((*levels.angle.shape, 1), jnp.uint32)))
    return parts.join(parts.static(levels), dynamic)


def test_thruster_row_has_the_8_features_in_the_published_order() -> None:
    obs = observe_start(batch(small_level(thruster=THRUSTER)))
    np.testing.assert_allclose(obs.thrusters[0, 0], [1, 0.1, -0.2, 0, 1, 1, 0, 2.0], atol=1e-7)
    np.testing.assert_array_equal(obs.thruster_owner[0], [BOX])


def test_what_does_not_exist_is_zero_and_masked_everywhere() -> None:
    joint = {**MOTOR_JOINT, "joints.active": False}
    level = small_level(joint=joint, thruster={**THRUSTER, "thrusters.active": False})
    all_touch = np.full((1, 7, 1), 0x7F, np.uint32)
    garbage = dataclasses.replace(level, position=np.where(np.arange(7)[:, None] == DISC_2, np.nan, level.position))
    obs = observe_start(batch(garbage), all_touch)
    for rows in (obs.circles[0, 1], obs.joints, obs.thrusters):
        assert not rows.any()
    assert not obs.shape_mask[0, DISC_2] and not obs.joint_mask.any() and not obs.thruster_mask.any()
    assert not obs.attention_masks[0, :, DISC_2].any() and not obs.attention_masks[0, :, :, DISC_2].any()
    assert not obs.joint_from.any() and not obs.joint_to.any() and not obs.thruster_owner.any()


def test_attention_masks_are_all_then_any_joints_then_one_joint_then_touching() -> None:
    touching = np.zeros((1, 7, 1), np.uint32)
    touching[0, 0, 0], touching[0, DISC_1, 0] = 1 << DISC_1, 1 << 0
    masks = observe_start(batch(small_level(joint=MOTOR_JOINT)), touching).attention_masks[0]
    active = np.arange(7) != DISC_2
    diagonal = np.diag(active)
    jointed, touch = diagonal.copy(), diagonal.copy()
    jointed[BOX, DISC_1] = jointed[DISC_1, BOX] = True
    touch[0, DISC_1] = touch[DISC_1, 0] = True
    np.testing.assert_array_equal(masks[0], active[:, None] & active)
    np.testing.assert_array_equal(masks[1], jointed)
    np.testing.assert_array_equal(masks[2], jointed)
    np.testing.assert_array_equal(masks[3], touch)


def connected(scene: Scene) -> tuple[jax.Array, jax.Array]:
    return connections(scene.joints.a, scene.joints.b, scene.joints.active, scene.shapes.active.shape[-1])


def chain_scene(joints: list[tuple[int, int]], active: list[bool], num_shapes: int) -> Scene:
    """Scene with the fields that connectivity looks at."""
    ends = np.array(joints, np.int32)
    capacity = Capacity(polygons=num_shapes, circles=0, joints=len(joints), thrusters=0)
    return empty(Scene, capacity.sizes).replace(
        shapes={"active": jnp.ones((1, num_shapes), bool)},
        joints={"active": jnp.array([active]), "a": jnp.array([ends[:, 0]]), "b": jnp.array([ends[:, 1]])},
    )


def test_a_chain_through_all_shapes_connects_all_of_them() -> None:
    # 16 shapes in a chain of 15 joints: the longest that size L could hold if it had the joints.
    scene = chain_scene([(i, i + 1) for i in range(15)], [True] * 15, 16)
    one, any_number = jax.jit(connected)(scene)
    distance = np.abs(np.arange(16)[:, None] - np.arange(16))
    np.testing.assert_array_equal(one[0], distance <= 1)
    assert any_number.all()


def test_an_inactive_joint_cuts_a_chain() -> None:
    scene = chain_scene([(0, 1), (1, 2), (2, 3)], [True, False, True], 4)
    _, any_number = connected(scene)
    group = np.array([0, 0, 1, 1])
    np.testing.assert_array_equal(any_number[0], group[:, None] == group)


def test_connections_agree_with_a_search_on_random_graphs() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        joints = [tuple(rng.choice(9, 2, replace=False)) for _ in range(6)]
        active = list(rng.random(6) < 0.8)
        _, any_number = connected(chain_scene(joints, active, 9))
        group = np.arange(9)  # joined groups take the smaller of their names until nothing changes
        for _ in range(9):
            for (a, b), is_active in zip(joints, active):
                if is_active:
                    group[[a, b]] = min(group[a], group[b])
        np.testing.assert_array_equal(any_number[0], group[:, None] == group)


@pytest.mark.long
def test_observe_adds_a_time_axis_to_what_is_static() -> None:
    levels = batch(small_level(joint=MOTOR_JOINT), small_level(thruster=THRUSTER, box=(2.0, 2.0)))
    moving = dynamic_obs(moving_of(levels, jnp.zeros((2, 7, 1), jnp.uint32)))
    rollout = DynamicObs(bodies=jnp.stack([moving.bodies] * 3), touching=jnp.stack([moving.touching] * 3))
    once, over_time = observe(static_obs(levels), moving), observe(static_obs(levels), rollout)
    for single, repeated in zip(jax.tree.leaves(once), jax.tree.leaves(over_time)):
        np.testing.assert_array_equal(repeated, np.stack([single] * 3))


def test_roles_are_one_hot() -> None:
    level = small_level(disc_2=(4.0, 4.0), roles={BOX: Role.GREEN, DISC_1: Role.BLUE, DISC_2: Role.RED})
    obs = observe_start(batch(level))
    np.testing.assert_array_equal(obs.polygons[0, 0, 8:12], [1, 0, 0, 0])
    np.testing.assert_array_equal(obs.polygons[0, BOX, 8:12], [0, 1, 0, 0])
    np.testing.assert_array_equal(obs.circles[0, :, 8:12], [[0, 0, 1, 0], [0, 0, 0, 1]])


def test_flat_observation_is_the_concatenation() -> None:
    obs = observe_start(batch(small_level(joint=MOTOR_JOINT, thruster=THRUSTER)))
    flat = flatten(obs)
    assert flat.shape == (1, flat_size(SIZES["s"])) == (1, 5 * 27 + 2 * 19 + 25 + 8 + 3 * 7)
    np.testing.assert_array_equal(flat[0, : 5 * 27], obs.polygons.reshape(-1))
    ends = flat[0, -21:].reshape(3, 7)
    np.testing.assert_array_equal(ends.argmax(axis=1), [BOX, DISC_1, BOX])


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_dynamic_observation_is_as_small_as_documented(size: str) -> None:
    capacity = SIZES[size]
    assert (28 + 4 * capacity.touch_words) * capacity.shapes == {"s": 224, "m": 288, "l": 512}[size]
