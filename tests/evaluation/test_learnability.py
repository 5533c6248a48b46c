"""Estimates of p and of p (1 - p) from the episodes of one world, over all that can happen, by their exact chances.

Episodes of a level follow each other until the steps are over: one that is solved lasts 1 step, another one 4.
"""

from __future__ import annotations

import numpy as np
import pytest

from kinetix_dist.evaluation.learnability import mean_and_error, plug_in_learnability, unbiased_learnability

LENGTH = {True: 1, False: 4}


def endings(p: float, num_steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chance, solved, finished) of each way that a world can go."""
    ways = []

    def go_on(chance: float, solved: int, finished: int, steps_left: int) -> None:
        for outcome, of_it in ((True, p), (False, 1 - p)):
            if LENGTH[outcome] > steps_left:
                ways.append((chance * of_it, solved, finished))
            else:
                go_on(chance * of_it, solved + outcome, finished + 1, steps_left - LENGTH[outcome])

    go_on(1.0, 0, 0, num_steps)
    chance, solved, finished = np.array(ways).T
    return chance, solved.astype(int), finished.astype(int)


@pytest.mark.parametrize("p", [0.2, 0.5, 0.7])
def test_one_world_gives_the_solve_rate_of_its_level_without_bias_and_many_worlds_together_do_not(p: float) -> None:
    chance, solved, finished = endings(p, num_steps=8)
    assert chance.sum() == pytest.approx(1) and finished.min() == 2
    assert chance @ (solved / finished) == pytest.approx(p)
    assert (chance @ solved) / (chance @ finished) > p + 0.03  # 0.24, 0.61 and 0.83


@pytest.mark.parametrize("p", [0.2, 0.5, 0.7])
def test_learnability_of_whole_episodes_of_one_world(p: float) -> None:
    """Unbiased where two always end within the steps, and the value that levels are ranked by is too low."""
    chance, solved, finished = endings(p, num_steps=8)
    assert chance @ unbiased_learnability(solved, finished) == pytest.approx(p * (1 - p))
    assert chance @ plug_in_learnability(solved, finished) < 0.9 * p * (1 - p)


def test_where_some_worlds_finish_one_episode_alone_the_others_say_nothing_unbiased() -> None:
    """Two end within 4 steps where the first is solved early: those that finish two are chosen by that."""
    chance, solved, finished = endings(0.5, num_steps=4)
    values = unbiased_learnability(solved, finished)
    is_known = np.isfinite(values)
    assert 0 < chance[is_known].sum() < 1
    assert (chance[is_known] @ values[is_known]) / chance[is_known].sum() < 0.5 * 0.25
    assert chance @ (solved / finished) == pytest.approx(0.5), "the solve rate needs one episode"


def test_a_mean_stands_with_its_error_over_levels() -> None:
    mean, error = mean_and_error(np.array([0.0, 0.25, np.nan, 0.5]))
    assert mean == pytest.approx(0.25) and error == pytest.approx(0.25 / np.sqrt(3))
    assert mean_and_error(np.array([0.25])) == (0.25, None) and mean_and_error(np.zeros(0)) == (None, None)
