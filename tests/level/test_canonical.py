"""One form of levels: who made a level, and what its corners, ends and slots were called, is not to be seen in it."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.engine import Engine
from jax2d.scene import Capacity, Controls, JointDrive, JointKind, Joints, capacity_of, stack_worlds
from kinetix_dist.env.observations.entities import EntityObs, dynamic_obs, observe, static_obs
from kinetix_dist.env.observations.observation import Moving
from kinetix_dist.level.canonical import canonical, canonical_corners, swap_ends, turned_colours
from kinetix_dist.level.derive import derive
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.generator import GeneratorConfig, generate_levels
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import level_as_written, level_from_json, level_to_json, turned_colours_of
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.walls import WALL_NAMES, empty_level
from tests.level.one_level_four_ways import BOX, by_file, by_generator, by_hand, by_public_file
from tests.slots import shuffled_slots, take_slots

NUM_LEVELS = 24  # of the generator, each relabelled once


def observe_start(levels: Level) -> EntityObs:
    """Observations of a batch at the start."""
    n = levels.angle.shape[1]
    untouched = jnp.zeros((levels.angle.shape[0], n, (n + 31) // 32), jnp.uint32)
    fields = {name: getattr(levels, name) for name in ("position", "angle", "velocity", "angular_velocity")}
    return observe(
        static_obs(levels),
        dynamic_obs(Moving(**fields, touching=untouched, has_stepped=jnp.zeros(len(untouched), bool))),
    )


def fixed(level: Level) -> np.ndarray:
    return np.asarray(level.scene.shapes.active) & (np.asarray(level.scene.shapes.inverse_mass) == 0)


# Corners and ends


def test_a_box_begins_at_its_upper_right_corner_whichever_corner_was_first() -> None:
    box = np.array([[1, 0.5], [-1, 0.5], [-1, -0.5], [1, -0.5]], np.float32)
    for first in range(4):
        np.testing.assert_array_equal(canonical_corners(np.roll(box, first, axis=0), jnp.array(4)), box)


def test_a_corner_at_angle_zero_comes_first_on_either_side_of_the_seam() -> None:
    for noise in (-3e-8, 0.0, 3e-8):
        diamond = np.array([[1, noise], [0, 1], [-1, 0], [0, -1]], np.float32)
        for first in range(4):
            got = canonical_corners(np.roll(diamond, first, axis=0), jnp.array(4))
            np.testing.assert_array_equal(got, diamond)


def test_corners_are_counted_about_the_centroid_and_unused_slots_repeat_the_last() -> None:
    triangle = np.array(
        [[5.6, 3.4], [5.0, 3.4], [5.6, 3.0]], np.float32
    )  # from 45, 180 and 270 degrees of its centroid
    for first in range(3):
        turned = np.roll(triangle, first, axis=0)
        padded = np.concatenate([turned, turned[-1:]])
        np.testing.assert_array_equal(
            canonical_corners(padded, jnp.array(3)), np.concatenate([triangle, triangle[-1:]])
        )


def test_walls_are_in_canonical_form() -> None:
    level = empty_level(SIZES["s"])
    found = canonical(level, np.asarray(level.scene.shapes.active))
    np.testing.assert_array_equal(found.scene.shapes.vertices, level.scene.shapes.vertices)


@pytest.mark.parametrize("kind", JointKind)
def test_a_joint_with_swapped_ends_moves_as_before(kind: JointKind) -> None:
    # A heavy and a light bar, turned, off the ground; the motor drives them against a limit.
    document = {
        "format": "kinetix-dist-level",
        "version": 1,
        "name": "bars",
        "size": "m",
        "shapes": [
            {"id": "a", "type": "box", "width": 0.8, "height": 0.3, "position": [2, 3], "angle": 0.4, "role": "green"},
            {"id": "b", "type": "box", "width": 0.5, "height": 0.2, "position": [2.3, 3.2], "angle": -0.9},
            {"id": "goal", "type": "circle", "radius": 0.1, "position": [4.5, 0.6], "role": "blue"},
        ],
        "joints": [{"type": "revolute", "a": "a", "b": "b", "anchor": [2.1, 3.1], "motor": {"speed": 1.0}}],
    }
    level = level_from_json(document)
    values = {"kind": np.full(2, kind, np.int32), "axis_angle": np.full(2, 0.5, np.float32)}
    limits = {"has_limits": np.array([True, False]), "upper_limit": np.full(2, 0.3, np.float32)}
    scene = level.scene.replace(joints={**values, **limits})
    other = scene.replace(joints={field.name: getattr(swap_ends(scene.joints), field.name) for field in JOINT_FIELDS})
    np.testing.assert_array_equal(other.joints.a[:1], scene.joints.b[:1])
    scenes = jax.tree.map(np.asarray, stack_worlds([scene, other]))
    position, angle = np.stack([level.position] * 2), np.stack([level.angle] * 2)
    engine = Engine(capacity_of(level.scene))
    state = engine.initial_state(scenes, position, angle)
    controls = Controls(motor=np.ones((2, 2), np.float32), thruster=np.zeros((2, 2), np.float32))
    after, _ = engine.step(scenes, state, controls, num_steps=30)
    moved = np.abs(np.asarray(after.position - position))[0, BOX : BOX + 2].max()
    assert moved > 0.5  # they fell
    if kind != JointKind.FIXED:
        speed = np.asarray(after.angular_velocity)[0]
        gap = np.asarray(after.angle - angle)[0]
        assert np.abs(gap[BOX + 1] - gap[BOX]) > 0.2 or kind == JointKind.PRISMATIC
        assert np.isfinite(speed).all()
    # float32: half a second of a soft joint solved from its other end
    np.testing.assert_allclose(after.position[0], after.position[1], atol=2e-5)
    np.testing.assert_allclose(after.angle[0], after.angle[1], atol=5e-5)


JOINT_FIELDS = dataclasses.fields(Joints)


# Makers


@pytest.mark.parametrize("kind", JointKind)
def test_a_level_is_seen_alike_whoever_made_it(kind: JointKind) -> None:
    makers: list[Callable[[JointKind], Level]] = [by_generator, by_file, by_hand]
    if kind != JointKind.PRISMATIC:  # public files have none
        makers.append(by_public_file)
    levels = [make(kind) for make in makers]
    assert all(level.scene.joints.active.sum() == 2 and level.scene.thrusters.active.sum() == 1 for level in levels)
    seen = [jax.tree.map(np.asarray, observe_start(stack_worlds([level]))) for level in levels]
    for maker, other in zip(makers[1:], seen[1:]):
        for field in dataclasses.fields(EntityObs):
            # float32: anchors and centroids are computed from other numbers by each maker
            np.testing.assert_allclose(
                getattr(seen[0], field.name), getattr(other, field.name), atol=2e-6, err_msg=f"{maker} {field.name}"
            )


# Wheels


def vehicle(*motors: dict[str, Any], second: str = "circle") -> dict[str, Any]:
    """A bar with a wheel for each motor, the last of which may be a box instead, slide or be fixed."""
    wheels = [
        {"id": f"wheel_{k}", "type": "circle", "radius": 0.2, "position": [1.5 + 0.9 * k, 0.6]}
        for k in range(len(motors))
    ]
    if second == "box":
        wheels[-1] = {"id": wheels[-1]["id"], "type": "box", "width": 0.6, "height": 0.1, "position": [2.4, 0.9]}
    if second == "hub":
        wheels[-1]["fixed"] = True
    joints: list[dict[str, Any]] = [
        {"type": "revolute", "a": "bar", "b": wheel["id"], "anchor": wheel["position"], "motor": motor}
        for wheel, motor in zip(wheels, motors, strict=True)
    ]
    if second == "slider":
        joints[-1] |= {"type": "prismatic", "axis": 0.3}
    return {
        "format": "kinetix-dist-level",
        "version": 1,
        "name": "vehicle",
        "size": "m",
        "shapes": [
            {"id": "bar", "type": "box", "width": 1.4, "height": 0.14, "position": [2.0, 0.75], "role": "green"},
            *wheels,
            {"id": "goal", "type": "circle", "radius": 0.3, "position": [4.5, 0.75], "role": "blue", "fixed": True},
        ],
        "joints": joints,
    }


def motor(speed: float, colour: int = 0, **more: Any) -> dict[str, Any]:
    return {"speed": speed, "power": 1.0, "colour": colour} | more


@pytest.mark.parametrize(
    ("motors", "second", "speeds", "turned"),
    [
        ([motor(-1.0)], "circle", [1.0], [0]),
        ([motor(1.5)], "circle", [1.5], []),
        ([motor(-1.0), motor(-2.0)], "circle", [1.0, 2.0], [0]),
        ([motor(-1.0), motor(-2.0, 3)], "circle", [1.0, 2.0], [0, 3]),
        ([motor(-1.0), motor(2.0)], "circle", [-1.0, 2.0], []),  # gears: no exchange is possible
        ([motor(-1.0), motor(2.0, 1)], "circle", [1.0, 2.0], [0]),
        ([motor(-1.0, auto=True)], "circle", [-1.0], []),  # obeys no action
        ([motor(-1.0), motor(-2.0, auto=True)], "circle", [1.0, -2.0], [0]),
        ([motor(-1.0), motor(2.0)], "box", [1.0, -2.0], [0]),  # all motors of the colour with its wheels
        ([motor(1.0), motor(-2.0)], "box", [1.0, -2.0], []),
        ([motor(1.0), motor(-2.0, 2)], "box", [1.0, -2.0], []),  # a hinge of polygons has either sign at random too
        ([motor(0.0), motor(-1.0)], "circle", [0.0, -1.0], []),
        ([motor(1.0), motor(-2.0)], "slider", [1.0, -2.0], []),  # a circle that slides is no wheel
        ([motor(-1.0), motor(2.0)], "hub", [1.0, -2.0], [0]),  # nor is one that stays where it is
        ([motor(1.0), motor(-2.0, 1)], "hub", [1.0, -2.0], []),
    ],
)
def test_wheels_of_a_colour_have_positive_speeds(
    motors: list[dict[str, Any]], second: str, speeds: list[float], turned: list[int]
) -> None:
    document = vehicle(*motors, second=second)
    level = level_from_json(document)
    np.testing.assert_array_equal(level.scene.joints.motor_speed[: len(speeds)], np.asarray(speeds, np.float32))
    np.testing.assert_array_equal(np.flatnonzero(turned_colours_of(document)), turned)


def test_a_wheel_that_a_file_calls_a_is_one_too() -> None:
    document = vehicle(motor(1.0))
    document["joints"][0] |= {"a": "wheel_0", "b": "bar"}  # the bar against the wheel
    np.testing.assert_array_equal(np.flatnonzero(turned_colours_of(document)), [0])
    np.testing.assert_array_equal(level_from_json(document).scene.joints.motor_speed[0], np.float32(1.0))
    document["joints"][0]["motor"]["speed"] = -1.0
    assert not turned_colours_of(document).any()
    np.testing.assert_array_equal(level_from_json(document).scene.joints.motor_speed[0], np.float32(1.0))


def test_a_colour_with_a_motor_of_another_drive_is_left_alone() -> None:
    """Forward and backward of a servo do not follow from a sign."""
    level = level_from_json(vehicle(motor(1.0), motor(2.0)))
    backward = level.scene.replace(joints={"motor_speed": -level.scene.joints.motor_speed})
    assert turned_colours(dataclasses.replace(level, scene=backward), fixed(level)).any()
    drives = np.array([JointDrive.VELOCITY, JointDrive.SERVO], np.int32)
    with_servo = dataclasses.replace(level, scene=backward.replace(joints={"drive": drives}))
    assert not turned_colours(with_servo, fixed(level)).any()


def test_a_level_as_it_was_written_has_the_signs_of_the_file() -> None:
    document = vehicle(motor(-1.0), motor(-2.0, 3))
    np.testing.assert_array_equal(
        level_as_written(document).scene.joints.motor_speed[:2], np.array([-1.0, -2.0], np.float32)
    )
    document = vehicle(motor(1.0), motor(-2.0), second="box")
    np.testing.assert_array_equal(
        level_as_written(document).scene.joints.motor_speed[:2], np.array([1.0, -2.0], np.float32)
    )


def test_a_level_that_is_turned_round_is_driven_by_the_other_actions_bit_for_bit() -> None:
    """Played on the engine: forward of the file is backward of the level; number by number it is the level
    whose file has positive speeds."""
    given, positive = vehicle(motor(-1.0), motor(-2.0, 1)), vehicle(motor(1.0), motor(2.0, 1))
    level, other = level_from_json(given), level_from_json(positive)
    for leaf, same in zip(jax.tree.leaves(level), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(leaf, same)
    as_written = level.scene.replace(joints={"motor_speed": -level.scene.joints.motor_speed})
    scenes = jax.tree.map(np.asarray, stack_worlds([level.scene, as_written]))
    engine = Engine(capacity_of(level.scene))
    state = engine.initial_state(scenes, np.stack([level.position] * 2), np.stack([level.angle] * 2))
    motors = np.array([[-1.0, -1.0], [1.0, 1.0]], np.float32)
    controls = Controls(motor=motors, thruster=np.zeros((2, 2), np.float32))
    after, _ = engine.step(scenes, state, controls, num_steps=30)
    assert np.abs(np.asarray(after.position)[0, BOX, 0] - level.position[BOX, 0]) > 0.2  # it drives
    np.testing.assert_array_equal(after.position[0], after.position[1])
    np.testing.assert_array_equal(after.angle[0], after.angle[1])


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_wheels_of_random_levels_and_of_designed_ones_have_one_sign(size: str) -> None:
    designed, _ = load_level_set(f"all_designed_{size}", size)
    for levels in (designed, stack_worlds(levels_of(size))):
        joints, polygons = levels.scene.joints, SIZES[size].polygons
        is_wheel = joints.active & joints.motor_on & (joints.a < polygons) & (joints.b >= polygons)
        is_wheel &= np.take_along_axis(np.asarray(levels.scene.shapes.inverse_mass), np.asarray(joints.b), axis=1) > 0
        assert is_wheel.sum() > 2 and (joints.motor_speed[is_wheel & ~levels.motor_auto] > 0).all()


# Relabelling


@functools.cache
def levels_of(size: str) -> list[Level]:
    batch = jax.tree.map(
        np.asarray, generate_levels(jax.random.key(7), NUM_LEVELS, SIZES[size], GeneratorConfig(triangle_chance=0.3))
    )
    return [jax.tree.map(lambda x, i=i: x[i], batch) for i in range(NUM_LEVELS)]


def relabelled(level: Level, rng: np.random.Generator) -> Level:
    """Another first corner of each polygon, and some joints with their ends swapped."""
    shapes, joints = level.scene.shapes, level.scene.joints
    vertices = np.copy(shapes.vertices)
    for slot in np.flatnonzero(shapes.active[: len(vertices)]):
        count = shapes.num_vertices[slot]
        turned = np.roll(vertices[slot, :count], rng.integers(count), axis=0)
        vertices[slot] = np.concatenate([turned, np.repeat(turned[-1:], vertices.shape[1] - count, axis=0)])
    is_swapped = joints.active & (rng.random(joints.active.shape) < 0.5)
    swapped = jax.tree.map(
        lambda new, old: np.where(is_swapped.reshape(is_swapped.shape + (1,) * (old.ndim - 1)), new, old),
        swap_ends(joints),
        joints,
    )
    return dataclasses.replace(level, scene=level.scene.replace(shapes={"vertices": vertices}, joints=swapped))


derived = jax.jit(lambda level: derive(level, level.scene.shapes.inverse_mass == 0))


@pytest.mark.parametrize("size", SIZES)
def test_no_bit_depends_on_first_corners_and_ends(size: str) -> None:
    rng = np.random.default_rng(0)
    num_changed = 0
    for level in levels_of(size):
        other = relabelled(level, rng)
        num_changed += not np.array_equal(other.scene.shapes.vertices, level.scene.shapes.vertices)
        num_changed += not np.array_equal(other.scene.joints.a, level.scene.joints.a)
        # All that observations and physics are computed from.
        for leaf, again in zip(jax.tree.leaves(derived(level)), jax.tree.leaves(derived(other)), strict=True):
            np.testing.assert_array_equal(leaf, again)
    assert num_changed > NUM_LEVELS


@pytest.mark.parametrize("size", SIZES)
def test_levels_of_the_generator_are_canonical_as_they_come(size: str) -> None:
    again = jax.jit(canonical)
    for level in levels_of(size):
        for leaf, other in zip(jax.tree.leaves(level), jax.tree.leaves(again(level, fixed(level))), strict=True):
            np.testing.assert_array_equal(leaf, other)


def permuted(level: Level, rng: np.random.Generator) -> tuple[Level, np.ndarray]:
    """The level with its slots in another order, walls excepted, and the old slot of each new shape."""
    order = shuffled_slots(capacity_of(level.scene), rng)
    return jax.tree.map(np.asarray, derived(take_slots(level, order))), order["n"]


def rows_with_shapes(obs: EntityObs, ends: tuple[np.ndarray, ...], rows: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Active rows of joints or thrusters with the rows of the shapes they are on, in an order of their own."""
    width = obs.polygons.shape[-1]
    circles = np.pad(obs.circles[0], ((0, 0), (0, width - obs.circles.shape[-1])))
    shapes = np.concatenate([obs.polygons[0], circles])
    full = np.concatenate([rows, *[shapes[end] for end in ends]], axis=-1)[mask]
    return full[np.lexsort(np.round(full, 4).T[::-1])]


