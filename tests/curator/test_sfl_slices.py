"""Proposals, scores and buffer of `sfl_slices` on levels that are the chance with which the policy solves them."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig, SlicesConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.curator.sfl_slices import SflSlices
from kinetix_dist.curator.slice_buffer import Harvest
from tests.curator.made import curriculum_of, played

GROUPS, PER_GROUP, BATCH = 4, 8, 16
CONFIG = CurriculumConfig(
    name="sfl_slices",
    num_candidates=32,
    scoring_batch=BATCH,
    buffer_size=12,
    refresh_every=4,
    slices=SlicesConfig(slice_size=4, num_harvested=BATCH, attempts=(2, 8), keep_one_of=(2,), window=8),
)


class _Tools(CurriculumTools):
    def draw_fresh(self, group_keys, levels_per_group) -> Any:
        return jax.vmap(lambda key: jax.random.uniform(key, (levels_per_group,)))(group_keys).reshape(-1)


@pytest.fixture(scope="module")
def curriculum():
    def play(params, levels, key, num_steps):
        assert num_steps == 256
        return played(levels, key, 1)

    made = curriculum_of(CONFIG, PER_GROUP, _Tools, play=play)
    # Levels are numbers here: they have no features.
    assert isinstance(made, SflSlices)
    made._features = jax.jit(lambda levels: jnp.zeros((len(levels), 1), jnp.uint8))
    return made


def _refresh(curriculum, version, num_parts, given=None):
    parts = [
        curriculum.refresh_part(None, version, jax.random.key(version), part, num_parts, given)
        for part in range(num_parts)
    ]
    return curriculum.join(parts)


@pytest.fixture(scope="module")
def after_four(curriculum):
    """The state after a first refresh and four updates."""
    state = jax.device_get(curriculum.adopt(None, _refresh(curriculum, 0, 1)))
    propose, observe = jax.jit(curriculum.propose), jax.jit(curriculum.observe)
    for update in range(4):
        groups = jnp.arange(GROUPS)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(update), groups)
        proposal = propose(state, keys, groups)
        state = observe(state, proposal, played(proposal.levels, jax.random.key(100 + update), 1))
    return jax.device_get(state), proposal


def test_the_first_refresh_fills_the_buffer_and_later_ones_a_slice(curriculum):
    assert len(_refresh(curriculum, 0, 1).score) == 12
    assert len(_refresh(curriculum, 8, 1).score) == 4


@pytest.mark.parametrize(("version", "num_parts"), [(0, 4), (0, 6), (4, 2)])
def test_a_refresh_is_the_same_however_many_share_it(curriculum, version, num_parts):
    jax.tree.map(
        np.testing.assert_array_equal, _refresh(curriculum, version, num_parts), _refresh(curriculum, version, 1)
    )


def test_half_of_a_group_plays_the_buffer_and_its_plays_are_counted(after_four):
    state, proposal = after_four
    slot = np.asarray(proposal.tags["slot"]).reshape(GROUPS, PER_GROUP)
    assert (slot[:, :4] >= 0).all() and (slot[:, 4:] == -1).all()
    np.testing.assert_array_equal(
        np.asarray(proposal.levels).reshape(GROUPS, PER_GROUP)[:, :4], state.levels[slot[:, :4]]
    )
    assert state.num_plays.sum() == 4 * GROUPS * PER_GROUP // 2 and state.num_updates == 4


def test_fresh_levels_that_were_solved_have_had_one_attempt(curriculum, after_four):
    state, _ = after_four
    given = jax.device_get(curriculum.refresh_input(state))
    assert given["count"] == BATCH  # 64 fresh levels, half of them solved
    requested = []
    counted = curriculum._play

    def play(params, levels, number, key):
        requested.append(np.asarray(levels))
        return counted(params, levels, number, key)

    curriculum._play = play
    try:
        part = curriculum.refresh_part(None, 4, jax.random.key(4), 0, 1, given)
    finally:
        curriculum._play = counted
    is_harvested = [np.array_equal(levels, given["levels"]) for levels in requested]
    # One launch less for the batch from training: 1 + 3 of it, 2 + 3 of the other.
    assert is_harvested == [True] * 4 + [False] * 5
    assert (part.num_solved[:BATCH] >= 1).all() and set(part.num_finished.tolist()) == {2, 8}


def test_levels_solved_before_the_last_refresh_was_asked_for_are_no_candidates_again(curriculum, after_four):
    state, _ = after_four
    old = dataclasses.replace(state, num_updates=np.int32(8))
    assert jax.device_get(curriculum.refresh_input(old))["count"] == 0
    some = Harvest(levels=state.harvest.levels, solved_at=np.where(np.arange(BATCH) < 3, 5, 2))
    assert jax.device_get(curriculum.refresh_input(dataclasses.replace(old, harvest=some)))["count"] == 3


@pytest.mark.parametrize(
    ("fields", "slices", "message"),
    [
        ({"buffer_size": 10}, {}, "buffer_size 10 is not a multiple of slices.slice_size 4"),
        ({}, {"keep_one_of": (16,)}, "of 32 candidates 2 are left in the last round"),
        ({}, {"num_harvested": 8}, "num_harvested is 8; it must be a multiple of scoring_batch 16"),
        ({}, {"num_harvested": 48}, "up to num_candidates 32"),
        ({"buffer_share": 1.0}, {}, "no fresh level is played"),
        ({}, {"attempts": (2, 2)}, "numbers that rise"),
        ({}, {"keep_one_of": (2, 2)}, "a number of 1 or more between each two"),
        ({}, {"leave_below": 0.95}, "they must rise"),
        ({}, {"window": 0}, "window is 0"),
    ],
)
def test_settings_that_cannot_run_are_refused_with_their_numbers(fields, slices, message):
    with pytest.raises(ValueError, match=message):
        config = dataclasses.replace(CONFIG, slices=dataclasses.replace(CONFIG.slices, **slices), **fields)
        curriculum_class(config, PER_GROUP)


def test_a_buffer_may_be_larger_than_the_candidates_of_a_slice():
    config = dataclasses.replace(CONFIG, buffer_size=64)
    assert curriculum_class(config, PER_GROUP) is SflSlices
