"""Mutators keep levels valid: hundreds of levels, changed many times, pass the checks that files and engines have."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from kinetix_dist.level.generator import GeneratorConfig, generate_levels
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.mutators import MUTATORS, apply, mutate
from kinetix_dist.level.walls import empty_level
from tests.level.valid import assert_valid

SIZE = "m"
CAPACITY, CONFIG = SIZES[SIZE], GeneratorConfig()
NUM_LEVELS = 256


@functools.cache
def generated() -> Level:
    return jax.tree.map(np.asarray, generate_levels(jax.random.key(3), NUM_LEVELS, CAPACITY, CONFIG))


@functools.cache
def mutated(name: str) -> tuple[Level, np.ndarray]:
    """Levels after one mutator, or after 24 of any kind, and which of them changed."""
    if name == "any":
        one = jax.vmap(lambda key, level: mutate(key, level, CAPACITY, CONFIG, num_changes=24))
    else:
        one = jax.vmap(lambda key, level: apply(name, key, level, CAPACITY, CONFIG))
    keys = jax.random.split(jax.random.key(5), NUM_LEVELS)
    return jax.tree.map(np.asarray, jax.jit(one)(keys, generated()))


@pytest.mark.parametrize("name", [*MUTATORS, "any"])
def test_a_changed_level_is_valid(name: str):
    level, changed = mutated(name)
    assert_valid(level, CAPACITY, may_touch=False)  # a mutator may fix green and blue
    assert changed.mean() > (0.05 if name in ("add_shape", "add_joined_shape") else 0.15)


@pytest.mark.parametrize("name", [*MUTATORS])
def test_where_nothing_can_change_the_level_stays_to_the_bit(name: str):
    level, changed = mutated(name)
    for after, before in zip(jax.tree.leaves(level), jax.tree.leaves(generated()), strict=True):
        np.testing.assert_array_equal(after[~changed], before[~changed])


def test_each_mutator_changes_what_it_says():
    before = generated()

    def counts(level: Level) -> dict[str, np.ndarray]:
        scene = level.scene
        return {
            "shapes": scene.shapes.active.sum(1),
            "joints": scene.joints.active.sum(1),
            "thrusters": scene.thrusters.active.sum(1),
            "fixed": (scene.shapes.active & (scene.shapes.inverse_mass == 0)).sum(1),
        }

    expected = {
        "add_shape": {"shapes": 1},
        "add_joined_shape": {"shapes": 1, "joints": 1},
        "remove_shape": {"shapes": -1},
        "remove_joint": {"joints": -1},
        "add_thruster": {"thrusters": 1},
        "remove_thruster": {"thrusters": -1},
    }
    for name, differences in expected.items():
        level, changed = mutated(name)
        for what, difference in differences.items():
            np.testing.assert_array_equal((counts(level)[what] - counts(before)[what])[changed], difference)
    level, changed = mutated("toggle_fixed")
    assert (np.abs(counts(level)["fixed"] - counts(before)["fixed"])[changed] == 1).all()
    level, changed = mutated("swap_roles")
    assert (level.shape_role != before.shape_role)[changed].any(1).all()


@pytest.mark.long
def test_a_full_level_takes_no_more_and_an_empty_one_loses_nothing():
    for name in ("add_shape", "add_joined_shape"):
        once = jax.vmap(lambda key, level, name=name: apply(name, key, level, CAPACITY, CONFIG))
        level, changed = generated(), np.zeros(NUM_LEVELS, bool)
        for seed in range(CAPACITY.shapes):
            level, changed = jax.jit(once)(jax.random.split(jax.random.key(seed), NUM_LEVELS), level)
        if name == "add_shape":
            assert np.asarray(level.scene.shapes.active).all() and not np.asarray(changed).any()
        else:
            room = ~np.asarray(level.scene.joints.active).all(1) & ~np.asarray(level.scene.shapes.active).all(1)
            assert not np.asarray(changed)[~room].any()
    none = empty_level(CAPACITY)
    for name in ("remove_shape", "remove_joint", "remove_thruster", "add_thruster", "toggle_fixed", "change_size"):
        level, changed = apply(name, jax.random.key(0), none, CAPACITY, CONFIG)
        assert not changed
        np.testing.assert_array_equal(level.scene.shapes.active, none.scene.shapes.active)


@pytest.mark.long
def test_the_same_key_makes_the_same_changes():
    level = jax.tree.map(lambda x: x[0], generated())
    one, _ = mutate(jax.random.key(1), level, CAPACITY, CONFIG, num_changes=4)
    two, _ = mutate(jax.random.key(1), level, CAPACITY, CONFIG, num_changes=4)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


def test_wrong_requests_are_refused():
    level = jax.tree.map(lambda x: x[0], generated())
    with pytest.raises(ValueError, match=r"^num_changes is 0; give 1 or more$"):
        mutate(jax.random.key(1), level, CAPACITY, CONFIG, num_changes=0)
    with pytest.raises(ValueError, match=r"^there is no mutator 'grow'; there are add_shape, "):
        apply("grow", jax.random.key(1), level, CAPACITY, CONFIG)
