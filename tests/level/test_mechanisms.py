"""Levels with one mechanism: facts of hundreds of each family, and mixtures with other levels."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.scene import Capacity, JointKind
from kinetix_dist.level.generator import generate_level, generate_levels
from kinetix_dist.level.generator_config import TASK_FAMILIES, GeneratorConfig, generator
from kinetix_dist.level.level import NUM_WALLS, SIZES, WORLD_SIZE_M, Level, Role
from kinetix_dist.level.mechanisms import families, mechanism_draft
from kinetix_dist.level.mechanisms.template import Draws, draw_numbers
from kinetix_dist.level.overlap import world_corners
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.level.statistics import overlaps
from kinetix_dist.level.walls import FLOOR_TOP_M
from tests.level.valid import assert_valid

NUM_LEVELS = 512
ONLY_AT_L = (
    "runner", "sprinter", "carrier", "jumper", "grasper", "climber", "ramp", "gripper", "pinball",
)  # fmt: skip
FAMILIES_OF = {
    "s": ("unicycle", "arm", "turner", "pendulum"),
    "m": tuple(family for family in TASK_FAMILIES if family not in ONLY_AT_L),
    "l": TASK_FAMILIES,
}
WITH_GREEN_GOAL = ("turner", "flipper")  # blue and red are of one mechanism


@functools.cache
def levels_of(size: str, family: str | None = None) -> Level:
    config = generator(family or "locomotion")
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(5), NUM_LEVELS, SIZES[size], config))


def bottoms_of(levels: Level) -> np.ndarray:
    """[levels, shapes] m, y of the lowest point of each shape."""
    shapes, polygons = levels.scene.shapes, levels.scene.shapes.vertices.shape[1]
    corners = np.asarray(world_corners(levels.position[:, :polygons], levels.angle[:, :polygons], shapes.vertices))
    return np.concatenate([corners[..., 1].min(axis=2), levels.position[:, polygons:, 1] - shapes.radius], axis=1)


@pytest.mark.parametrize(
    ("size", "family"),
    [
        pytest.param(size, name, marks=pytest.mark.long if size == "l" else [])
        for size, names in FAMILIES_OF.items()
        for name in names
    ],
)
def test_every_level_is_valid_and_nothing_overlaps_that_may_touch(size: str, family: str) -> None:
    levels = levels_of(size, family)
    # Blocks and the floor; a link and the floor.
    assert_valid(levels, SIZES[size], max_red={"flyer": 4, "climber": 4, "reacher": 2}.get(family, 1))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(levels) if leaf.dtype.kind == "f")
    overlap = overlaps(levels)
    assert not (overlap & levels.scene.shapes.can_touch).any()
    # Walls: an obstacle may stand on the floor, and nothing else touches them.
    depth = overlap[:, :NUM_WALLS, NUM_WALLS:]
    assert not depth[levels.scene.shapes.inverse_mass[:, None, NUM_WALLS:].repeat(NUM_WALLS, 1) > 0].any()
    moves = levels.scene.shapes.active & (levels.scene.shapes.inverse_mass > 0)
    if family == "reacher":  # green or blue is at the end of the arm, and the other one is fixed
        assert ((moves & np.isin(levels.shape_role, (Role.GREEN, Role.BLUE))).sum(axis=1) == 1).all()
    else:
        of_mechanism = levels.shape_role == (Role.BLUE if family in WITH_GREEN_GOAL else Role.GREEN)
        assert moves[of_mechanism & levels.scene.shapes.active].all()
    joints, thrusters = levels.scene.joints, levels.scene.thrusters.active
    has_motor = joints.active & joints.motor_on
    assert (has_motor.any(axis=1) | thrusters.any(axis=1)).all()
    is_weld = joints.active & (joints.kind == JointKind.FIXED)
    # Feet, legs of landers, walls of what carries, hands, the tip of a pole; a hinge alone holds a pole and a rope.
    has_welds = family in ("runner", "sprinter", "carrier", "grasper") or (
        size == "l" and family in ("lander", "cartpole", "pendulum")
    )
    assert is_weld.any() == has_welds
    is_passive = joints.active & ~joints.motor_on & ~is_weld
    with_passive = family == "cartpole" or (family == "pendulum" and size != "s") or (size, family) == ("l", "lander")
    assert is_passive.any() == with_passive


@pytest.mark.long
@pytest.mark.parametrize(
    "family", ["car", "unicycle", "walker", "runner", "sprinter", "snake", "cartpole", "pusher", "carrier"]
)
def test_what_can_go_stands_on_the_floor_with_the_goal_beside_it(family: str) -> None:
    levels = levels_of("l", family)
    shapes = levels.scene.shapes
    moves = shapes.active & (shapes.inverse_mass > 0) & (levels.shape_role != Role.BLUE)
    lowest = np.where(moves, bottoms_of(levels), np.inf).min(axis=1)
    np.testing.assert_allclose(lowest, FLOOR_TOP_M + 0.01, atol=1e-4)
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    apart = levels.position[is_blue][:, 0] - levels.position[is_green][:, 0]
    assert np.abs(apart).min() > 0.3
    assert 0.4 < (apart > 0).mean() < 0.6  # to either side
    assert (levels.position[moves] > 0).all() and (levels.position[moves] < WORLD_SIZE_M).all()


def test_a_flyer_has_thrusters_that_carry_it() -> None:
    """10 N for each unit of power, in the direction of its angle (docs/level_format.md); gravity 9.81 m/s2."""
    for size in "ml":
        levels = levels_of(size, "flyer")
        thrusters = levels.scene.thrusters
        assert (thrusters.active.sum(axis=1) == 2).all() and (
            levels.thruster_colour[:, 0] != levels.thruster_colour[:, 1]
        ).all()
        upwards_n = (10.0 * thrusters.power * np.sin(thrusters.angle)).sum(axis=1)
        is_green = levels.shape_role == Role.GREEN
        weight_n = 9.81 / levels.scene.shapes.inverse_mass[is_green]
        lift = upwards_n / weight_n
        assert (lift > 1.01).all() and (lift < 3.0).all() and 0.1 < (lift < 1.2).mean() < 0.25
        sideways_n = np.abs(10.0 * thrusters.power * np.cos(thrusters.angle)).max(axis=1)
        assert (sideways_n > 0.05 * weight_n).all()
        assert (levels.position[is_green][:, 1] > FLOOR_TOP_M + 0.6).all()
    levels, polygons = levels_of("l", "flyer"), SIZES["l"].polygons
    assert 0.4 < (levels.shape_role[:, polygons:] == Role.GREEN).any(axis=1).mean() < 0.6  # a disc
    is_fixed = levels.scene.shapes.active & (levels.scene.shapes.inverse_mass == 0) & (levels.shape_role != Role.BLUE)
    is_fixed[:, :NUM_WALLS] = False
    numbers, counts = np.unique(is_fixed.sum(axis=1), return_counts=True)
    # Two pillars or three in two thirds, else up to three blocks.
    assert set(numbers) == {0, 1, 2, 3} and counts[2] + counts[3] > 0.8 * NUM_LEVELS
    # Pillars end at the floor or the ceiling. Two of them leave the flyer 0.25 m to each side at least: between their
    # ends, or between one and the other where they reach beyond each other's end. A third one is as far from both.
    half = np.abs(levels.scene.shapes.vertices[:, :, 0])
    low, high = levels.position[:, :polygons] - half, levels.position[:, :polygons] + half
    size = np.where(
        (levels.shape_role[:, polygons:] == Role.GREEN).any(axis=1),
        (levels.scene.shapes.radius * (levels.shape_role[:, polygons:] == Role.GREEN)).sum(axis=1),
        (half.max(axis=2) * (levels.shape_role[:, :polygons] == Role.GREEN)).sum(axis=1),
    )
    num_staggered = num_beyond = num_pairs = num_threes = 0
    for row in range(NUM_LEVELS):
        obstacles = np.flatnonzero(is_fixed[row, :polygons])
        stands = [k for k in obstacles if abs(low[row, k, 1] - FLOOR_TOP_M) < 1e-4]
        hangs = [k for k in obstacles if abs(high[row, k, 1] - WORLD_SIZE_M) < 1e-4]
        if len(stands) + len(hangs) == 3:
            begins, ends = low[row, obstacles, 0], high[row, obstacles, 0]
            between = np.maximum(begins[:, None] - ends, begins - ends[:, None])
            is_apart = (between > 2.0 * (size[row] + 0.25) - 1e-4) | np.eye(3, dtype=bool)
            num_threes += 1
            assert is_apart.all(axis=1).any()
            assert (high[row, stands, 1] < WORLD_SIZE_M - 2.0 * (size[row] + 0.25) + 1e-4).all()
            assert (low[row, hangs, 1] > FLOOR_TOP_M + 2.0 * (size[row] + 0.25) - 1e-4).all()
        if len(obstacles) != 2 or len(stands) != 1 or len(hangs) != 1:
            continue
        (below,), (above,) = stands, hangs
        between = low[row, above, 1] - high[row, below, 1]
        apart = max(low[row, above, 0] - high[row, below, 0], low[row, below, 0] - high[row, above, 0])
        num_pairs, num_staggered, num_beyond = (
            num_pairs + 1,
            num_staggered + (apart > -1e-4),
            num_beyond + (between < 0),
        )
        assert max(between, apart) > 2.0 * (size[row] + 0.25) - 1e-4
        assert high[row, below, 1] < WORLD_SIZE_M - 2.0 * (size[row] + 0.25) + 1e-4
        assert low[row, above, 1] > FLOOR_TOP_M + 2.0 * (size[row] + 0.25) - 1e-4
    assert 0.35 < num_pairs / NUM_LEVELS < 0.72 and num_threes > 0.02 * NUM_LEVELS
    assert num_beyond > 0.02 * num_pairs and num_staggered > 0.4 * num_pairs
    # Whatever is in the way is to one side of it and of the goal to the other.
    is_green, is_blue = levels.shape_role == Role.GREEN, levels.shape_role == Role.BLUE
    start, goal = (levels.position[role][:, None, 0] for role in (is_green, is_blue))
    x = levels.position[..., 0]
    assert (((x - start) * (goal - x) > 0) | ~is_fixed).all()


def test_a_runner_faces_its_goal() -> None:
    levels = levels_of("l", "runner")
    joints = levels.scene.joints
    row = np.arange(NUM_LEVELS)
    # The shape with one joint that is not green is a foot.
    ends = np.stack(
        [
            (joints.active[:, :, None] & (joints_of[:, :, None] == np.arange(levels.position.shape[1]))).sum(1)
            for joints_of in (joints.a, joints.b)
        ]
    ).sum(0)
    foot = np.argmax((ends == 1) & (levels.shape_role != Role.GREEN), axis=1)
    joint = np.argmax(joints.active & ((joints.a == foot[:, None]) | (joints.b == foot[:, None])), axis=1)
    is_a = joints.a[row, joint] == foot
    anchor = np.where(is_a[:, None], joints.anchor_a[row, joint], joints.anchor_b[row, joint])
    forward = -anchor[:, 0]  # feet are level: their centre from the ankle
    apart = (levels.position[levels.shape_role == Role.BLUE] - levels.position[levels.shape_role == Role.GREEN])[:, 0]
    assert (np.sign(forward) == np.sign(apart)).all()
    assert set((joints.active).sum(axis=1)) == {3, 6}
    # Feet that are fixed, of all legs or of none; colours in turn, those of motors alone.
    num_welds = (joints.active & (joints.kind == JointKind.FIXED)).sum(axis=1)
    num_legs = joints.active.sum(axis=1) // 3
    assert ((num_welds == 0) | (num_welds == num_legs)).all() and 0.3 < (num_welds > 0).mean() < 0.5
    has_motor = joints.active & joints.motor_on
    assert (has_motor.sum(axis=1) == joints.active.sum(axis=1) - num_welds).all()
    num_colours = np.stack([((levels.motor_colour == colour) & has_motor).any(axis=1) for colour in range(4)]).sum(0)
    most = np.minimum(has_motor.sum(axis=1), 4)
    assert 0.5 < (num_colours == most).mean() < 0.75 and 0.2 < (num_colours == 1).mean() < 0.35
    assert np.abs(apart).max() > 4.0 and np.median(np.abs(apart)) < 2.5


def test_sprinters_are_hoppers_walkers_cheetahs_and_swimmers() -> None:
    levels = levels_of("l", "sprinter")
    shapes, joints, polygons = levels.scene.shapes, levels.scene.joints, SIZES["l"].polygons
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    body = shapes.active & ~is_blue
    body[:, :NUM_WALLS] = False
    num_links, is_weld = body.sum(axis=1), joints.active & (joints.kind == JointKind.FIXED)
    y = np.where(body, levels.position[..., 1], np.nan)
    lies = np.nanmax(y, axis=1) - np.nanmin(y, axis=1) < 1e-4
    half = np.abs(shapes.vertices[:, :, 0])
    torso = half[is_green[:, :polygons]]
    is_upright = torso[:, 1] > torso[:, 0]
    forms = np.stack(
        [
            is_upright & ((num_links == 3) | (num_links == 4)),  # one leg, without a foot and with one
            is_upright & ((num_links == 5) | (num_links == 7)),
            ~is_upright & ~lies & ((num_links == 5) | (num_links == 7)),
            lies & ((num_links == 3) | (num_links == 5)),
        ]
    )
    assert (forms.sum(axis=0) == 1).all()
    assert (np.abs(forms.mean(axis=1) - np.array([2, 2, 2, 1]) / 7) < 0.06).all()
    has_feet = np.isin(num_links, (4, 7))
    assert 0.78 < has_feet[~lies].mean() < 0.92
    assert not (is_weld.any(axis=1) & (lies | (forms[2] & ~has_feet))).any()  # all knees of swimmers and cheetahs turn
    hips = [
        np.where(is_green[row, joints.a[row]][:, None], joints.anchor_a[row], joints.anchor_b[row])[
            joints.active[row] & (is_green[row, joints.a[row]] | is_green[row, joints.b[row]])
        ]
        for row in np.flatnonzero(forms[1])
    ]
    assert all(len(two) == 2 and np.abs(two[0] - two[1]).max() < 1e-5 for two in hips)
    # Motors at their limits in nine twentieths, weak in three tenths, and in four fifths each of the next colour.
    has_motor = joints.active & joints.motor_on & ~is_weld
    full = ((np.abs(joints.motor_speed) == 3.0) & (joints.motor_power == 3.0) | ~has_motor).all(axis=1)
    weak = ((np.abs(joints.motor_speed) < 1.6) & (joints.motor_power < 1.0) | ~has_motor).all(axis=1)
    assert 0.37 < full.mean() < 0.53 and 0.22 < weak.mean() < 0.38
    # Limits reach as far to both sides, but for knees that bend one way: there one of them is seven times the other.
    limits = np.stack([-joints.lower_limit, joints.upper_limit])[:, has_motor]
    ratio = limits.max(axis=0) / limits.min(axis=0)
    assert (np.isclose(ratio, 1.0, rtol=1e-3) | np.isclose(ratio, 7.0, rtol=1e-3)).all()
    assert 0.1 < np.isclose(ratio, 7.0, rtol=1e-3).mean() < 0.3
    num_colours = np.stack([((levels.motor_colour == colour) & has_motor).any(axis=1) for colour in range(4)]).sum(0)
    assert 0.78 < (num_colours == np.minimum(has_motor.sum(axis=1), 4)).mean() < 0.95
    # The goal is a box that stands on the floor in six tenths; in three tenths it is at the far wall.
    is_box = is_blue[:, :polygons].any(axis=1)
    assert 0.52 < is_box.mean() < 0.68
    np.testing.assert_allclose(bottoms_of(levels)[is_blue][is_box], FLOOR_TOP_M + 0.01, atol=1e-4)
    x, green_x = levels.position[is_blue][:, 0], levels.position[is_green][:, 0]
    reach = np.where(
        is_box, (half[..., 0] * is_blue[:, :polygons]).sum(1), (shapes.radius * is_blue[:, polygons:]).sum(1)
    )
    to_wall = np.where(x > green_x, WORLD_SIZE_M - x, x) - reach
    assert 0.25 < (to_wall < 0.1001).mean() < 0.42
    floor_is_red = levels.shape_role[:, 0] == Role.RED
    assert not floor_is_red[lies].any() and 0.36 < floor_is_red[~lies].mean() < 0.54


def test_two_motors_are_of_one_colour_half_of_the_time_and_else_each_of_any() -> None:
    levels = levels_of("m")
    has_motor = levels.scene.joints.active & levels.scene.joints.motor_on
    several = has_motor.sum(axis=1) == 2
    pair = np.sort(np.where(has_motor, levels.motor_colour, 9)[several], axis=1)[:, :2]
    assert abs((pair[:, 0] == pair[:, 1]).mean() - (0.5 + 0.5 / 4)) < 0.1


def test_what_is_pushed_lies_between_the_car_and_the_goal() -> None:
    levels = levels_of("l", "pusher")
    shapes = levels.scene.shapes
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    is_car = shapes.active & (shapes.inverse_mass > 0) & ~is_green & ~is_blue
    green, blue = levels.position[is_green][:, 0], levels.position[is_blue][:, 0]
    car = np.stack([levels.position[row, mask, 0].mean() for row, mask in enumerate(is_car)])
    assert (is_car.sum(axis=1) == 3).all()
    assert (np.sign(green - car) == np.sign(blue - green)).all()
    is_disc = is_green[:, SIZES["l"].polygons :].any(axis=1)
    assert 0.4 < is_disc.mean() < 0.6
    assert not (levels_of("m", "pusher").shape_role[:, SIZES["m"].polygons :] == Role.GREEN).any()  # no room for a disc


def test_a_pole_stands_beside_a_goal_of_its_upper_half_and_a_disc_on_a_beam_must_pass_below() -> None:
    poles = levels_of("l", "cartpole")
    is_green, is_blue = poles.shape_role == Role.GREEN, poles.shape_role == Role.BLUE
    polygons = SIZES["l"].polygons
    assert (np.abs(poles.angle[is_green]) < 0.061).all()  # rad, of the pole or of the disc at its tip
    has_tip = is_green[:, polygons:].any(axis=1)
    assert 0.3 < has_tip.mean() < 0.5
    welds = poles.scene.joints.active & (poles.scene.joints.kind == JointKind.FIXED)
    assert (welds.sum(axis=1) == has_tip).all()
    assert (poles.position[is_blue][:, 1] > poles.position[is_green][:, 1])[~has_tip].all()
    # A tip that stands touches its goal: no goal is above it.
    rise = (poles.position[is_blue] - poles.position[is_green])[has_tip, 1]
    reach = (poles.scene.shapes.radius * (is_green | is_blue)[:, polygons:]).sum(axis=1)[has_tip]
    assert (np.abs(rise) < reach).mean() > 0.6 and (rise < reach).all()
    has_thrusters = poles.scene.thrusters.active.any(axis=1)
    assert 0.3 < has_thrusters.mean() < 0.5
    assert (has_thrusters == (poles.scene.joints.active.sum(axis=1) == 1 + has_tip)).all()

    beams = levels_of("l", "beam")
    is_green, is_blue = beams.shape_role == Role.GREEN, beams.shape_role == Role.BLUE
    disc, goal = beams.position[is_green], beams.position[is_blue]
    reach = (beams.scene.shapes.radius * (is_green | is_blue)[:, polygons:]).sum(axis=1)
    assert (goal[:, 1] - disc[:, 1] < reach).all()  # held level, it touches
    assert (np.abs(goal[:, 0] - disc[:, 0]) > reach).all()  # and does not yet
    is_pivot = beams.scene.shapes.active & (beams.scene.shapes.inverse_mass == 0) & ~is_blue
    is_pivot[:, :NUM_WALLS] = False
    pivot = beams.position[is_pivot]
    assert (np.sign(goal[:, 0] - pivot[:, 0]) == -np.sign(disc[:, 0] - pivot[:, 0])).all()


def test_a_lander_is_carried_by_its_thrusters_and_green_is_what_comes_down_first() -> None:
    for size in "ml":
        levels = levels_of(size, "lander")
        shapes, thrusters = levels.scene.shapes, levels.scene.thrusters
        is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
        moves = shapes.active & (shapes.inverse_mass > 0) & ~is_blue
        mass = np.divide(1.0, shapes.inverse_mass, out=np.zeros_like(shapes.inverse_mass), where=moves).sum(axis=1)
        lift = (10.0 * thrusters.power * np.sin(thrusters.angle)).sum(axis=1) / (9.81 * mass)
        assert (lift > 1.09).all() and (lift < 2.61).all()
        bottoms = bottoms_of(levels)
        others = np.where(moves & ~is_green, bottoms, np.inf).min(axis=1)
        assert (bottoms[is_green] < others).all()
        assert (bottoms[is_green] > FLOOR_TOP_M + 0.89).all()
        # The goal lies on the floor.
        assert is_blue[:, : SIZES[size].polygons].any(axis=1).all()
        np.testing.assert_allclose(bottoms[is_blue], FLOOR_TOP_M + 0.01, atol=1e-4)
    has_rope = is_green[:, SIZES["l"].polygons :].any(axis=1)
    num_joints = levels.scene.joints.active.sum(axis=1)
    assert 0.3 < has_rope.mean() < 0.5 and set(num_joints[has_rope]) == {4} and set(num_joints[~has_rope]) == {0, 2}


def test_what_is_carried_lies_on_the_car_and_comes_off_where_the_goal_is_on_the_floor() -> None:
    levels, polygons = levels_of("l", "carrier"), SIZES["l"].polygons
    shapes = levels.scene.shapes
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    green, blue = levels.position[is_green], levels.position[is_blue]
    is_slab = is_blue[:, :polygons].any(axis=1)
    assert 0.3 < is_slab.mean() < 0.5
    welds = levels.scene.joints.active & (levels.scene.joints.kind == JointKind.FIXED)
    assert (welds.sum(axis=1) == np.where(is_slab, 1, 2)).all()
    # A load that is carried to a disc touches it from below or from the side.
    size = np.where(
        is_green[:, polygons:].any(axis=1),
        (shapes.radius * is_green[:, polygons:]).sum(axis=1),
        (np.abs(shapes.vertices[:, :, 0, 1]) * is_green[:, :polygons]).sum(axis=1),
    )
    assert (shapes.inverse_mass[is_blue] == 0)[~is_slab].all()  # it hangs: one that fell would be behind the wall
    goal_bottom = blue[:, 1] - (shapes.radius * is_blue[:, polygons:]).sum(axis=1)
    assert (goal_bottom < green[:, 1] + size)[~is_slab].all() and (goal_bottom > green[:, 1] - size)[~is_slab].all()
    # It is 1 cm above the car, or falls onto it where it has to come off again.
    is_car = shapes.active & (shapes.inverse_mass > 0) & ~is_green & ~is_blue
    wide = np.where(is_car[:, :polygons], np.abs(shapes.vertices[:, :, 0, 0]), 0.0).argmax(axis=1)
    chassis = np.arange(NUM_LEVELS), wide
    gap = green[:, 1] - size - levels.position[chassis][:, 1] - np.abs(shapes.vertices[chassis][:, 0, 1])
    falls = gap > 0.02
    np.testing.assert_allclose(gap[~falls], 0.01, atol=1e-5)
    assert not falls[~is_slab].any() and 0.25 < falls[is_slab].mean() < 0.55 and gap.max() < 0.32
    # Nothing at the start is below the load but the car: it is within its length.
    highest = np.where(is_car, levels.position[..., 0], -np.inf).max(axis=1)
    lowest = np.where(is_car, levels.position[..., 0], np.inf).min(axis=1)
    assert (green[:, 0] > lowest).all() and (green[:, 0] < highest).all()
    joints, half = levels.scene.joints, np.abs(shapes.vertices[:, :, 0])
    row = np.arange(NUM_LEVELS)
    weld = np.argmax(welds, axis=1)
    ends = joints.a[row, weld], joints.b[row, weld]
    wall = np.where(half[row, ends[0], 0] < half[row, ends[1], 0], *ends)  # the narrower one
    wall = levels.position[row, wall, 0]
    assert (np.sign(green[:, 0] - wall) == np.sign(blue[:, 0] - green[:, 0]))[is_slab].all()  # behind the load


def test_a_jumper_has_a_gap_before_it_and_its_goal_is_not_higher() -> None:
    levels, polygons = levels_of("l", "jumper"), SIZES["l"].polygons
    shapes = levels.scene.shapes
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    platforms = shapes.active[:, :polygons] & (shapes.inverse_mass[:, :polygons] == 0)
    platforms[:, :NUM_WALLS] = False
    assert (platforms.sum(axis=1) == 2).all()
    half = np.abs(shapes.vertices[:, :, 0])
    low, high = levels.position[:, :polygons] - half, levels.position[:, :polygons] + half
    assert (low[platforms] > 0.05).all() and (high[platforms][:, 0] < WORLD_SIZE_M - 0.05).all()
    has_bar = levels.scene.joints.active.sum(axis=1) == 3  # two of wheels
    assert 0.3 < has_bar.mean() < 0.5 and ((half * is_green[:, :polygons, None]).sum(1).argmax(1) == has_bar).all()
    for row in range(64):
        first, second = np.flatnonzero(platforms[row])
        green, blue = levels.position[row][is_green[row]][0], levels.position[row][is_blue[row]][0]
        if not low[row, first, 0] < green[0] < high[row, first, 0]:
            first, second = second, first
        assert low[row, first, 0] < green[0] < high[row, first, 0]
        assert low[row, second, 0] < blue[0] < high[row, second, 0]
        gap = max(low[row, second, 0] - high[row, first, 0], low[row, first, 0] - high[row, second, 0])
        assert 0.099 < gap < (1.301 if has_bar[row] else 0.501)
        assert -0.001 < high[row, first, 1] - high[row, second, 1] < 0.701


def test_a_disc_lies_on_the_arm_that_throws_it_and_the_goal_is_beyond_the_pivot() -> None:
    levels, polygons = levels_of("l", "thrower"), SIZES["l"].polygons
    shapes = levels.scene.shapes
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    is_pivot = shapes.active & (shapes.inverse_mass == 0) & ~is_blue
    is_pivot[:, :NUM_WALLS] = False
    is_arm = shapes.active & (shapes.inverse_mass > 0) & ~is_green
    disc, goal, pivot, arm = (levels.position[mask] for mask in (is_green, is_blue, is_pivot, is_arm))
    angle = levels.angle[is_arm]
    is_upright = np.abs(angle) > 1.0
    assert 0.2 < is_upright.mean() < 0.4
    np.testing.assert_allclose(np.abs(angle), np.where(is_upright, 0.5 * np.pi, 0.0), atol=1e-6)
    # Its lowest point is 1 cm above the arm, or it falls onto it first: nothing holds it.
    half = np.abs(shapes.vertices[:, :, 0])[is_arm[:, :polygons]]
    rise = np.where(is_upright, half[:, 0], half[:, 1])
    reach = np.where(is_upright, half[:, 1], half[:, 0])
    radius = shapes.radius[is_green[:, polygons:]]
    gap = disc[:, 1] - radius - arm[:, 1] - rise
    lies_on_it = np.abs(gap - 0.01) < 1e-5
    assert 0.5 < lies_on_it.mean() < 0.7 and gap[~lies_on_it].min() > 0.0499 and gap.max() < 0.501
    # From the pivot to the middle of the arm, as a share of half its length.
    out = np.linalg.norm(arm - pivot, axis=1) / half[:, 0]
    assert ((out < 0.301) | (out > 0.499)).all() and 0.12 < (out < 0.301).mean() < 0.28
    assert (np.abs(disc[:, 0] - arm[:, 0]) < reach).all()
    assert (levels.scene.joints.active.sum(axis=1) == 1).all()
    lies = ~is_upright
    assert (np.sign(goal[:, 0] - pivot[:, 0]) == -np.sign(disc[:, 0] - pivot[:, 0]))[lies].all()
    away = np.abs(goal[:, 0] - pivot[:, 0])
    assert away.min() > 0.89 and away.max() < 2.51 and 0.4 < (goal[:, 0] > pivot[:, 0]).mean() < 0.6
    assert 0.3 < (levels.shape_role[:, 0] == Role.RED).mean() < 0.5


def test_what_is_to_be_grasped_lies_between_two_fingers() -> None:
    levels, polygons = levels_of("l", "grasper"), SIZES["l"].polygons
    is_green, is_blue = (levels.shape_role == role for role in (Role.GREEN, Role.BLUE))
    green, blue = levels.position[is_green], levels.position[is_blue]
    np.testing.assert_allclose(bottoms_of(levels)[is_blue], FLOOR_TOP_M + 0.01, atol=1e-4)
    assert (green[:, 1] > blue[:, 1] + 0.2).all()
    shapes, joints = levels.scene.shapes, levels.scene.joints
    assert (joints.active.sum(axis=1) == 5).all()
    pivot = shapes.active[:, polygons:] & (shapes.inverse_mass[:, polygons:] == 0)
    to_hand = np.sign(green[:, 0] - levels.position[:, polygons:][pivot][:, 0])
    assert 0.4 < (to_hand > 0).mean() < 0.6
    for row in range(64):
        fingers = np.flatnonzero(joints.has_limits[row] & joints.active[row])
        ends = [{int(joints.a[row, joint]), int(joints.b[row, joint])} for joint in fingers]
        (palm,) = ends[0] & ends[1]
        lower, upper = sorted(((ends[0] | ends[1]) - {palm}), key=lambda shape: levels.position[row, shape, 1])
        assert levels.position[row, lower, 1] < green[row, 1] < levels.position[row, upper, 1]
        assert np.sign(green[row, 0] - levels.position[row, palm, 0]) == to_hand[row]


def red_first(levels: Level) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(blue, red, green), [levels, shapes] bool each, of a mechanism that must not touch green with red."""
    return tuple(levels.scene.shapes.active & (levels.shape_role == role) for role in (Role.BLUE, Role.RED, Role.GREEN))