@pytest.mark.parametrize("size", SIZES)
def test_another_order_of_slots_is_another_order_of_rows_and_nothing_else(size: str) -> None:
    rng = np.random.default_rng(1)
    for level in levels_of(size):
        other, source = permuted(level, rng)
        one, two = (jax.tree.map(np.asarray, observe_start(stack_worlds([x]))) for x in (level, other))
        polygons = one.polygons.shape[1]
        np.testing.assert_array_equal(one.polygons[0, source[:polygons]], two.polygons[0])
        np.testing.assert_array_equal(one.circles[0, source[polygons:] - polygons], two.circles[0])
        np.testing.assert_array_equal(one.attention_masks[0][:, source][:, :, source], two.attention_masks[0])
        joints = [
            rows_with_shapes(obs, (obs.joint_from[0], obs.joint_to[0]), obs.joints[0], obs.joint_mask[0])
            for obs in (one, two)
        ]
        np.testing.assert_allclose(joints[0], joints[1], atol=1e-6)  # sin(-x) and -sin(x)
        thrusters = [
            rows_with_shapes(obs, (obs.thruster_owner[0],), obs.thrusters[0], obs.thruster_mask[0])
            for obs in (one, two)
        ]
        np.testing.assert_array_equal(thrusters[0], thrusters[1])


