"""Levels in a mirror: the engine plays them as the mirror image, by the same actions or those of wheels exchanged."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.level.level import WORLD_SIZE_M
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.variants import mirrored
from tests.level.random_levels import random_levels

NUM_LEVELS, STEPS = 64, 12


@pytest.fixture(scope="module")
def levels():
    """Random ones and the designed ones: with sliders, limits, joints at walls and velocities of their own."""
    env = Environment(EnvConfig(size="m", max_steps=10_000))
    drawn = random_levels("m", NUM_LEVELS, seed=5)
    designed, _ = load_level_set("all_designed_m", "m")
    both = jax.tree.map(lambda *xs: jnp.concatenate([jnp.asarray(x) for x in xs]), drawn, designed)
    return env, both, jax.jit(jax.vmap(mirrored))(both)


def colours_of_wheels(levels) -> np.ndarray:
    """[n, 4] motor colours that drive a circle that is joined to a polygon and moves."""
    moves = np.asarray(levels.scene.shapes.inverse_mass) > 0
    joints, polygons = jax.device_get(levels.scene.joints), levels.scene.shapes.num_vertices.shape[1]
    found = np.zeros((len(levels.angle), 4), bool)
    for world, joint in np.argwhere(joints.active & joints.motor_on & ~np.asarray(levels.motor_auto)):
        if joints.a[world, joint] < polygons <= joints.b[world, joint] and moves[world, joints.b[world, joint]]:
            assert joints.motor_speed[world, joint] > 0
            found[world, levels.motor_colour[world, joint]] = True
    return found


@pytest.mark.long
def test_the_mirror_image_moves_as_the_level_does(levels):
    env, plain, image = levels
    space, num_worlds = env.action_space, plain.position.shape[0]
    actions = jnp.stack([space.sample(jax.random.key(step), num_worlds) for step in range(STEPS)])
    has_wheel = colours_of_wheels(plain)
    assert 0.05 < has_wheel.mean() < 0.95
    turned = np.concatenate([has_wheel, np.zeros((num_worlds, 2), bool)], axis=1)
    exchanged = jnp.where(turned & (actions > 0), 3 - actions, actions)

    @jax.jit
    def play(levels, actions):
        prepared = env.prepare(levels)

        def step(state, action):
            state, obs, _, _, info = env.transition(prepared, state, action)
            return state, (obs.bodies[..., :4], info.solved, info.failed)

        return jax.lax.scan(step, env.reset(prepared)[0], actions)[1]

    (bodies, solved, failed), (seen, solved_there, failed_there) = play(plain, actions), play(image, exchanged)
    walls = 4
    x = np.concatenate([WORLD_SIZE_M - bodies[..., :1], bodies[..., 1:2], -bodies[..., 2:3], bodies[..., 3:4]], axis=-1)
    exists = np.asarray(plain.scene.shapes.active)[:, walls:]
    off = np.abs(np.asarray(seen) - x)[:, :, walls:, :2].max(axis=-1).max(axis=0) * exists
    # Corners come in another order, so rounding differs, and some contacts are chaotic.
    assert np.mean(off.max(axis=1) < 2e-3) > 0.95
    assert np.median(off) < 1e-5
    same = (np.asarray(solved) == solved_there).all(0) & (np.asarray(failed) == failed_there).all(0)
    assert same.mean() > 0.97


def test_twice_mirrored_is_the_level_itself(levels):
    _, plain, image = levels
    again = jax.jit(jax.vmap(mirrored))(image)
    for path, one in jax.tree_util.tree_leaves_with_path(plain):
        other = again
        for entry in path:
            other = getattr(other, entry.name)
        np.testing.assert_allclose(np.asarray(other, float), np.asarray(one, float), atol=2e-6, err_msg=str(path))


def test_left_is_right(levels):
    _, plain, image = levels
    movable = np.asarray(plain.scene.shapes.active) & (np.arange(plain.position.shape[1]) >= 4)
    np.testing.assert_allclose(
        np.asarray(image.position)[movable][:, 0], WORLD_SIZE_M - np.asarray(plain.position)[movable][:, 0], atol=1e-6
    )
    np.testing.assert_array_equal(image.shape_role, plain.shape_role)