@pytest.mark.parametrize("size", ["s", "m", "l"])
def test_a_turner_begins_with_red_below_blue_above_a_green_slab(size: str) -> None:
    levels, polygons = levels_of(size, "turner"), SIZES[size].polygons
    is_blue, is_red, is_green = red_first(levels)
    assert all((mask.sum(axis=1) == 1).all() for mask in (is_blue, is_red, is_green))
    assert (levels.position[is_blue][:, 1] > levels.position[is_red][:, 1]).all()
    assert (bottoms_of(levels)[is_red] > FLOOR_TOP_M + 0.9).all()
    np.testing.assert_allclose(bottoms_of(levels)[is_green], FLOOR_TOP_M + 0.01, atol=1e-4)
    has_box = is_blue[:, :polygons].any(axis=1).mean()
    assert has_box == 0.0 if size == "s" else 0.4 < has_box < 0.6
    # Who does nothing comes down with red: few solve themselves.
    assert np.mean(noop_solved(levels)) < 0.1


@pytest.mark.parametrize("size", ["m", "l"])
def test_a_flipper_has_its_red_wheel_beside_the_goal_and_thrusters_that_lift_an_end(size: str) -> None:
    levels = levels_of(size, "flipper")
    is_blue, is_red, is_green = red_first(levels)
    blue, red, green = (levels.position[mask] for mask in (is_blue, is_red, is_green))
    assert (np.sign(red[:, 0] - blue[:, 0]) == np.sign(green[:, 0] - red[:, 0])).all()
    assert 0.4 < (green[:, 0] > red[:, 0]).mean() < 0.6
    for mask in (is_blue, is_red, is_green):
        np.testing.assert_allclose(bottoms_of(levels)[mask], FLOOR_TOP_M + 0.01, atol=1e-4)
    shapes, thrusters = levels.scene.shapes, levels.scene.thrusters
    moves = shapes.active & (shapes.inverse_mass > 0)
    mass = np.divide(1.0, shapes.inverse_mass, out=np.zeros_like(shapes.inverse_mass), where=moves).sum(axis=1)
    lift = (10.0 * thrusters.power * np.sin(thrusters.angle)).sum(axis=1) / (9.81 * mass)  # of both
    assert (lift > 1.29).all() and (lift < 4.01).all()
    assert (levels.shape_role[:, 0] == Role.NONE).all()


