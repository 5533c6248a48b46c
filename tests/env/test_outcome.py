"""Outcomes of single steps and distances, worked by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import pack_bits, touch_matrix
from kinetix_dist.env.outcome import Outcome, goal_distance, judge, role_masks
from kinetix_dist.level.level import Role

ROLES = jnp.array([[Role.NONE, Role.GREEN, Role.BLUE, Role.RED]])
ACTIVE = jnp.ones((1, 4), bool)
FLOOR, GREEN, BLUE, RED = range(4)


def outcome_of_touches(*pairs: tuple[int, int], is_finite: bool = True, is_last_step: bool = False) -> Outcome:
    touches = np.zeros((1, 4, 4), bool)
    for i, j in pairs:
        touches[0, i, j] = touches[0, j, i] = True
    return judge(
        pack_bits(jnp.asarray(touches)),
        role_masks(ROLES, ACTIVE),
        is_finite=jnp.array([is_finite]),
        is_last_step=jnp.array([is_last_step]),
    )


def names(outcome: Outcome) -> list[str]:
    return [name for name in ("solved", "failed", "timed_out", "unstable") if bool(getattr(outcome, name)[0])]


def test_green_on_blue_solves() -> None:
    assert names(outcome_of_touches((GREEN, BLUE))) == ["solved"]


def test_green_on_red_fails() -> None:
    assert names(outcome_of_touches((GREEN, RED))) == ["failed"]


def test_red_wins_when_green_touches_both() -> None:
    assert names(outcome_of_touches((GREEN, BLUE), (GREEN, RED))) == ["failed"]


def test_touches_that_do_not_involve_green_mean_nothing() -> None:
    assert names(outcome_of_touches((BLUE, RED), (FLOOR, BLUE), (FLOOR, GREEN))) == []


def test_the_last_step_times_out_unless_something_else_ends_the_episode() -> None:
    assert names(outcome_of_touches(is_last_step=True)) == ["timed_out"]
    assert names(outcome_of_touches((GREEN, BLUE), is_last_step=True)) == ["solved"]
    assert names(outcome_of_touches((GREEN, RED), is_last_step=True)) == ["failed"]


def test_numbers_that_are_not_finite_end_an_episode() -> None:
    outcome = outcome_of_touches((GREEN, BLUE), is_finite=False, is_last_step=True)
    assert names(outcome) == ["unstable"]


def test_distance_is_that_of_the_centres_of_green_and_blue() -> None:
    position = jnp.array([[[0, 0], [1, 1], [4, 5], [1, 1.0]]])
    assert float(goal_distance(position, role_masks(ROLES, ACTIVE))[0]) == pytest.approx(5.0)


def test_distance_is_of_the_closest_pair_and_zero_without_one() -> None:
    position = jnp.array([[[0, 0], [3, 0], [1, 0], [0, 9.0]]] * 2)
    roles = jnp.array([[Role.GREEN, Role.BLUE, Role.BLUE, Role.NONE], [Role.GREEN, Role.NONE, Role.NONE, Role.RED]])
    distance = goal_distance(position, role_masks(roles, jnp.ones((2, 4), bool)))
    np.testing.assert_allclose(distance, [1.0, 0.0])


def test_inactive_shapes_play_no_role() -> None:
    masks = role_masks(ROLES, jnp.zeros((1, 4), bool))
    assert not masks.is_green.any() and not masks.blue_bits.any() and not masks.red_bits.any()


def test_packed_bits_are_those_the_engine_uses_also_beyond_one_word() -> None:
    matrix = np.random.default_rng(1).random((2, 40, 40)) < 0.3
    words = pack_bits(jnp.asarray(matrix))
    assert words.shape == (2, 40, 2) and words.dtype == jnp.uint32
    np.testing.assert_array_equal(touch_matrix(words, 40), matrix)
