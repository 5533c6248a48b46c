"""The exported generator: levels are those of the traced one, in any program, and a second process reads it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from kinetix_dist.learner.sharding import data_mesh, on_devices
from kinetix_dist.level import generator_program
from kinetix_dist.level.generator import generate_levels, level_keys
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.generator_program import draw_levels
from kinetix_dist.level.level import SIZES, Level
from tests.helpers import compile_cache

pytestmark = pytest.mark.long

CONFIG = GeneratorConfig(mechanism_share=0.5, mechanism_families=("arm",), varied_share=0.5)
CAPACITY = SIZES["s"]
KEY = jax.random.key(7)


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    generator_program._program.cache_clear()
    with compile_cache(tmp_path):
        yield tmp_path / generator_program.CACHE
    generator_program._program.cache_clear()


def assert_same_levels(levels: Level, expected: Level) -> None:
    """Other programs round the last bits differently."""
    assert jax.tree.structure(levels) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(levels), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("number", [1, 48])
def test_exported_levels_are_those_of_the_generator(number: int) -> None:
    levels = jax.jit(lambda keys: draw_levels(keys, CAPACITY, CONFIG))(level_keys(KEY, number))
    assert_same_levels(levels, generate_levels(KEY, number, CAPACITY, CONFIG))


def test_it_is_traced_once_where_devices_share_worlds_and_read_by_the_next_process(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    traced = []
    generate_level = generator_program.generate_level
    monkeypatch.setattr(generator_program, "generate_level", lambda *args: traced.append(0) or generate_level(*args))

    def draw(keys: jax.Array) -> Level:
        return draw_levels(keys, CAPACITY, CONFIG)

    # First of all inside of a program for a mesh.
    of_worlds = PartitionSpec("data")
    on_mesh = jax.jit(on_devices(draw, data_mesh(), in_specs=(of_worlds,), out_specs=of_worlds))
    keys = level_keys(KEY, 8 * jax.device_count())
    first = on_mesh(keys)
    jax.jit(draw)(keys[: keys.size // jax.device_count()])
    assert len(traced) == 1
    (file,) = cache.iterdir()
    content = file.read_bytes()

    generator_program._program.cache_clear()  # as another process
    assert_same_levels(jax.jit(lambda keys: draw(keys))(keys[:8]), jax.tree.map(lambda x: x[:8], first))
    assert len(traced) == 1
    file.write_bytes(content[:-1])
    generator_program._program.cache_clear()
    assert_same_levels(jax.jit(lambda keys: draw(keys))(keys[:8]), jax.tree.map(lambda x: x[:8], first))
    assert len(traced) == 2 and file.read_bytes() == content


def test_another_generator_is_another_program(cache: Path) -> None:
    keys = level_keys(KEY, 2)
    draw_levels(keys, CAPACITY, GeneratorConfig())
    draw_levels(keys, CAPACITY, dataclasses.replace(GeneratorConfig(), triangle_chance=0.5))
    assert len(list(cache.iterdir())) == 2


def test_another_setting_of_jax_is_another_program_that_draws_the_same_levels(cache: Path) -> None:
    """A context manager may set it, too: the program is traced in a thread, which does not inherit that."""
    keys, config = level_keys(KEY, 4), GeneratorConfig()
    with jax.threefry_partitionable(False):
        other = draw_levels(keys, CAPACITY, config)
        assert_same_levels(other, generate_levels(KEY, 4, CAPACITY, config))
    usual = draw_levels(keys, CAPACITY, config)
    assert_same_levels(usual, other)
    with jax.enable_x64(True):
        draw_levels(keys, CAPACITY, config)
    assert len(list(cache.iterdir())) == 3
