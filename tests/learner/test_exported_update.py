"""The exported update: bit for bit the traced one, and a second process reads it instead of tracing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from kinetix_dist.learner.exported_update import KIND, exported_update
from kinetix_dist.learner.sharding import data_mesh, local_values
from kinetix_dist.telemetry import exported_program
from tests.learner.update_program import make_problem, place, poisoned


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    exported_update.cache_clear()
    yield tmp_path / KIND
    jax.config.update("jax_compilation_cache_dir", before)
    exported_update.cache_clear()


@pytest.fixture
def mesh() -> Mesh:
    return data_mesh(jax.devices()[:1])


def files(cache: Path) -> list[Path]:
    return sorted(cache.iterdir()) if cache.is_dir() else []


def assert_same_bits(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(local_values(found)), jax.tree.leaves(local_values(expected)), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_two_updates_are_those_of_the_traced_program_bit_for_bit(cache: Path, mesh: Mesh) -> None:
    update, state, arguments = make_problem(mesh)
    program = exported_update(update, "", mesh)
    own = state
    for batch in (arguments, poisoned(arguments)):
        worlds = place(batch, mesh)
        state, expected = update(state, *worlds)
        own, metrics = program(own, *worlds)
        assert_same_bits((own, metrics), (state, expected))
    assert len(files(cache)) == 1


def test_it_is_traced_once_and_read_by_the_next_process(cache: Path, mesh: Mesh) -> None:
    update, state, arguments = make_problem(mesh)
    traced = []

    def counted(*given: Any) -> Any:
        traced.append(0)
        return update(*given)

    def program() -> Any:
        exported_update.cache_clear()  # as another process
        return exported_update(counted, "", mesh)(state, *place(arguments, mesh))

    first = program()
    (file,) = files(cache)
    content = file.read_bytes()
    assert_same_bits(program(), first)
    assert len(traced) == 1
    file.write_bytes(content[:-1])
    assert_same_bits(program(), first)
    assert len(traced) == 2
    assert file.read_bytes() == content


def test_other_settings_shapes_and_modules_are_other_programs(
    cache: Path, mesh: Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(made_from: str, steps: int | None = None) -> int:
        update, state, arguments = make_problem(mesh)
        static, trajectory, last_value = arguments
        trajectory = jax.tree.map(lambda x: x[:steps], trajectory)
        exported_update(update, made_from, mesh)(state, *place((static, trajectory, last_value), mesh))
        return len(files(cache))

    assert run("one") == 1
    assert run("another") == 2
    assert run("one", steps=3) == 3
    assert run("one") == 3
    exported_update.cache_clear()
    monkeypatch.setattr(exported_program, "_SOURCES", "of a module that was changed")
    assert run("one") == 4


def test_a_program_that_gives_something_else_than_an_update_is_refused(mesh: Mesh) -> None:
    update, state, arguments = make_problem(mesh)

    def without_metrics(*given: Any) -> Any:
        return update(*given)[0], {}

    with pytest.raises(AssertionError, match="an update gives"):
        exported_update(without_metrics, "", mesh)(state, *place(arguments, mesh))
