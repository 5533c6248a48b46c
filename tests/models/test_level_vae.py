"""The generative model of levels: it keeps what it is shown, and draws new levels of the kind that it was shown."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from kinetix_dist.level.generator import LevelGenerator, RandomLevels, generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Role
from kinetix_dist.level.vectors import overlaps_at_start
from kinetix_dist.models.level_vae import VaeConfig, fit
from tests.level.valid import assert_valid

pytestmark = pytest.mark.long

OPTIMISED = True  # trains for thousands of steps: see tests/conftest.py

CAPACITY, CONFIG = SIZES["s"], GeneratorConfig()
NUM_SAMPLES = 256


def x_of(levels, role):
    """[L] m; NaN where no shape but the floor has the role."""
    is_it = levels.scene.shapes.active & (levels.shape_role == role)
    is_it[:, 0] = False
    return np.where(
        is_it.any(1), np.take_along_axis(levels.position[..., 0], is_it.argmax(1)[:, None], 1)[:, 0], np.nan
    )


def green_is_left(levels):
    """[L] bool: by more than 1 m, which one level of three is."""
    return x_of(levels, Role.BLUE) - x_of(levels, Role.GREEN) > 1.0


@functools.cache
def drawn():
    """(levels in which green is left, to train on; others of that kind; how many of all levels are of it)"""
    levels = jax.tree.map(np.asarray, generate_levels(jax.random.key(0), 16384, CAPACITY, CONFIG))
    is_left = green_is_left(levels)
    kind = jax.tree.map(lambda x: x[is_left], levels)
    return jax.tree.map(lambda x: x[256:], kind), jax.tree.map(lambda x: x[:256], kind), is_left.mean()


@functools.cache
def model():
    return fit(drawn()[0], jax.random.key(1), CAPACITY, CONFIG, VaeConfig(num_steps=2500))


def test_its_loss_falls():
    _, losses = model()
    assert np.isfinite(losses).all() and losses[-100:].mean() < 0.1 * losses[0]


def test_it_reconstructs_levels_that_it_never_saw():
    """Against the mean level as the guess, which is what a model that learned nothing gives."""
    held_out = drawn()[1]
    back = jax.tree.map(np.asarray, jax.jit(model()[0].reconstruct)(jax.random.key(2), held_out))
    assert_valid(back, CAPACITY)
    for role in (Role.GREEN, Role.BLUE):
        there, here = x_of(held_out, role), x_of(back, role)
        assert np.mean(np.abs(here - there)) < 0.2 * np.mean(np.abs(there - there.mean()))
    assert (back.scene.joints.active.any(1) == held_out.scene.joints.active.any(1)).mean() > 0.95


def test_samples_are_valid_new_and_of_the_kind_that_it_was_trained_on():
    train, _, usual_share = drawn()
    generator = model()[0]
    levels = jax.tree.map(np.asarray, jax.jit(generator.generate, static_argnums=1)(jax.random.key(3), NUM_SAMPLES))
    assert_valid(levels, CAPACITY)
    assert usual_share < 0.5 and green_is_left(levels).mean() > 0.65
    nearest = np.abs(levels.position[:, None] - train.position[None, :512]).max((2, 3)).min(1)
    assert np.median(nearest) > 0.01 * WORLD_SIZE_M
    overlaps = jax.vmap(lambda level: overlaps_at_start(level, CAPACITY))(levels)
    assert overlaps.mean() < 0.1
    joints = levels.scene.joints.active.any(1).mean()
    assert abs(joints - train.scene.joints.active.any(1).mean()) < 0.2


def test_the_generator_of_random_levels_has_the_same_interface():
    random: LevelGenerator = RandomLevels(CAPACITY, CONFIG)
    learned: LevelGenerator = model()[0]
    layouts = (jax.eval_shape(lambda one=one: one.generate(jax.random.key(0), 4)) for one in (random, learned))
    ours, theirs = (jax.tree.map(lambda x: (x.shape, x.dtype), layout) for layout in layouts)
    assert ours == theirs


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"num_steps": 0}, r"^VaeConfig.num_steps is 0; it must be 1 or more$"),
        ({"learning_rate": 0.0}, r"^VaeConfig has learning_rate 0.0, kl_coefficient 0.002; the one must be positive"),
    ],
)
def test_wrong_settings_are_refused(fields, said):
    with pytest.raises(ValueError, match=said):
        VaeConfig(**fields)
