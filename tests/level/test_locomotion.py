"""Cars, unicycles, walkers and arms: what every one of hundreds must be, and that they can be mixed with others."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jax2d.scene import Capacity
from kinetix_dist.level.generator import generate_level, generate_levels
from kinetix_dist.level.generator_config import LOCOMOTION_KINDS, GeneratorConfig, generator
from kinetix_dist.level.level import NUM_WALLS, SIZES, WORLD_SIZE_M, Level
from kinetix_dist.level.noop import noop_solved
from kinetix_dist.level.overlap import world_corners
from kinetix_dist.level.roles import Role
from kinetix_dist.level.statistics import overlaps
from kinetix_dist.level.walls import FLOOR_TOP_M
from tests.level.valid import assert_valid

NUM_LEVELS = 512
KINDS_OF = {"s": ("unicycle", "arm"), "m": LOCOMOTION_KINDS, "l": LOCOMOTION_KINDS}


@functools.cache
def levels_of(size: str, kind: str | None = None) -> Level:
    config = GeneratorConfig(locomotion_share=1.0, locomotion_kinds=(kind,)) if kind else generator("locomotion")
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(5), NUM_LEVELS, SIZES[size], config))


@pytest.mark.parametrize(("size", "kind"), [(size, kind) for size, kinds in KINDS_OF.items() for kind in kinds])
def test_every_level_is_valid_and_nothing_overlaps_that_may_touch(size: str, kind: str) -> None:
    levels = levels_of(size, kind)
    assert_valid(levels, SIZES[size])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(levels) if leaf.dtype.kind == "f")
    overlap = overlaps(levels)
    assert not (overlap & levels.scene.shapes.can_touch).any()
    # Walls: an obstacle may stand on the floor, and nothing else touches them.
    depth = overlap[:, :NUM_WALLS, NUM_WALLS:]
    assert not depth[levels.scene.shapes.inverse_mass[:, None, NUM_WALLS:].repeat(NUM_WALLS, 1) > 0].any()
    green = levels.shape_role == Role.GREEN
    assert (levels.scene.shapes.inverse_mass[green & levels.scene.shapes.active] > 0).all()
    held = levels.scene.joints.active
    assert held.any(axis=1).all() and levels.scene.joints.motor_on[held].all()


@pytest.mark.parametrize("kind", ["car", "unicycle", "walker"])
def test_what_can_go_stands_on_the_floor_with_the_goal_beside_it(kind: str) -> None:
    levels = levels_of("l", kind)
    shapes, polygons = levels.scene.shapes, SIZES["l"].polygons
    moves = shapes.active & (shapes.inverse_mass > 0) & (levels.shape_role != Role.BLUE)
    corners = np.asarray(world_corners(levels.position[:, :polygons], levels.angle[:, :polygons], shapes.vertices))
    lowest = np.where(moves[:, :polygons], corners[..., 1].min(axis=2), np.inf).min(axis=1)
    bottoms = levels.position[:, polygons:, 1] - shapes.radius
    wheels = np.where(moves[:, polygons:], bottoms, np.inf).min(axis=1)
    np.testing.assert_allclose(np.minimum(lowest, wheels), FLOOR_TOP_M + 0.01, atol=1e-4)
    is_green, is_blue = (shapes.active & (levels.shape_role == role) for role in (Role.GREEN, Role.BLUE))
    apart = levels.position[is_blue][:, 0] - levels.position[is_green][:, 0]
    assert np.abs(apart).min() > 0.3
    assert 0.4 < (apart > 0).mean() < 0.6  # to either side
    assert (levels.position[moves] > 0).all() and (levels.position[moves] < WORLD_SIZE_M).all()


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


@pytest.mark.parametrize(
    "size", [pytest.param("s", marks=pytest.mark.slow), "m", pytest.param("l", marks=pytest.mark.slow)]
)
def test_few_of_them_solve_themselves(size: str) -> None:
    assert np.mean(noop_solved(levels_of(size))) < 0.05


def test_kinds_for_which_there_is_room_are_equally_likely() -> None:
    levels = levels_of("m")
    shapes, polygons = levels.scene.shapes, SIZES["m"].polygons
    wheels = levels.scene.joints.active & (levels.scene.joints.b >= polygons)
    base = (shapes.active & (shapes.inverse_mass == 0) & (levels.shape_role != Role.BLUE))[:, polygons:].any(axis=1)
    num_wheels = np.where(base, 0, wheels.sum(axis=1))
    shares = {"arm": base, "car": num_wheels == 2, "unicycle": num_wheels == 1, "walker": ~base & (num_wheels == 0)}
    for kind, share in shares.items():
        assert abs(share.mean() - 0.25) < 0.08, kind  # four standard errors of 512 draws


def test_a_share_of_the_levels_is_locomotion_and_the_others_are_as_without() -> None:
    mixed = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], GeneratorConfig(locomotion_share=0.3))
    plain = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], GeneratorConfig())
    others = generate_levels(jax.random.key(9), NUM_LEVELS, SIZES["m"], generator("locomotion"))
    is_plain = np.isclose(mixed.position, plain.position, atol=1e-5).all(axis=(1, 2))
    is_other = np.isclose(mixed.position, others.position, atol=1e-5).all(axis=(1, 2))
    assert (is_plain ^ is_other).all()
    assert abs(is_other.mean() - 0.3) < 0.09


def test_a_level_depends_on_its_key_and_number_alone() -> None:
    few = generate_levels(jax.random.key(5), 4, SIZES["m"], generator("locomotion"))
    for leaf, other in zip(jax.tree.leaves(few), jax.tree.leaves(levels_of("m")), strict=True):
        np.testing.assert_allclose(leaf, other[:4], rtol=1e-5, atol=1e-5)


def test_what_cannot_be_drawn_is_refused_with_its_name() -> None:
    with pytest.raises(ValueError, match=r"locomotion_kinds has 'boat'; there are car, unicycle, walker, arm"):
        GeneratorConfig(locomotion_kinds=("car", "boat"))
    with pytest.raises(ValueError, match=r"locomotion_share is 1\.5; chances are 0 to 1"):
        GeneratorConfig(locomotion_share=1.5)
    cars = dataclasses.replace(generator("locomotion"), locomotion_kinds=("car",))
    with pytest.raises(ValueError, match=r"no kind of locomotion_kinds \('car',\) fits"):
        generate_level(jax.random.key(0), Capacity(polygons=5, circles=2, joints=1, thrusters=1), cars)
