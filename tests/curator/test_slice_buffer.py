"""The buffer that is renewed in slices, by hand-worked cases: a level is a number."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import SlicesConfig
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.curator.slice_buffer import (
    IN_USE,
    MASTERED,
    NEVER,
    OUT_OF_REACH,
    Harvest,
    draw_slots,
    filled,
    harvested,
    played,
    recent,
    slice_metrics,
    with_slice,
)
from tests.curator.made import stand_in

CONFIG = SlicesConfig(slice_size=2, window=4, num_harvested=3)


def _chosen(levels, version=0):
    count = np.ones(len(levels), np.int32)
    return LevelBuffer(
        levels=stand_in(np.asarray(levels)),
        candidate=count,
        score=count.astype(np.float32),
        num_solved=count,
        num_finished=2 * count,
        policy_version=np.int32(version),
        mean_candidate_score=np.float32(0.1),
        learnable_share=np.float32(0.2),
    )


@pytest.fixture(scope="module")
def buffer():
    return jax.device_get(filled(_chosen([10, 11, 12, 13, 14]), CONFIG))


def _after(buffer, *plays):
    """plays: of each update, [(slot, solved), ...]."""
    for update in plays:
        slot, solved = np.array(update, np.int32).T
        buffer = played(buffer, jnp.asarray(slot), jnp.asarray(solved), jnp.asarray(slot >= 0), CONFIG)
    return jax.device_get(buffer)


def test_the_window_holds_the_fewest_updates_with_so_many_plays():
    solved, plays = np.array([[1, 2, 0], [1, 1, 1], [0, 3, 9]]), np.array([[1, 3, 5], [1, 2, 3], [5, 4, 9]])
    newest = recent(jnp.asarray(solved), jnp.asarray(plays), 4)
    np.testing.assert_array_equal(newest, [[3, 3, 0], [4, 6, 5]])


def test_a_level_leaves_by_its_last_plays_alone(buffer):
    # Place 0: failed twice, then solved four times. 1: never. 2: three of four. 3: solved, with too few plays.
    first = [(0, 0), (0, 0), (1, 0), (1, 0), (2, 0), (2, 1), (3, 1)]
    then = [(0, 1), (0, 1), (1, 0), (1, 0), (2, 1), (2, 1), (3, 1)]
    after = _after(buffer, first, then)
    np.testing.assert_array_equal(after.status, [IN_USE, OUT_OF_REACH, IN_USE, IN_USE, IN_USE])
    after = _after(after, [(0, 1), (0, 1)])
    np.testing.assert_array_equal(after.status, [MASTERED, OUT_OF_REACH, IN_USE, IN_USE, IN_USE])
    np.testing.assert_array_equal(after.num_plays, [6, 4, 4, 2, 0])
    assert after.num_updates == 3


def test_a_play_of_a_level_that_is_not_there_any_more_does_not_count(buffer):
    after = _after(buffer, [(-1, 1), (4, 1)])
    assert after.num_plays.tolist() == [0, 0, 0, 0, 1]


def test_levels_that_left_are_not_drawn_and_go_first_then_the_oldest(buffer):
    newer = with_slice(buffer, _chosen([20, 21], 8))  # nothing left: the oldest, of equals the first
    assert np.asarray(newer.levels).tolist() == [20, 21, 12, 13, 14]
    left = _after(newer, [(1, 1)] * 4 + [(3, 0)] * 4 + [(2, 1)])
    drawn = draw_slots(jax.random.key(0), left, 256)
    assert set(np.asarray(drawn).tolist()) == {0, 2, 4}
    last = with_slice(left, _chosen([30, 31], 16))
    assert np.asarray(last.levels).tolist() == [20, 31, 12, 30, 14]
    assert last.status.tolist() == [IN_USE] * 5 and last.num_plays.tolist() == [0, 0, 1, 0, 0]
    assert last.policy_version.tolist() == [8, 16, 0, 16, 0]
    metrics = slice_metrics(last, 20)
    assert metrics["curriculum/mastered_share"] == metrics["curriculum/out_of_reach_share"] == 1 / 4
    assert metrics["curriculum/level_age"] == pytest.approx((12 + 4 + 20 + 4 + 20) / 5)
    assert metrics["curriculum/in_use_share"] == 1.0 and metrics["curriculum/plays_per_level"] == 0.2


def test_where_every_level_has_left_all_are_drawn(buffer):
    left = dataclasses.replace(buffer, status=np.full(5, MASTERED, np.int8))
    assert set(np.asarray(draw_slots(jax.random.key(0), left, 256)).tolist()) == set(range(5))


def test_the_newest_solved_levels_are_candidates():
    harvest = Harvest(levels=stand_in(jnp.zeros(3)), solved_at=jnp.full(3, NEVER))
    harvest = harvested(harvest, stand_in(jnp.array([1.0, 2.0, 3.0])), jnp.array([True, False, True]), jnp.int32(0))
    assert np.asarray(harvest.levels).tolist()[:2] == [1.0, 3.0] and harvest.solved_at.tolist() == [0, 0, NEVER]
    harvest = harvested(harvest, stand_in(jnp.array([4.0, 5.0, 6.0])), jnp.array([False, True, True]), jnp.int32(1))
    assert np.asarray(harvest.levels).tolist() == [5.0, 6.0, 1.0] and harvest.solved_at.tolist() == [1, 1, 0]