@pytest.mark.parametrize("size", SIZES)
def test_another_order_of_slots_moves_alike(size: str) -> None:
    """Contacts and joints are solved in the order of their slots, so that rounding and what is left of errors differ:
    a twentieth of a second, in which nothing falls more than 2 cm, moves nearly all shapes alike within 0.5 mm and no
    shape by more than 5 mm."""
    rng = np.random.default_rng(2)
    engine = Engine(SIZES[size])
    pairs = [(level, *permuted(level, rng)) for level in levels_of(size)]
    worst = []
    for which in (0, 1):
        levels = stack_worlds([pair[which] for pair in pairs])
        state = engine.initial_state(levels.scene, levels.position, levels.angle)
        controls = Controls(
            motor=np.ones_like(levels.scene.joints.rest_angle), thruster=np.ones_like(levels.scene.thrusters.angle)
        )
        after, _ = engine.step(levels.scene, state, controls, num_steps=3)
        worst.append(np.asarray(after.position))
    apart = np.concatenate(
        [
            np.abs(one[source] - two).max(-1)[level.scene.shapes.active[source]]
            for (level, _, source), one, two in zip(pairs, *worst)
        ]
    )
    assert np.quantile(apart, 0.95) < 5e-4 and apart.max() < 5e-3


# Files and sizes