@pytest.mark.parametrize(
    ("family", "speeds", "powers", "colours"),
    [
        ("car", 53.612, 32.0, 61),
        ("unicycle", 31.228, 16.0, 19),
        ("walker", 12.018, 112.056, 79),
        ("arm", -22.294, 79.552, 67),
        ("pusher", 51.681, 32.0, 52),
        ("beam", -31.228, 16.0, 19),
        ("snake", -1.034, 114.71, 100),
    ],
)
def test_the_motors_of_a_key_are_those_they_were(family: str, speeds: float, powers: float, colours: int) -> None:
    """Sums over the first 16 levels, at f7c3bc8: figures in documents are of these levels."""
    levels = levels_of("l", family)
    joints = levels.scene.joints
    active = joints.active[:16]
    found = [np.where(active, x[:16], 0).sum() for x in (joints.motor_speed, joints.motor_power, levels.motor_colour)]
    np.testing.assert_allclose(found, [speeds, powers, colours], atol=2e-3)


@pytest.mark.long
def test_families_are_drawn_as_often_as_their_weights_say() -> None:
    """Green is a disc in no car, a box in no arm of this size (one link of a box), and unicycles have one wheel."""
    families = ("unicycle", "arm")
    share = {}
    for weights in ((), (1.0, 1.0), (3.0, 1.0)):
        config = GeneratorConfig(mechanism_share=1.0, mechanism_families=families, mechanism_weights=weights)
        levels = jax.tree.map(np.asarray, generate_levels(jax.random.key(5), NUM_LEVELS, SIZES["s"], config))
        is_free_disc = levels.scene.shapes.active & (levels.scene.shapes.inverse_mass > 0)
        is_wheel = is_free_disc[:, SIZES["s"].polygons :] & (levels.shape_role[:, SIZES["s"].polygons :] == Role.NONE)
        share[weights] = is_wheel.any(axis=1).mean()
    assert share[()] == share[(1.0, 1.0)] and abs(share[()] - 0.5) < 0.07
    assert abs(share[(3.0, 1.0)] - 0.75) < 0.06
    # Of families for which there is room, in the order in which they were named.
    config = GeneratorConfig(
        mechanism_share=1.0, mechanism_families=("car", *families), mechanism_weights=(9.0, 3.0, 1.0)
    )
    levels = jax.tree.map(np.asarray, generate_levels(jax.random.key(5), NUM_LEVELS, SIZES["s"], config))
    is_free_disc = levels.scene.shapes.active & (levels.scene.shapes.inverse_mass > 0)
    is_wheel = is_free_disc[:, SIZES["s"].polygons :] & (levels.shape_role[:, SIZES["s"].polygons :] == Role.NONE)
    assert is_wheel.any(axis=1).mean() == share[(3.0, 1.0)]


