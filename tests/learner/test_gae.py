"""Advantages worked by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from kinetix_dist.learner.gae import gae


def _gae(rewards, values, done_after, last_value, *, discount, trace) -> np.ndarray:
    """One world."""
    gained, expected = (jnp.asarray(x, jnp.float32)[:, None] for x in (rewards, values))
    done, last = jnp.asarray(done_after, bool)[:, None], jnp.asarray([last_value])
    return np.asarray(gae(gained, expected, done, last, discount=discount, trace=trace))[:, 0]


def test_one_step_is_the_temporal_difference():
    # 1 + 0.5 x 4 - 2
    assert _gae([1], [2], [False], 4.0, discount=0.5, trace=0.9).tolist() == [1.0]


def test_an_ended_episode_does_not_see_what_follows():
    assert _gae([1], [2], [True], 4.0, discount=0.5, trace=0.9).tolist() == [-1.0]


def test_three_steps_by_hand():
    # deltas from the end: 2 + 0.5 x 8 - 3 = 3; 0 + 0.5 x 3 - 2 = -0.5; 1 + 0.5 x 2 - 1 = 1
    # sums with 0.5 x 0.5: 3; -0.5 + 0.25 x 3 = 0.25; 1 + 0.25 x 0.25 = 1.0625
    found = _gae([1, 0, 2], [1, 2, 3], [False] * 3, 8.0, discount=0.5, trace=0.5)
    assert found.tolist() == [1.0625, 0.25, 3.0]


def test_an_end_in_the_middle_cuts_the_sum():
    # step 1 ends: its delta is 0 - 2 = -2, and step 0 sees that: 1 + 0.5 x 2 - 1 + 0.25 x -2 = 0.5
    found = _gae([1, 0, 2], [1, 2, 3], [False, True, False], 8.0, discount=0.5, trace=0.5)
    assert found.tolist() == [0.5, -2.0, 3.0]


def test_trace_one_gives_discounted_returns_minus_values():
    # returns from the end: 3 + 0.5 x 4 = 5; 2 + 2.5 = 4.5; 1 + 2.25 = 3.25
    found = _gae([1, 2, 3], [7, 8, 9], [False] * 3, 4.0, discount=0.5, trace=1.0)
    assert found.tolist() == [3.25 - 7, 4.5 - 8, 5.0 - 9]


def test_worlds_do_not_mix_and_more_steps_than_the_loop_unrolls_agree_with_plain_python():
    rng = np.random.default_rng(0)
    steps, worlds, discount, trace = 37, 3, 0.9, 0.8
    rewards, values = rng.normal(size=(2, steps, worlds)).astype(np.float32)
    done, last_value = rng.random((steps, worlds)) < 0.2, rng.normal(size=worlds).astype(np.float32)
    expected, following, advantage = np.zeros((steps, worlds)), last_value, np.zeros(worlds)
    for t in reversed(range(steps)):
        keeps = discount * (1 - done[t])
        advantage = rewards[t] + keeps * following - values[t] + trace * keeps * advantage
        expected[t], following = advantage, values[t]
    found = gae(*map(jnp.asarray, (rewards, values, done, last_value)), discount=discount, trace=trace)
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float32