LEVEL_FILES = sorted(file for size in SIZES for file in (levels_root() / size).glob("*.json"))


@pytest.mark.parametrize("file", LEVEL_FILES, ids=lambda file: file.stem)
def test_designed_levels_are_stored_in_canonical_form(file: object) -> None:
    document = json.loads(file.read_text())  # type: ignore[attr-defined]
    kinds = {shape["id"]: shape["type"] for shape in document["shapes"]}
    polygons = [name for name, kind in kinds.items() if kind != "circle"]
    slots = [*WALL_NAMES, *polygons, *(name for name, kind in kinds.items() if kind == "circle")]
    for joint in document.get("joints", []):
        assert slots.index(joint["a"]) < slots.index(joint["b"]), joint
    for shape in document["shapes"]:
        if shape["type"] == "polygon":
            corners = np.array(shape["vertices"], np.float32)
            padded = np.concatenate([corners, np.repeat(corners[-1:], 4 - len(corners), axis=0)])
            np.testing.assert_array_equal(canonical_corners(padded, jnp.array(len(corners))), padded, shape["id"])


@pytest.mark.parametrize("file", LEVEL_FILES, ids=lambda file: file.stem)
def test_what_is_written_is_in_canonical_form_and_reads_back_as_it_was(file: object) -> None:
    level = level_from_json(json.loads(file.read_text()))  # type: ignore[attr-defined]
    document = level_to_json(level)
    again = level_from_json(document)
    assert level_to_json(again) == document
    for leaf, other in zip(jax.tree.leaves(canonical(again, fixed(again))), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(leaf, other)


def test_a_polygon_about_its_centroid_stays_where_it_is_to_the_bit() -> None:
    """A box that was centred again would move by some 1e-8 m each time it is written and read."""
    document = {
        "format": "kinetix-dist-level",
        "version": 1,
        "name": "box",
        "size": "s",
        "shapes": [
            {"id": "box", "type": "box", "width": 0.37, "height": 0.11, "position": [1.3, 2.7], "role": "green"},
            {"id": "goal", "type": "circle", "radius": 0.3, "position": [4, 1], "role": "blue"},
        ],
    }
    level = level_from_json(document)
    np.testing.assert_array_equal(level.position[4], np.array([1.3, 2.7], np.float32))
    np.testing.assert_array_equal(level.scene.shapes.vertices[4, 0], np.array([0.185, 0.055], np.float32))
    np.testing.assert_array_equal(level.position[:4], empty_level(SIZES["s"]).position[:4])


def test_public_documents_are_written_in_canonical_form() -> None:
    """Clockwise there, the same corner first; a is the lower slot."""
    document = export_kinetix(by_file(JointKind.REVOLUTE))["env_state"]
    corner = document["polygon"][BOX]["vertices"]["0"]
    assert corner["0"] > 0 and corner["1"] > 0
    assert all(joint["a_index"] < joint["b_index"] for joint in document["joint"] if joint["active"])
    again = export_kinetix(import_kinetix({"env_state": document}))["env_state"]
    assert again["joint"] == document["joint"]


def test_a_level_stays_canonical_in_another_size() -> None:
    level = fit_level(by_file(JointKind.FIXED), Capacity(polygons=9, circles=4, joints=3, thrusters=3, vertices=5))
    for leaf, other in zip(jax.tree.leaves(canonical(level, fixed(level))), jax.tree.leaves(level), strict=True):
        np.testing.assert_array_equal(leaf, other)
