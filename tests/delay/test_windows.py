"""Windows of a data set end with the episode, and episodes are held out whole."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.delay.cloning import split_episodes
from kinetix_dist.delay.windows import Samples, observations, steps_left, windows


def samples(actions: jax.Array, left: np.ndarray, counts: jax.Array | None = None) -> Samples:
    nothing, all_count = jnp.zeros(0), jnp.ones(len(left), bool)
    return Samples(
        nothing, nothing, nothing, nothing, actions, jnp.asarray(left), all_count if counts is None else counts
    )


def test_a_window_repeats_the_last_action_of_its_episode() -> None:
    episode = np.array([4, 4, 4, 9, 9, 2])
    left = steps_left(episode)
    assert left.tolist() == [3, 2, 1, 2, 1, 1]
    actions = jnp.arange(6.0)[:, None]
    found = windows(samples(actions, left), jnp.array([0, 1, 4, 5]), 3)
    assert found.actions[..., 0].tolist() == [[0, 1, 2], [1, 2, 2], [4, 4, 4], [5, 5, 5]]
    assert found.counts.tolist() == [[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 0, 0]]


def test_actions_that_the_policy_did_not_choose_do_not_count() -> None:
    counts = jnp.array([True, False, True, True])
    found = windows(samples(jnp.arange(4.0)[:, None], np.array([4, 3, 2, 1]), counts), jnp.array([0, 2]), 3)
    assert found.actions[..., 0].tolist() == [[0, 1, 2], [2, 3, 3]]
    assert found.counts.tolist() == [[1, 0, 1], [1, 1, 0]]


def test_windows_against_a_loop() -> None:
    rng = np.random.default_rng(0)
    episode = np.repeat(rng.permutation(20), rng.integers(1, 9, 20))
    actions = rng.normal(size=(len(episode), 2)).astype(np.float32)
    rows, horizon = np.arange(len(episode)), 5
    found = windows(samples(jnp.asarray(actions), steps_left(episode)), jnp.asarray(rows), horizon)
    for row in rows:
        for ahead in range(horizon):
            inside = row + ahead < len(episode) and episode[row + ahead] == episode[row]
            assert bool(found.counts[row, ahead]) == inside
            if inside:
                np.testing.assert_array_equal(found.actions[row, ahead], actions[row + ahead])


class _AsTheyAre:
    """An environment whose observations are numbers."""

    class observation:
        @staticmethod
        def join(static: jax.Array, dynamic: jax.Array) -> jax.Array:
            return static * 1000 + dynamic


@pytest.mark.parametrize("history", [1, 3])
def test_steps_before_a_row_are_those_of_its_episode(history: int) -> None:
    rng = np.random.default_rng(1)
    episode = np.repeat(rng.permutation(20), rng.integers(1, 9, 20))
    count, level = len(episode), (episode % 2).astype(np.int32)
    actions, bound = rng.normal(size=(count, 2)).astype(np.float32), np.array([[True, True], [True, False]])
    of_rows = Samples(
        jnp.array([1.0, 2.0]),
        jnp.asarray(bound),
        jnp.arange(float(count)),
        jnp.asarray(level),
        jnp.asarray(actions),
        jnp.asarray(steps_left(episode)),
        jnp.ones(count, bool),
    )
    found, _ = observations(_AsTheyAre, of_rows, jnp.arange(count), history)
    for row in range(count):
        first = int(np.flatnonzero(episode == episode[row])[0])
        assert float(found.now[row]) == 1000 * (1 + level[row]) + row
        for back in range(1, history + 1):
            assert float(found.past[row, back - 1]) == 1000 * (1 + level[row]) + max(row - back, first)
            expected = actions[row - back] * bound[level[row]] if row - back >= first else np.zeros(2)
            np.testing.assert_array_equal(found.actions[row, back - 1], expected)


def test_rows_of_an_episode_that_are_apart_are_refused() -> None:
    with pytest.raises(ValueError, match="rows of an episode are apart"):
        steps_left(np.array([0, 0, 1, 0]))
    assert steps_left(np.array([], int)).shape == (0,)


def test_episodes_are_held_out_whole_and_none_is_in_both() -> None:
    episode = np.repeat(np.arange(10), np.arange(1, 11))
    train, held_out = split_episodes(steps_left(episode), 0.3, seed=0)
    assert len(set(episode[held_out])) == 3
    assert not set(episode[train]) & set(episode[held_out])
    assert sorted([*train, *held_out]) == list(range(len(episode)))
    assert split_episodes(steps_left(episode), 0.3, seed=1)[1].tolist() != held_out.tolist()


@pytest.mark.parametrize("episodes", [[], [0, 0, 0]])
def test_too_few_episodes_are_refused(episodes: list[int]) -> None:
    with pytest.raises(ValueError, match="2 or more"):
        split_episodes(steps_left(np.array(episodes, int)), 0.05, seed=0)