@pytest.mark.parametrize(
    ("families", "weights", "said"),
    [
        (("car", "arm"), (1.0,), "has 1 numbers for 2 families; give one for each, or an empty list"),
        (("car", "arm"), (1.0, 0.0), "must be finite and above 0; leave out a family"),
        (("car", "arm"), (1.0, float("nan")), "mechanism_weights.1 is nan; it must be a finite number"),
        (("car", "arm"), (1.0, float("inf")), "mechanism_weights.1 is inf; it must be a finite number"),
        (("car", "car"), (), "names a family twice; use mechanism_weights"),
    ],
)
def test_weights_that_cannot_be_are_refused(families: tuple[str, ...], weights: tuple[float, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        GeneratorConfig(mechanism_families=families, mechanism_weights=weights)


def test_numbers_that_were_not_drawn_are_not_used() -> None:
    draws = Draws(jax.lax.unstack(draw_numbers(jax.random.key(0))))
    for _ in range(80):
        draws.between(0.0, 1.0)
    with pytest.raises(AssertionError):
        draws.between(0.0, 1.0)


def test_an_arm_can_reach_its_goal_and_has_two_links_or_more_where_there_is_room() -> None:
    levels = levels_of("l", "arm")
    shapes, joints = levels.scene.shapes, levels.scene.joints
    is_blue = shapes.active & (levels.shape_role == Role.BLUE)
    is_base = shapes.active & (shapes.inverse_mass == 0) & ~is_blue
    is_base[:, :NUM_WALLS] = False
    distance = np.linalg.norm(levels.position[is_blue] - levels.position[is_base], axis=1)
    lengths = 2 * np.abs(shapes.vertices[:, :, 0, 0]) * shapes.active[:, : SIZES["l"].polygons]
    lengths[:, :NUM_WALLS] = 0
    assert (distance < lengths.sum(axis=1)).all()
    assert set(joints.active.sum(axis=1)) == {2, 3, 4}


@pytest.mark.parametrize("size", ["m", "l"])
def test_a_reacher_can_reach_its_goal_and_may_carry_blue_to_green_past_its_own_red_link(size: str) -> None:
    levels, polygons = levels_of(size, "reacher"), SIZES[size].polygons
    shapes, joints, role = levels.scene.shapes, levels.scene.joints, levels.shape_role
    is_fixed = shapes.active & (shapes.inverse_mass == 0)
    is_fixed[:, :NUM_WALLS] = False
    is_goal = is_fixed & np.isin(role, (Role.GREEN, Role.BLUE))
    base, goal = levels.position[is_fixed & ~is_goal], levels.position[is_goal]
    lengths = 2 * np.abs(shapes.vertices[:, :, 0, 0]) * shapes.active[:, :polygons]
    lengths[:, :NUM_WALLS] = 0
    # Half of the width of a link at each end is beyond its joints.
    widths = np.abs(shapes.vertices[:, NUM_WALLS:, 0, 1]) * shapes.active[:, NUM_WALLS:polygons]
    width = widths.max(axis=1)
    reach = lengths.sum(axis=1) - width * joints.active.sum(axis=1)
    distance = np.linalg.norm(goal - base, axis=1)
    assert (distance < reach + 1e-4).all() and 0.35 < (distance > 0.84 * reach).mean() < 0.65
    radius = np.where(is_goal[:, polygons:], shapes.radius, 0.0).max(axis=1)[:, None]
    assert (goal - radius > [0.0, FLOOR_TOP_M]).all() and (goal + radius < WORLD_SIZE_M).all()
    is_green, is_red = (is_goal & (role == Role.GREEN)).any(axis=1), (role[:, NUM_WALLS:] == Role.RED).any(axis=1)
    assert 0.3 < is_green.mean() < 0.5 and 0.1 < is_red.mean() < 0.3 and not (is_red & ~is_green).any()
    # Red is the link on the disc, and never the only one.
    disc = np.argmax(is_fixed & ~is_goal, axis=1)[:, None]
    holds = joints.active & ((joints.a == disc) | (joints.b == disc))
    first = np.where(joints.a == disc, joints.b, joints.a)[holds]
    assert (holds.sum(axis=1) == 1).all() and (joints.active.sum(axis=1) >= 2).all()
    assert ((role[np.arange(NUM_LEVELS), first] == Role.RED) == is_red).all()


def test_bars_reach_over_a_climber_which_has_room_to_go_round_them() -> None:
    levels, polygons = levels_of("l", "climber"), SIZES["l"].polygons
    shapes, role = levels.scene.shapes, levels.shape_role
    half = np.abs(shapes.vertices[:, :, 0])
    is_bar = shapes.active & (shapes.inverse_mass == 0) & (role != Role.BLUE)
    is_bar[:, :NUM_WALLS] = False
    assert set(is_bar.sum(axis=1)) == {1, 2, 3}
    number = num_shelves = 0
    for row in range(NUM_LEVELS):
        start, goal = levels.position[row][role[row] == Role.GREEN][0], levels.position[row][role[row] == Role.BLUE][0]
        (green,) = np.flatnonzero(role[row] == Role.GREEN)
        size = half[row, green].max() if green < polygons else shapes.radius[row, green - polygons]
        bars = np.flatnonzero(is_bar[row])
        low, high = levels.position[row, bars] - half[row, bars], levels.position[row, bars] + half[row, bars]
        side = np.sign(goal[0] - start[0])
        ends = high[:, 0] if side > 0 else WORLD_SIZE_M - low[:, 0]
        at = start[0] if side > 0 else WORLD_SIZE_M - start[0]
        begins = low[:, 0] if side > 0 else WORLD_SIZE_M - high[:, 0]
        is_shelf = len(bars) == 1 and begins[0] > 0.401
        num_shelves += is_shelf
        assert not is_shelf or low[0, 0] < goal[0] < high[0, 0]
        assert (ends > at - 1e-4).all() and (ends < WORLD_SIZE_M - 2 * size - (0.09 if is_shelf else 0.79)).all()
        assert (low[:, 1] > start[1] + size + 0.149).all() and goal[1] > high[:, 1].max()
        assert high[:, 1].max() + 2 * size + 0.099 < WORLD_SIZE_M  # it fits between the last one and the ceiling
        radius = shapes.radius[row][role[row, polygons:] == Role.BLUE].item()
        assert goal[1] + radius < WORLD_SIZE_M and goal[0] - radius > 0 and goal[0] + radius < WORLD_SIZE_M
        order = np.argsort(low[:, 1])
        assert (low[order[1:], 1] - high[order[:-1], 1] > 2 * size + 0.199).all()
        # The thruster that pushes to the side pushes towards the goal.
        angles = levels.scene.thrusters.angle[row, :2]
        if np.abs(np.sin(angles)).min() < 0.1:
            number += 1
            assert np.sign(np.cos(angles)[np.argmin(np.abs(np.sin(angles)))]) == side
    assert 0.3 < number / NUM_LEVELS < 0.5 and 0.1 < num_shelves / NUM_LEVELS < 0.3
    assert 0.55 < (role[is_bar] == Role.RED).mean() < 0.9


def test_a_pendulum_hangs_from_a_motor_and_its_goal_is_higher_than_its_end() -> None:
    for size in "sml":
        levels, polygons = levels_of(size, "pendulum"), SIZES[size].polygons
        shapes, joints = levels.scene.shapes, levels.scene.joints
        is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
        green, goal = levels.position[is_green], levels.position[is_blue]
        is_pivot = shapes.active & (shapes.inverse_mass == 0) & ~is_blue
        is_pivot[:, :NUM_WALLS] = False
        pivot = levels.position[is_pivot]
        np.testing.assert_allclose(green[:, 0], pivot[:, 0], atol=1e-5)
        half = np.abs(shapes.vertices[:, :, 0, 1]) * (shapes.active & (shapes.inverse_mass > 0))[:, :polygons]
        reach = pivot[:, 1] - (levels.position[:, :polygons, 1] - half)[is_green[:, :polygons]]
        assert (goal[:, 1] > pivot[:, 1] - 0.65 * reach).all()
        assert (np.linalg.norm(goal - pivot, axis=1) < 1.06 * reach).all()  # its end gets there
        has_motor = joints.active & joints.motor_on & (joints.kind != JointKind.FIXED)
        assert (has_motor.sum(axis=1) >= 1).all()
        # Held level it pulls with m g reach / 2; a motor gives 900 times its power times the inertia of what it turns.
        count = (joints.active & (joints.kind == JointKind.REVOLUTE)).sum(axis=1)
        power = np.where(has_motor, joints.motor_power, 0.0).max(axis=1)
        weak = power < 6.0 * 9.81 * count**3 / (900.0 * reach)
        assert 0.7 < weak.mean() < 0.9


def test_a_ramp_is_before_a_red_slab_with_the_goal_beyond() -> None:
    levels, polygons = levels_of("l", "ramp"), SIZES["l"].polygons
    shapes, role = levels.scene.shapes, levels.shape_role
    is_fixed = shapes.active & (shapes.inverse_mass == 0)
    is_fixed[:, :NUM_WALLS] = False
    is_red, is_ramp = (is_fixed & (role == wanted) for wanted in (Role.RED, Role.NONE))
    assert (is_red.sum(1) == 1).all() and (is_ramp.sum(1) == 1).all()
    goal, slab, ramp = (levels.position[mask][:, 0] for mask in (role == Role.BLUE, is_red, is_ramp))
    side = np.sign(goal - slab)
    moves = shapes.active & (shapes.inverse_mass > 0) & (role != Role.BLUE)
    car = np.where(moves, levels.position[..., 0] * side[:, None], -np.inf).max(axis=1) * side
    order = np.stack([car, ramp, slab, goal]) * side
    assert (np.diff(order, axis=0) > 0.05).all() and 0.4 < (side > 0).mean() < 0.6
    assert (np.sign(levels.angle[is_ramp]) == side).all()  # it rises towards the goal
    lowest = bottoms_of(levels)
    assert (lowest[is_ramp] < FLOOR_TOP_M).all() and (lowest[is_ramp] > FLOOR_TOP_M - 0.15).all()  # no step before it
    wheel_is_green = (role[:, polygons:] == Role.GREEN).any(axis=1)
    assert 0.3 < wheel_is_green.mean() < 0.5


def test_the_fingers_of_a_gripper_close() -> None:
    levels, polygons = levels_of("l", "gripper"), SIZES["l"].polygons
    shapes, joints, role = levels.scene.shapes, levels.scene.joints, levels.shape_role
    assert (joints.active.sum(axis=1) == 6).all() and (joints.kind[joints.active] == JointKind.REVOLUTE).all()
    goal = levels.position[role == Role.BLUE]
    is_disc = shapes.active[:, polygons:] & (role[:, polygons:] != Role.BLUE)
    stands = is_disc.sum(axis=1) == 2  # on the disc that is not the arm's
    assert 0.4 < stands.mean() < 0.6
    lowest_disc = np.where(is_disc, levels.position[:, polygons:, 1] - shapes.radius, np.inf).min(axis=1)
    assert (lowest_disc[stands] < FLOOR_TOP_M + 1e-4).all() and (goal[:, 1] < FLOOR_TOP_M + 0.2).all()
    # Joints with limits turn one way from where they are, and both of a finger have one colour.
    one_way = (np.abs(joints.lower_limit) < 1e-5) ^ (np.abs(joints.upper_limit) < 1e-5)
    assert (one_way.sum(axis=1) == 4).all()
    colours = np.sort(np.where(one_way, levels.motor_colour, 9), axis=1)
    assert (colours[:, 0] == colours[:, 1]).all() and (colours[:, 2] == colours[:, 3]).all()
    assert (colours[:, 1] != colours[:, 2]).all()
    # Seen from the arm the upper one turns down and the lower one up: clockwise, where the hand is to the right, and
    # counter-clockwise. Of a joint the part with fewer joints is further out.
    for row in range(NUM_LEVELS):
        a, b = (ends[row][joints.active[row]] for ends in (joints.a, joints.b))
        num_joints = np.bincount(np.concatenate([a, b]), minlength=levels.position.shape[1])
        forearm = np.argmax(num_joints == 3)
        place = levels.position[row]
        for joint in np.flatnonzero(one_way[row]):
            a, b = joints.a[row, joint], joints.b[row, joint]
            outer = a if num_joints[a] < num_joints[b] else b
            turn = joints.lower_limit[row, joint] + joints.upper_limit[row, joint]  # of b from a
            turn = turn if outer == b else -turn
            side, above = np.sign(place[outer] - place[forearm])
            assert np.sign(turn) == -side * above


def test_the_disc_of_a_pinball_level_falls_onto_the_flipper_away_from_the_goal() -> None:
    levels, polygons = levels_of("l", "pinball"), SIZES["l"].polygons
    shapes, role, joints = levels.scene.shapes, levels.shape_role, levels.scene.joints
    moves = shapes.active & (shapes.inverse_mass > 0)
    assert (joints.active.sum(axis=1) == 2).all() and (moves[:, :polygons].sum(axis=1) == 2).all()
    disc, goal = levels.position[role == Role.GREEN], levels.position[role == Role.BLUE]
    middle = 0.5 * WORLD_SIZE_M
    assert ((disc - middle)[:, 0] * (goal - middle)[:, 0] < 0).all()
    flippers = levels.position[:, :polygons][moves[:, :polygons]].reshape(NUM_LEVELS, 2, 2)
    assert (disc[:, None, 1] > flippers[..., 1]).all() and (goal[:, None, 1] > flippers[..., 1] + 0.8).all()


@pytest.mark.parametrize(
    "size", [pytest.param("s", marks=pytest.mark.slow), "m", pytest.param("l", marks=pytest.mark.slow)]
)
def test_few_of_them_solve_themselves(size: str) -> None:
    assert np.mean(noop_solved(levels_of(size))) < 0.05


@pytest.mark.slow
def test_few_of_each_new_family_solve_themselves() -> None:
    for family, most in (("gripper", 0.1), ("ramp", 0.01), ("pendulum", 0.01), ("pinball", 0.01), ("jumper", 0.01)):
        assert np.mean(noop_solved(levels_of("l", family))) < most, family


def test_families_for_which_there_is_room_are_equally_likely() -> None:
    levels = levels_of("m")
    shapes, polygons = levels.scene.shapes, SIZES["m"].polygons
    wheels = levels.scene.joints.active & (levels.scene.joints.b >= polygons)
    base = (shapes.active & (shapes.inverse_mass == 0) & (levels.shape_role != Role.BLUE))[:, polygons:].any(axis=1)
    num_wheels = np.where(base, 0, wheels.sum(axis=1))
    shares = {"arm": base, "car": num_wheels == 2, "unicycle": num_wheels == 1, "walker": ~base & (num_wheels == 0)}
    for family, share in shares.items():
        assert abs(share.mean() - 0.25) < 0.08, family  # four standard errors of 512 draws


@pytest.mark.long
def test_a_share_of_the_levels_has_mechanisms_and_the_others_are_as_without() -> None:
    mixed = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], GeneratorConfig(mechanism_share=0.3))
    plain = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], GeneratorConfig())
    others = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], generator("locomotion"))
    is_plain = np.all(np.isclose(mixed.position, plain.position, atol=1e-5), axis=(1, 2))
    is_other = np.all(np.isclose(mixed.position, others.position, atol=1e-5), axis=(1, 2))
    assert (is_plain ^ is_other).all()
    assert abs(is_other.mean() - 0.3) < 0.09


