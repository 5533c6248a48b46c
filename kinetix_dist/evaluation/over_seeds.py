"""Intervals over seeds: how much of a difference between two arms could be chance.

    iqm(values)                         interquartile mean: of the middle half of the seeds
    bootstrap_interval(values, of)      of the mean or the IQM, seeds drawn again with replacement
    bootstrap_difference(a, b, of)      of the difference of two arms, seeds of each drawn again by themselves
    welch_interval(a, b)                of the difference of two means, by Student's t with Welch's degrees of freedom

A run, that is a seed, is one observation: levels and attempts within it share its policy. (R. Agarwal et al., Deep
reinforcement learning at the edge of the statistical precipice, 2021.) With n seeds a bootstrap draws from n values:
its interval is too narrow by sqrt((n - 1) / n) at least, by a fifth with three seeds, and ends at the extremes. Welch's
interval has no such fault, and takes values as normal.

Seeds that came out alike have no spread, which says nothing of the next seed: an interval without width would claim
certainty, so there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kinetix_dist.evaluation.intervals import has_spread, t_95

NUM_RESAMPLES = 10_000
SEED = 0x53454544  # "SEED": the same values have the same interval
TAIL = 0.025  # on either side of a 95 % interval

Statistic = Callable[[np.ndarray], np.ndarray]  # [..., seeds] -> [...]


def mean(values: np.ndarray) -> np.ndarray:
    return values.mean(axis=-1)


def iqm(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half of the seeds, [..., seeds] -> [...]; a seed across a quartile counts in part."""
    count = values.shape[-1]
    edges = np.arange(count + 1) / count
    weights = 2.0 * np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0.0, None)
    return np.sort(values, axis=-1) @ weights


def bootstrap_interval(values: Sequence[float], statistic: Statistic = mean) -> tuple[float, float] | None:
    """(low, high) of the statistic, 95 %; None for fewer than two seeds, and for seeds without spread."""
    if len(values) < 2:
        return None
    return _percentiles(statistic(_resampled(np.asarray(values, float), np.random.default_rng(SEED))))


def bootstrap_difference(
    values: Sequence[float], others: Sequence[float], statistic: Statistic = mean
) -> tuple[float, float] | None:
    """(low, high) of the statistic of `values` less that of `others`, 95 %; None where either has fewer than two, or
    neither has any spread."""
    if min(len(values), len(others)) < 2:
        return None
    random = np.random.default_rng(SEED)
    ours = statistic(_resampled(np.asarray(values, float), random))
    return _percentiles(ours - statistic(_resampled(np.asarray(others, float), random)))


def welch_interval(values: Sequence[float], others: Sequence[float]) -> tuple[float, float] | None:
    """(low, high) of the mean of `values` less that of `others`, 95 %; None where either has fewer than two, or neither
    has any spread."""
    if min(len(values), len(others)) < 2:
        return None
    ours, theirs = np.asarray(values, float), np.asarray(others, float)
    parts = np.array([ours.var(ddof=1) / len(ours), theirs.var(ddof=1) / len(theirs)])
    difference = float(ours.mean() - theirs.mean())
    if not has_spread(0.0, float(np.sqrt(parts.sum()))):
        return None
    freedom = parts.sum() ** 2 / (parts**2 / np.array([len(ours) - 1, len(theirs) - 1])).sum()
    margin = float(t_95(freedom) * np.sqrt(parts.sum()))
    return difference - margin, difference + margin


def _resampled(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """[NUM_RESAMPLES, seeds]"""
    return values[random.integers(0, len(values), (NUM_RESAMPLES, len(values)))]


def _percentiles(statistics: np.ndarray) -> tuple[float, float] | None:
    low, high = (float(end) for end in np.quantile(statistics, [TAIL, 1 - TAIL]))
    return (low, high) if has_spread(low, high) else None
