"""The exported update: bit for bit the traced one, and a second process reads it instead of tracing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from kinetix_dist import program_cache
from kinetix_dist.env.action_spaces.categorical import Categorical
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner import update as module
from kinetix_dist.learner.sharding import data_mesh, local_values
from kinetix_dist.learner.update import CACHE, Update, exported_update, make_update
from tests.helpers import compile_cache
from tests.learner.update_program import PPO, make_problem, place, poisoned

pytestmark = pytest.mark.long


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    exported_update.cache_clear()
    with compile_cache(tmp_path):
        yield tmp_path / CACHE
    exported_update.cache_clear()


@pytest.fixture
def mesh() -> Mesh:
    return data_mesh(jax.devices()[:1])


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One element for each time that an update is traced."""
    found: list[int] = []

    def counting(*arguments: Any, **named: Any) -> Update:
        update = make_update(*arguments, **named)

        def counted(state: Any, static: Any, trajectory: Any, last_value: Any) -> Any:
            found.append(0)
            return update(state, static, trajectory, last_value)

        return counted

    monkeypatch.setattr(module, "make_update", counting)
    return found


def as_another_process(mesh: Mesh, *, make: Callable[..., Update] = exported_update, **given: Any) -> Any:
    exported_update.cache_clear()
    update, state, arguments = make_problem(mesh, make=make, **given)
    return update(state, *place(arguments, mesh))


def assert_same_bits(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(local_values(found)), jax.tree.leaves(local_values(expected)), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_two_updates_are_those_of_the_traced_program_bit_for_bit(cache: Path, mesh: Mesh) -> None:
    update, state, arguments = make_problem(mesh)
    program, own, _ = make_problem(mesh, make=exported_update)
    for batch in (arguments, poisoned(arguments)):
        worlds = place(batch, mesh)
        state, expected = update(state, *worlds)
        own, metrics = program(own, *worlds)
        assert_same_bits((own, metrics), (state, expected))
    assert len(list(cache.iterdir())) == 1


def test_it_is_traced_once_and_read_by_the_next_process(cache: Path, mesh: Mesh, traced: list[int]) -> None:
    first = as_another_process(mesh)
    (file,) = cache.iterdir()
    content = file.read_bytes()
    assert_same_bits(as_another_process(mesh), first)
    assert len(traced) == 1
    file.write_bytes(content[:-1])
    assert_same_bits(as_another_process(mesh), first)
    assert len(traced) == 2
    assert file.read_bytes() == content


def test_what_changes_an_update_makes_another_program(
    cache: Path, mesh: Mesh, traced: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_another(**given: Any) -> bool:
        before = len(traced)
        as_another_process(mesh, **given)
        return len(traced) > before

    assert is_another()
    assert not is_another()
    assert is_another(config=dataclasses.replace(PPO, clip=0.1))
    with monkeypatch.context() as patch:
        patch.setattr(program_cache, "_versions", lambda: ("0.0.1",))
        assert is_another()
    assert not is_another()


def test_other_parts_of_the_same_class_make_another_program(cache: Path, mesh: Mesh, traced: list[int]) -> None:
    """A space that a user's program registers may have the name of one that it registered before."""

    def make(policy: Any, observation: Any, distribution: Categorical, *others: Any, **named: Any) -> Update:
        distribution = dataclasses.replace(distribution, head_sizes=(9, *distribution.head_sizes[1:]))
        return exported_update(policy, observation, distribution, *others, **named)

    as_another_process(mesh)
    as_another_process(mesh, make=make)
    assert len(traced) == 2


def test_a_part_of_a_user_is_traced_in_every_process(cache: Path, mesh: Mesh) -> None:
    class Own(type(OBSERVATIONS["entity"])):  # type: ignore[misc]
        """Its code may change, and no file of the cache would be another."""

    def make(policy: Any, observation: Any, *others: Any, **named: Any) -> Update:
        return exported_update(policy, Own(), *others, **named)

    assert_same_bits(as_another_process(mesh, make=make), as_another_process(mesh, make=make_update))
    assert not cache.exists()
