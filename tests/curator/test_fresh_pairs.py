"""Pairs of worlds that play the same fresh level: who they are, and p (1 - p) of what they solve, against a known p."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig, SlicesConfig
from kinetix_dist.curator.curriculum import CurriculumTools
from kinetix_dist.curator.fresh_pairs import NO_COPY, is_copy, pair_learnability, with_pair
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.curator.slice_buffer import filled
from tests.curator.made import curriculum_of, played, stand_in
from tests.helpers import present

GROUPS, FRESH, BEFORE = 3000, 5, 3
SLICES = SlicesConfig(slice_size=4, num_harvested=8, attempts=(2, 8), keep_one_of=(2,), window=8)


@pytest.fixture(scope="module")
def pairs():
    """(levels [groups, fresh], copy_of [groups, worlds]) of levels that are their numbers in the group."""
    levels = jnp.broadcast_to(jnp.arange(FRESH), (GROUPS, FRESH))
    levels, copy_of = jax.jit(with_pair, static_argnums=2)(jax.random.split(jax.random.key(0), GROUPS), levels, BEFORE)
    return np.asarray(levels), np.asarray(copy_of).reshape(GROUPS, BEFORE + FRESH)


def test_one_fresh_world_of_each_group_plays_the_level_of_another_one(pairs):
    levels, copy_of = pairs
    assert (copy_of[:, :BEFORE] == NO_COPY).all() and (np.sum(copy_of != NO_COPY, axis=1) == 1).all()
    fresh = copy_of[:, BEFORE:]
    own = np.broadcast_to(np.arange(FRESH), fresh.shape)
    np.testing.assert_array_equal(levels, np.where(fresh == NO_COPY, own, fresh - BEFORE))
    assert [len(set(row)) for row in levels.tolist()] == [FRESH - 1] * GROUPS


def test_every_fresh_level_is_played_twice_and_left_out_equally_often(pairs):
    """So a level of any size, and one at the end of a group, has the same weight."""
    fresh = pairs[1][:, BEFORE:]
    group, copies = np.nonzero(fresh != NO_COPY)
    for worlds in (fresh[group, copies] - BEFORE, copies):
        share = np.bincount(worlds, minlength=FRESH) / GROUPS
        # Four standard errors of a share of 1/5 in 3,000 groups: 0.029.
        np.testing.assert_allclose(share, 1 / FRESH, atol=4 * np.sqrt(0.2 * 0.8 / GROUPS))


def test_the_pair_of_a_group_does_not_depend_on_other_groups(pairs):
    keys = jax.random.split(jax.random.key(0), GROUPS)[7:9]
    levels, copy_of = with_pair(keys, stand_in(jnp.broadcast_to(jnp.arange(FRESH), (2, FRESH))), BEFORE)
    np.testing.assert_array_equal(levels, pairs[0][7:9])
    np.testing.assert_array_equal(present(copy_of).reshape(2, -1), pairs[1][7:9])


def test_a_group_with_one_fresh_level_has_no_pair():
    levels = stand_in(jnp.arange(4.0)[:, None])
    same, copy_of = with_pair(jax.random.split(jax.random.key(0), 4), levels, 1)
    assert same is levels and copy_of is None and not is_copy(copy_of)


def test_the_estimate_has_the_mean_p_1_minus_p_for_every_p():
    """Of two attempts at a level of p: 0, 1 and 2 are solved with (1 - p)^2, 2 p (1 - p) and p^2."""
    for p in (0.0, 0.1, 0.5, 0.9, 1.0):
        expected = np.array([(1 - p) ** 2, 2 * p * (1 - p), p**2])
        assert pair_learnability(expected) == pytest.approx(p * (1 - p))
        # As a mean over pairs: s (2 - s) / 2.
        assert sum(chance * s * (2 - s) / 2 for s, chance in enumerate(expected)) == pytest.approx(p * (1 - p))
    assert np.isnan(pair_learnability(np.zeros(3)))


class _Tools(CurriculumTools):
    """Levels are numbers, the chances with which they are solved."""

    def draw_fresh(self, group_keys, levels_per_group) -> Any:
        return jax.vmap(lambda key: jax.random.uniform(key, (levels_per_group,)))(group_keys).reshape(-1)


def _proposal(name, state=None, share=0.5):
    """Of four groups of eight worlds."""
    slices = dataclasses.replace(SLICES, num_harvested=8 if share < 1 else 0)
    config = CurriculumConfig(
        name=name, buffer_size=8, num_candidates=16, scoring_batch=8, slices=slices, buffer_share=share
    )
    curriculum = curriculum_of(config, 8, _Tools)
    keys = jax.random.split(jax.random.key(5), 4)
    return curriculum, curriculum.propose(state, keys, jnp.arange(4))


@pytest.mark.parametrize("share", [0.5, 0.875, 1.0])
@pytest.mark.parametrize("name", ["sfl", "sfl_slices", "domain_randomization"])
def test_pairs_are_proposed_where_a_group_has_two_fresh_levels(name, share):
    buffer = _buffer(name)
    curriculum, proposal = _proposal(name, buffer, share=share)
    num_fresh = curriculum.num_fresh(curriculum.tools.config, 8)
    if num_fresh < 2:
        assert proposal.copy_of is None
        return
    copy_of, levels = (np.asarray(x).reshape(4, 8) for x in (proposal.copy_of, proposal.levels))
    group, copies = np.nonzero(copy_of != NO_COPY)
    originals = copy_of[group, copies]
    assert group.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(levels[group, copies], levels[group, originals])
    assert (copies >= 8 - num_fresh).all() and (originals >= 8 - num_fresh).all() and (copies != originals).all()
    if proposal.source is not None:
        source = np.asarray(proposal.source).reshape(4, 8)
        assert (source[group, copies] == curriculum.sources.index("fresh")).all()


def _buffer(name):
    """State of which levels are all -1."""
    if name == "domain_randomization":
        return None
    count, number = jnp.zeros(8, jnp.int32), jnp.float32(0)
    buffer = LevelBuffer(
        levels=stand_in(jnp.full(8, -1.0)),
        candidate=count,
        score=count.astype(jnp.float32),
        num_solved=count,
        num_finished=count,
        policy_version=jnp.int32(0),
        mean_candidate_score=number,
        learnable_share=number,
    )
    return filled(buffer, SLICES) if name == "sfl_slices" else buffer


def test_a_level_that_both_worlds_of_a_pair_solved_is_one_candidate():
    """Everything is solved: 16 fresh worlds play 12 levels, of which 4 are played twice."""
    curriculum, proposal = _proposal("sfl_slices", _buffer("sfl_slices"))
    solved = played(jnp.ones(32), jax.random.key(0), 1)
    state = curriculum.observe(_buffer("sfl_slices"), proposal, solved)
    copies = np.asarray(proposal.copy_of) != NO_COPY
    own = np.asarray(proposal.levels)[(np.asarray(proposal.tags["slot"]) < 0) & ~copies]
    np.testing.assert_array_equal(state.harvest.levels, own[:8])
    assert len(set(np.asarray(state.harvest.levels).tolist())) == 8
