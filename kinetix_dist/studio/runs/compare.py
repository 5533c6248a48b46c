"""Comparison of runs: curves on one axis, groups by a field of the config, differences between configs.

A group of runs (seeds of one setting) has a mean or an interquartile mean at each point of the axis, with a bootstrap
band: the statistic of other seeds, as far as these seeds show it. (R. Agarwal et al., Deep Reinforcement Learning
at the Edge of the Statistical Precipice, 2021.) A group of one run has no band, nor have runs that agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

RESAMPLES = 1000
LEVEL = 0.95  # of bootstrap bands
SEED = 0  # of resampling: the same runs have the same band


def mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis."""
    return values.mean(axis=-1)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half over the last axis: a quarter of the weight is cut off at each end.

    Where a quarter of n is no whole number, the values at the edges count in part: no run matters twice, none leaps.
    """
    n = values.shape[-1]
    ordered = np.sort(values, axis=-1)
    position = np.arange(n)
    weight = np.clip(np.minimum(position + 1, 0.75 * n) - np.maximum(position, 0.25 * n), 0, None)
    return ordered @ (weight / weight.sum())


STATISTICS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"mean": mean, "iqm": interquartile_mean}


@dataclasses.dataclass(frozen=True)
class GroupCurve:
    """Curve of a group, [points] each: x, the statistic of the runs with data there, its band, the number of runs."""

    x: np.ndarray
    center: np.ndarray
    low: np.ndarray
    high: np.ndarray
    num_runs: np.ndarray


def group_curve(curves: Sequence[tuple[np.ndarray, np.ndarray]], *, statistic: str, points: int) -> GroupCurve:
    """Curve of a group of runs.

    curves: (x [n], y [n]) of each run, x rising, nan for a missing value. Runs are interpolated linearly between their
    rows, and never beyond them. The center is nan where a run of the group has no data: it would jump where a run ends.
    The band is nan where a single run has data, or where all runs agree. Raises ValueError for an unknown statistic.
    """
    if statistic not in STATISTICS:
        raise ValueError(f"statistic {statistic!r} is none of {', '.join(STATISTICS)}")
    curves = [(x[~np.isnan(y)], y[~np.isnan(y)]) for x, y in curves]
    curves = [curve for curve in curves if len(curve[0])]
    if not curves:
        empty = np.zeros(0)
        return GroupCurve(empty, empty, empty, empty, empty)
    grid = np.linspace(min(x[0] for x, _ in curves), max(x[-1] for x, _ in curves), points)
    values = np.stack([np.interp(grid, x, y, left=np.nan, right=np.nan) for x, y in curves])
    num_runs = (~np.isnan(values)).sum(0)
    center, low, high = (np.full(points, np.nan) for _ in range(3))
    chance = np.random.default_rng(SEED)
    # Points with data of the same runs share their resamples, so that a band does not flicker along the axis.
    masks, mask_of = np.unique(~np.isnan(values), axis=1, return_inverse=True)
    for k in range(masks.shape[1]):
        chosen = mask_of.reshape(-1) == k
        present = values[masks[:, k]][:, chosen].T  # [points, runs]
        count = present.shape[1]
        if count < len(curves):
            continue
        center[chosen] = STATISTICS[statistic](present)
        if count > 1:
            resampled = STATISTICS[statistic](present[:, chance.integers(count, size=(RESAMPLES, count))])
            ends = np.quantile(resampled, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=1)
            has_no_spread = np.ptp(present, axis=1) == 0
            low[chosen], high[chosen] = np.where(has_no_spread, np.nan, ends)
    return GroupCurve(grid, center, low, high, num_runs)


def flat_config(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Config as {"ppo.clip": 0.2, ...}; lists stay as they are."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            found |= flat_config(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def config_differences(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Fields in which the configs of runs differ, {field: {run: value}}; None where a config lacks the field."""
    flat = {run: flat_config(config) for run, config in configs.items()}
    names = dict.fromkeys(name for fields in flat.values() for name in fields)
    differing = {}
    for name in names:
        values = {run: fields.get(name) for run, fields in flat.items()}
        if any(value != next(iter(values.values())) for value in values.values()):
            differing[name] = values
    return differing


def group_by(configs: Mapping[str, Mapping[str, Any]], field: str) -> dict[str, list[str]]:
    """Groups {value of a field: runs}; field "": all runs in one group. A config without the field: "not there"."""
    if not field:
        return {"all": list(configs)}
    groups: dict[str, list[str]] = {}
    for run, config in configs.items():
        fields = flat_config(config)
        value = str(fields[field]) if field in fields else "not there"
        groups.setdefault(value, []).append(run)
    return groups