def test_a_level_depends_on_its_key_and_number_alone() -> None:
    few = generate_levels(jax.random.key(5), 4, SIZES["m"], generator("locomotion"))
    for leaf, other in zip(jax.tree.leaves(few), jax.tree.leaves(levels_of("m")), strict=True):
        np.testing.assert_allclose(leaf, other[:4], rtol=1e-5, atol=1e-5)


def test_what_cannot_be_drawn_is_refused_with_its_name() -> None:
    with pytest.raises(ValueError, match=r"mechanism_families has 'boat'; there are .*\bcar, "):
        GeneratorConfig(mechanism_families=("car", "boat"))
    with pytest.raises(ValueError, match=r"mechanism_share is 1\.5; it must be from 0 to 1"):
        GeneratorConfig(mechanism_share=1.5)
    cars = dataclasses.replace(generator("locomotion"), mechanism_families=("car",))
    with pytest.raises(ValueError, match="no family of mechanism_families car has room in 5 polygons, 2 circles"):
        generate_level(jax.random.key(0), Capacity(polygons=5, circles=2, joints=1, thrusters=1), cars)


def test_every_file_of_families_is_imported() -> None:
    """Imports by name key programs that draw levels by the sources of families too."""
    files = {file.stem for file in Path(families.__file__).parent.glob("*.py")} - {"__init__"}
    assert files == set(families.__all__)


@pytest.mark.parametrize("weights", [(1e39, 3e39), (1e-300, 3e-300), (1e38, 3e38)])
def test_weights_that_float32_does_not_hold_are_weights(weights: tuple[float, ...]) -> None:
    chosen = jax.vmap(lambda key: mechanism_draft._choose(key, weights))(jax.random.split(jax.random.key(0), 2000))
    assert abs(float(chosen.mean()) - 0.75) < 0.05  # five standard errors
