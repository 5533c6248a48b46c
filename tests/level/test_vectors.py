"""Levels as vectors: nothing is lost on the way there and back, and whatever numbers come make a valid level."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, Role
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.vectors import (
    check_describable,
    from_vector,
    num_order_draws,
    overlaps_at_start,
    to_vector,
    vector_size,
)
from tests.level.valid import assert_valid

CONFIG = GeneratorConfig()
NUM_LEVELS = 512
SIZE = pytest.mark.parametrize("size", ["s", "m", pytest.param("l", marks=pytest.mark.slow)])


@functools.cache
def drawn(size):
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(1), NUM_LEVELS, SIZES[size], CONFIG))


@functools.cache
def to_vectors(size):
    return jax.jit(jax.vmap(lambda level: to_vector(level, SIZES[size], CONFIG)))


@functools.cache
def _decode(size):
    return jax.jit(jax.vmap(lambda vector, draws: from_vector(vector, draws, SIZES[size], CONFIG)))


def from_vectors(size, vectors):
    draws = jax.random.uniform(jax.random.key(2), (len(vectors), num_order_draws(SIZES[size])))
    return jax.tree.map(np.asarray, _decode(size)(vectors, draws))


@pytest.mark.long
@SIZE
def test_a_level_comes_back_from_its_vector_whatever_the_order_of_its_slots(size):
    vectors = to_vectors(size)(drawn(size))
    assert vectors.shape == (NUM_LEVELS, vector_size(SIZES[size]))
    assert np.abs(vectors).max() <= 1.0 + 1e-5
    again = to_vectors(size)(from_vectors(size, vectors))
    np.testing.assert_allclose(again, vectors, atol=1e-4)  # float32: angles, and bodies moved to their anchors


@SIZE
def test_the_level_that_comes_back_weighs_and_moves_as_before(size):
    """Masses and contact permissions, which vectors do not hold, follow from shapes."""
    level, back = drawn(size), from_vectors(size, to_vectors(size)(drawn(size)))
    for name in ("inverse_mass", "inverse_inertia"):
        ours, theirs = (np.sort(getattr(one.scene.shapes, name), axis=1) for one in (back, level))
        np.testing.assert_allclose(ours, theirs, rtol=1e-4)
    np.testing.assert_array_equal(*(one.scene.shapes.can_touch.sum((1, 2)) for one in (back, level)))
    np.testing.assert_allclose(
        *(np.sort(np.where(one.scene.thrusters.active, one.scene.thrusters.power, 0)) for one in (back, level)),
        rtol=1e-4,
    )


@SIZE
@pytest.mark.parametrize("scale", [0.3, 1.0, 100.0])
def test_any_numbers_make_a_valid_level(size, scale):
    vectors = scale * jax.random.normal(jax.random.key(3), (NUM_LEVELS, vector_size(SIZES[size])))
    level = from_vectors(size, vectors)
    assert_valid(level, SIZES[size])
    scene = level.scene
    assert ((scene.joints.active & scene.joints.motor_on).any(1) | scene.thrusters.active.any(1)).all()
    is_set = scene.shapes.active & ((level.shape_role == Role.GREEN) | (level.shape_role == Role.BLUE))
    assert (is_set & (scene.shapes.inverse_mass > 0)).any(1).all()
    if scale == 1.0:
        assert scene.joints.active.any() and not scene.joints.active.all()


def test_what_overlaps_is_seen():
    """No level of the generator does, and most of random numbers do."""
    overlaps = jax.jit(jax.vmap(lambda level: overlaps_at_start(level, SIZES["s"])))
    random = from_vectors("s", jax.random.normal(jax.random.key(3), (NUM_LEVELS, vector_size(SIZES["s"]))))
    assert not overlaps(drawn("s")).any()
    assert overlaps(random).mean() > 0.5


def test_levels_that_vectors_do_not_hold_are_refused():
    check_describable(drawn("m"))
    level = drawn("s")
    with pytest.raises(ValueError, match=r"^512 of 512 levels have speed at the start; vectors hold levels of"):
        check_describable(dataclasses.replace(level, velocity=level.velocity + 1.0))
    weightless = level.scene.replace(gravity=jnp.zeros_like(level.scene.gravity))
    with pytest.raises(ValueError, match=r"^512 of 512 levels have another gravity; "):
        check_describable(dataclasses.replace(level, scene=weightless))
    with pytest.raises(ValueError, match=r"levels have polygons that are no boxes; .* leave these out$"):
        check_describable(load_level_set("designed_m", "m")[0])
