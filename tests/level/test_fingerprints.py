"""Random numbers under other settings of JAX, and fingerprints of the sets that are drawn from them."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import re
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.level import sets
from kinetix_dist.level.fingerprints import OtherLevelsError, check_fingerprint, fingerprint, known_fingerprints
from kinetix_dist.level.frontier import frontier_sets
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.sets import RANDOM_SETS, VARIED_SETS, load_level_set
from tests.helpers import REPOSITORY


@contextlib.contextmanager
def other_settings() -> Iterator[None]:
    """Unusual values of all settings that `jax.random` reads."""
    settings = {"jax_random_seed_offset": 5, "jax_high_dynamic_range_gumbel": True}
    usual = {name: getattr(jax.config, name) for name in settings}
    with jax.enable_x64(True), jax.default_prng_impl("rbg"), jax.threefry_partitionable(False):
        try:
            for name, value in settings.items():
                jax.config.update(name, value)
            yield
        finally:
            for name, value in usual.items():
                jax.config.update(name, value)


def draws(random: Any, key: Any) -> list[Any]:
    first, *others = random.split(key, 6)
    return [
        random.key_data(key),
        random.key_data(random.split(first)),
        random.key_data(random.fold_in(first, 7)),
        random.uniform(others[0], (3,), minval=-1.0, maxval=2.0),
        random.normal(others[1], (2, 2)),
        random.randint(others[2], (5,), 0, 1000),
        random.bits(others[3], (4,)),
        random.categorical(others[4], jnp.log(jnp.arange(1, 9, dtype=jnp.float32)), shape=(6,)),
    ]


@pytest.mark.parametrize("seed", [7, -3, 2**40 + 1])
def test_numbers_are_those_of_jax_by_default_under_all_settings(seed):
    expected = draws(jax.random, jax.random.key(seed))
    with other_settings():
        eager = draws(prng, prng.key(seed))
        traced = jax.jit(lambda seed: draws(prng, prng.key(seed)))(np.int64(seed).astype(np.int32))
    for one in (draws(prng, prng.key(seed)), eager, traced):
        for drawn, wanted in zip(one, expected, strict=True):
            assert drawn.dtype == wanted.dtype
            np.testing.assert_array_equal(drawn, wanted)


def test_nothing_else_draws_by_jax_random():
    for file in REPOSITORY.glob("kinetix_dist/**/*.py"):
        if file.name != "prng.py":
            nodes = list(ast.walk(ast.parse(file.read_text())))  # docstrings may show what a user writes
            used = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)}
            used |= {ast.unparse(node) for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))}
            assert not [name for name in used if re.search(r"\bjax\.random\b|from jax import .*random", name)], file


def test_a_stored_key_is_restored_under_all_settings():
    state = {"key": prng.key(5)}
    arrays = flatten_arrays(state)
    with other_settings():
        restored = unflatten_arrays(state, arrays)
    np.testing.assert_array_equal(prng.key_data(restored["key"]), prng.key_data(state["key"]))


@pytest.fixture(scope="module")
def drawn() -> Level:
    levels = generate_levels(prng.key(3), 64, SIZES["s"], GeneratorConfig())
    return jax.tree.map(np.asarray, levels)


def test_levels_are_the_same_under_all_settings(drawn):
    with other_settings():
        levels = generate_levels(prng.key(3), 64, SIZES["s"], GeneratorConfig())
    for one, other in zip(jax.tree.leaves(levels), jax.tree.leaves(drawn), strict=True):
        assert one.dtype == other.dtype
        if one.dtype == np.float32:  # other programs round the last bits differently
            np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-6)
        else:
            np.testing.assert_array_equal(one, other)


def test_a_fingerprint_takes_rounding_and_refuses_other_levels(drawn):
    known = fingerprint(drawn)
    check_fingerprint("mine", drawn, known)
    check_fingerprint("mine", jax.tree.map(lambda x: x[:5], drawn), known)  # the beginning of the set
    rounded = dataclasses.replace(drawn, position=drawn.position * np.float32(1 + 1e-6))
    check_fingerprint("mine", rounded, known)
    # Where one level more solves itself, all that follow move up by one.
    check_fingerprint("mine", jax.tree.map(lambda x: x[2:], drawn), known)
    # Two ways to be another set: other choices, and other positions.
    with pytest.raises(OtherLevelsError, match=r"'mine' comes out as other levels .* 63 of the first 64, mine_1 among"):
        role = drawn.shape_role.copy()
        role[1:, :] = (role[1:, :] + 1) % 4
        check_fingerprint("mine", dataclasses.replace(drawn, shape_role=role), known)
    with pytest.raises(OtherLevelsError):
        check_fingerprint("mine", dataclasses.replace(drawn, position=drawn.position + np.float32(0.05)), known)


def test_every_drawn_set_has_a_fingerprint_that_is_checked(monkeypatch):
    assert list(known_fingerprints()) == [*RANDOM_SETS, *VARIED_SETS]
    assert all(made.fingerprint for made in frontier_sets().values())
    load_level_set("random_s", num_levels=8)
    monkeypatch.setattr(sets, "held_out_key", lambda size, stream: prng.key(stream + 1))
    with pytest.raises(OtherLevelsError, match=r"'random_s' .* 8 of the first 8, random_s_0 among them \(JAX "):
        load_level_set("random_s", num_levels=8)
