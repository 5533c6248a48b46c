"""Bodies under a goal that they cannot touch: every level is valid, still at its start, and of the requested kind."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.engine import Engine
from jax2d.scene import Controls
from kinetix_dist.level.goal_following import (
    GOAL_HEIGHT_M,
    MORPHOLOGIES,
    GoalFollowingLevels,
    generate_goal_following_level,
)
from kinetix_dist.level.level import NUM_WALLS, SIZES, Level, Role
from kinetix_dist.level.statistics import overlaps
from tests.level.valid import assert_valid

NUM_LEVELS = 256
SIZE_OF = {"car": "m", "snake": "l", "thrusters": "m", "random": "m"}


def levels_of(morphology: str) -> Level:
    generator = GoalFollowingLevels(SIZES[SIZE_OF[morphology]], morphology)
    return jax.tree.map(np.asarray, jax.jit(generator.generate, static_argnums=1)(jax.random.key(2), NUM_LEVELS))


@pytest.mark.parametrize("morphology", MORPHOLOGIES)
def test_a_body_in_the_middle_and_a_goal_above_that_nothing_touches(morphology: str) -> None:
    levels, capacity = levels_of(morphology), SIZES[SIZE_OF[morphology]]
    assert_valid(levels, capacity, may_touch=False)
    shapes = levels.scene.shapes
    overlap = overlaps(levels)
    assert not (overlap & shapes.can_touch).any()
    assert not overlap[:, :NUM_WALLS, NUM_WALLS:].any()
    is_blue = shapes.active & (levels.shape_role == Role.BLUE)
    assert not shapes.can_touch[is_blue][:, NUM_WALLS:].any()
    goal = levels.position[is_blue]
    np.testing.assert_allclose(goal[:, 1], GOAL_HEIGHT_M)
    assert goal[:, 0].min() < 0.7 and goal[:, 0].max() > 4.3 and abs(goal[:, 0].mean() - 2.5) < 0.3
    moves = shapes.active & (shapes.inverse_mass > 0)
    counts = {"car": {3}, "snake": {5}, "thrusters": {1}, "random": {3}}
    assert set(moves.sum(axis=1)) == counts[morphology]
    joints = {"car": {2}, "snake": {4}, "thrusters": {0}, "random": {2}}
    assert set(levels.scene.joints.active.sum(axis=1)) == joints[morphology]
    middle = [np.mean(position[moving, 0]) for position, moving in zip(levels.position, moves, strict=True)]
    np.testing.assert_allclose(middle, 2.5, atol=0.6)
    # All of a body is one: nothing in it touches another part of it.
    assert not (shapes.can_touch & moves[:, :, None] & moves[:, None, :]).any()


def test_random_bodies_are_of_boxes_and_wheels_in_chains_and_stars() -> None:
    levels = levels_of("random")
    polygons = SIZES["m"].polygons
    num_boxes = (levels.scene.shapes.active & (levels.scene.shapes.inverse_mass > 0))[:, :polygons].sum(axis=1)
    assert 0.35 < (num_boxes == 2).mean() < 0.65
    root = np.argmax(levels.shape_role == Role.GREEN, axis=1)
    joints = levels.scene.joints
    at_root = ((joints.a == root[:, None]) | (joints.b == root[:, None])).sum(axis=1)
    assert set(at_root) == {1, 2}  # a wheel at the end of the link, or both on the root


def test_both_thrusters_lift_the_box_and_one_alone_pushes_it_aside() -> None:
    levels = jax.tree.map(jnp.asarray, levels_of("thrusters"))
    engine = Engine(SIZES["m"])
    start = engine.initial_state(levels.scene, levels.position, levels.angle)
    green = np.asarray(levels.shape_role == Role.GREEN)
    before = np.asarray(levels.position)[green]

    def after(*thrust: float) -> np.ndarray:
        by_colour = jnp.asarray(thrust)[levels.thruster_colour]
        controls = Controls(motor=jnp.zeros((NUM_LEVELS, 2)), thruster=by_colour)
        state, _ = engine.step(levels.scene, start, controls, num_steps=40)
        return np.asarray(state.position)[green] - before

    assert (after(1.0, 1.0)[:, 1] > 0.3).all()
    assert (after(0.0, 0.0)[:, 1] < 0.0).all()
    assert (np.abs(after(1.0, 0.0)[:, 0]) > 0.02).mean() > 0.9


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match=r"unknown morphology 'boat'; there are car, snake, thrusters, random"):
        generate_goal_following_level(jax.random.key(0), SIZES["m"], "boat")
    with pytest.raises(ValueError, match=r"'snake' needs 5 polygons, there are 2; use a larger size"):
        generate_goal_following_level(jax.random.key(0), SIZES["m"], "snake")
    with pytest.raises(dataclasses.FrozenInstanceError):
        GoalFollowingLevels(SIZES["m"], "car").morphology = "snake"  # type: ignore[misc]
