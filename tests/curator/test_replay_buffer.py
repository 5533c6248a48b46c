"""Chances, scores and slots of the replay buffer, by hand-worked cases of the published formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import PlrConfig
from kinetix_dist.curator.replay_buffer import (
    NEVER,
    UNKNOWN,
    ReplayBuffer,
    empty_buffer,
    mean_by_slot,
    played_again,
    replay_chances,
    taken_in,
    with_returns,
)
from tests.curator.made import stand_in


def _buffer(score, *, last_played=None, born=None, num_updates=10):
    """Level i is the number 100 + i; a score of UNKNOWN is an empty slot."""
    score = jnp.asarray(score, jnp.float32)
    zeros = jnp.zeros(score.size, jnp.int32)
    return ReplayBuffer(
        levels=stand_in(100 + jnp.arange(score.size)),
        score=score,
        best_return=score,
        born=jnp.where(score > UNKNOWN, 0, NEVER) if born is None else jnp.asarray(born),
        last_played=zeros if last_played is None else jnp.asarray(last_played),
        num_updates=jnp.int32(num_updates),
    )


def test_chances_fall_with_the_rank_and_the_faster_the_lower_the_temperature():
    buffer = _buffer([0.1, 0.4, 0.2])  # ranks 3, 1, 2
    plain = replay_chances(buffer, PlrConfig(temperature=1.0, staleness=0.0))
    np.testing.assert_allclose(plain, np.array([1 / 3, 1, 1 / 2]) / (11 / 6), rtol=1e-6)
    sharp = replay_chances(buffer, PlrConfig(temperature=0.5, staleness=0.0))
    np.testing.assert_allclose(sharp, np.array([1 / 9, 1, 1 / 4]) / (49 / 36), rtol=1e-6)


def test_of_the_top_k_all_are_alike_and_others_are_never_drawn():
    chances = replay_chances(_buffer([0.1, 0.4, 0.2, 0.0]), PlrConfig(prioritisation="top_k", top_k=2, staleness=0.0))
    np.testing.assert_allclose(chances, [0.0, 0.5, 0.5, 0.0])


def test_staleness_is_the_share_of_draws_by_how_long_ago_a_level_was_played():
    buffer = _buffer([0.2, 0.4], last_played=[9, 7])  # 1 and 3 updates ago; ranks 2 and 1
    np.testing.assert_allclose(replay_chances(buffer, PlrConfig(staleness=1.0)), [0.25, 0.75])
    mixed = replay_chances(buffer, PlrConfig(staleness=0.3, temperature=1.0))
    np.testing.assert_allclose(mixed, [0.7 / 3 + 0.3 / 4, 1.4 / 3 + 0.9 / 4], rtol=1e-6)


@pytest.mark.parametrize("config", [PlrConfig(), PlrConfig(prioritisation="top_k", top_k=9)])
def test_empty_places_are_never_drawn(config):
    chances = replay_chances(_buffer([UNKNOWN, 0.0, UNKNOWN]), config)
    np.testing.assert_allclose(chances, [0.0, 1.0, 0.0])
    assert not replay_chances(empty_buffer(stand_in(jnp.zeros(())), 4), config).any()


def test_a_level_gets_the_mean_score_of_the_worlds_that_played_it():
    buffer = _buffer([0.5, 0.5, 0.5], last_played=[1, 1, 1])
    slot, score = jnp.array([2, 0, 2, 0]), jnp.array([0.1, UNKNOWN, 0.3, 0.9])
    after = played_again(buffer, slot, score, jnp.array([True, True, True, False]))
    np.testing.assert_allclose(after.score, [0.5, 0.5, 0.2])  # of slot 0 nothing is known: it keeps its score
    np.testing.assert_array_equal(after.last_played, [10, 1, 10])


def test_the_best_return_of_a_level_is_that_of_all_its_worlds_so_far():
    buffer = _buffer([0.5, 0.1])  # best returns are the same numbers
    slot, is_there = jnp.array([0, 1, 1, 1]), jnp.array([True, True, True, False])
    after, of_world = with_returns(buffer, slot, jnp.array([0.2, UNKNOWN, 0.7, 0.9]), is_there)
    np.testing.assert_allclose(after.best_return, [0.5, 0.7])
    np.testing.assert_allclose(of_world, [0.5, 0.7, 0.7, 0.9])


def test_means_by_place_are_those_of_numpy():
    random = np.random.default_rng(0)
    slot, value = random.integers(0, 8, 50), random.random(50).astype(np.float32)
    mean, is_known = jax.jit(mean_by_slot, static_argnums=2)(jnp.asarray(slot), jnp.asarray(value), 7)  # 7: none
    for number in range(7):
        assert is_known[number] == (slot == number).any()
        assert float(mean[number]) == pytest.approx(value[slot == number].mean(), rel=1e-6)


def test_the_best_new_levels_take_empty_places_and_then_those_least_likely_to_be_played():
    config = PlrConfig(staleness=0.0)
    buffer = _buffer([0.5, UNKNOWN, 0.1, 0.3])
    levels, is_new = stand_in(jnp.arange(5)), jnp.array([True, True, True, True, False])
    after = taken_in(buffer, levels, jnp.array([0.2, 0.6, 0.4, 0.05, 0.9]), jnp.arange(5.0), is_new, config)
    # 0.6 -> the empty slot; 0.4 > 0.1; 0.2 < 0.3 stays out, as does what is not new
    np.testing.assert_array_equal(after.levels, [100, 1, 2, 103])
    np.testing.assert_allclose(after.score, [0.5, 0.6, 0.4, 0.3])
    np.testing.assert_allclose(after.best_return, [0.5, 1.0, 2.0, 0.3])
    np.testing.assert_array_equal(after.born, [0, 10, 10, 0])


def test_a_level_that_nobody_played_for_long_is_likely_and_keeps_its_place():
    buffer = _buffer([0.1, 0.2], last_played=[0, 9])
    after = taken_in(
        buffer, stand_in(jnp.arange(1)), jnp.array([0.3]), jnp.zeros(1), jnp.array([True]), PlrConfig(staleness=0.9)
    )
    np.testing.assert_array_equal(after.levels, [100, 0])  # chances: .9 x 10/11 for the old one


def test_new_levels_of_which_nothing_is_known_take_no_slot():
    buffer = empty_buffer(stand_in(jnp.zeros((), jnp.int32)), 3)
    score = jnp.array([UNKNOWN, jnp.nan])
    after = taken_in(buffer, stand_in(jnp.arange(2)), score, score, jnp.ones(2, bool), PlrConfig())
    assert not after.is_filled.any()
    assert after.score.max() == UNKNOWN


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"prioritisation": "best"}, "'best'; choose one of rank, top_k"),
        ({"temperature": 0.0}, "temperature is 0.0; it must be above 0"),
        ({"top_k": 0}, "top_k is 0"),
        ({"staleness": 1.5}, "staleness is 1.5; it must be from 0 to 1"),
    ],
)
def test_settings_out_of_range_are_refused_with_their_value(fields, message):
    with pytest.raises(ValueError, match=message):
        PlrConfig(**fields)
