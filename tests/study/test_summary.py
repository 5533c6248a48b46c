"""Estimates of a study: what their intervals are over, and that none has an interval without width."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kinetix_dist.evaluation.over_seeds import iqm, mean
from kinetix_dist.study.records import Point
from kinetix_dist.study.report import percent, points
from kinetix_dist.study.summary import (
    NO_INTERVAL,
    NO_SPREAD,
    OVER_LEVELS,
    OVER_SEEDS,
    Estimate,
    estimate_at,
    over_seeds,
)


def point(*solved: int) -> Point:
    return Point(number=1, update=4, env_steps=100, solved=solved, attempts=10)


@pytest.mark.parametrize("statistic", [mean, iqm])
@pytest.mark.parametrize(("values", "over"), [([0.4], NO_INTERVAL), ([0.4] * 3, NO_SPREAD), ([0.4, 0.5], OVER_SEEDS)])
def test_an_estimate_over_seeds(values: list[float], over: str, statistic: Callable[[np.ndarray], np.ndarray]) -> None:
    found = over_seeds(values, statistic)
    assert found.over == over
    assert (found.low is None) == (found.high is None) == (over != OVER_SEEDS)


def test_seeds_that_came_out_alike_are_called_so() -> None:
    alike = over_seeds([0.4, 0.4, 0.4], mean)
    assert percent(alike) == "40.0 (no spread)" and points(alike) == "+40.0 (no spread)"
    assert percent(over_seeds([0.4], mean)) == "40.0"


def test_a_rate_at_the_end() -> None:
    assert estimate_at([point(4, 4), point(4, 4)], ["a", "b"]).over == NO_SPREAD
    assert estimate_at([point(4, 4), point(5, 4)], ["a", "b"]).over == OVER_SEEDS
    assert estimate_at([point(4, 4)], ["a", "b"]).over == OVER_LEVELS
    assert estimate_at([point(4)], ["a"]) == Estimate(value=0.4, low=None, high=None, over=NO_INTERVAL)
