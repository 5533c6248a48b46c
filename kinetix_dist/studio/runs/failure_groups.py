"""Groups of evaluated levels by their features: which features go with failing, ranked, noise last.

    levels of a set + features -> groupings (by joints, family, distance, ...) -> each group against all others

Levels are the sample, not attempts: ten attempts at one level say little of another level with as many joints. A group
differs clearly where the interval of its difference to all other levels excludes 0, with a confidence that holds for
all groups of the set together (Bonferroni). A difference is no cause: levels with two thrusters may differ by more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import difference_interval, interval_over_levels
from kinetix_dist.level.level_data import base_levels

MAX_COUNT_GROUPS = 5  # of a feature that counts: 0, 1, 2, 3, 4 or more
MIN_SHARE = 0.05  # of the levels in the first and last of these; fewer are put together with their neighbours
NUM_DISTANCE_GROUPS = 4
MIN_LEVELS_PER_DISTANCE_GROUP = 4
DISTANCE = "distance"
FAMILY = "family"
OTHER_NAMES = "other names"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolvedLevels:
    """Levels of a set with the attempts of one evaluation."""

    solved: tuple[int, ...]  # of each level
    attempts: int  # of each level
    base_levels: tuple[str, ...]  # of each level, the one that it is a variant of, or itself

    @property
    def rates(self) -> np.ndarray:
        return np.array(self.solved) / self.attempts


def failure_groups(
    levels: SolvedLevels, features: Mapping[str, Sequence[float]], families: Sequence[str]
) -> list[dict[str, Any]]:
    """Groupings [{feature, same, explained, is_clear, groups}], those that explain most first.

    `explained`: share of the variance of levels' solve rates that lies between groups, less the share that groups by
    lot would have (omega squared), at least 0. A group is {label, levels (indices), solved, attempts, rate, low, high,
    others: {solved, attempts, rate, low, high}, difference: {value, low, high} or None, is_clear}. Intervals of rates
    are 95 % over levels, None of a single base level; that of a difference is 95 % for all groups together. Features
    that all levels share make no grouping; `same` names those that group the levels as `feature` does. Groupings that
    differ clearly come first, by the least that they explain.
    """
    groupings = {name: _bins(name, np.asarray(values)) for name, values in features.items()}
    groupings[FAMILY] = _families(families)
    alike: dict[frozenset[bytes], list[str]] = {}  # features by how they divide the levels
    for name, groups in groupings.items():
        if len(groups) > 1:
            alike.setdefault(frozenset(is_in.tobytes() for is_in in groups.values()), []).append(name)
    num_groups = sum(len(division) for division in alike)
    found: list[dict[str, Any]] = [
        {"same": same} | _compared(levels, name, groupings[name], num_groups) for name, *same in alike.values()
    ]
    found.sort(key=lambda one: (-one.pop("least_explained"), -one["explained"]))
    return found


def groups_of_set(
    name: str, names: Sequence[str], solved: Sequence[int], attempts: int, features: Mapping[str, Sequence[float]]
) -> list[dict[str, Any]]:
    """`failure_groups` of a set: names and solved attempts of its levels. Without features, by family alone."""
    base = base_levels(name, list(names))
    levels = SolvedLevels(solved=tuple(solved), attempts=attempts, base_levels=tuple(base))
    return failure_groups(levels, features, families_of(names, base))


def families_of(names: Sequence[str], base_levels: Sequence[str]) -> list[str]:
    """Family of each level: its base level where levels are variants, else what is before the first _ of its name.

    A family of one level is called `OTHER_NAMES`.
    """
    own = list(base_levels) if list(base_levels) != list(names) else [name.partition("_")[0] for name in names]
    return [family if own.count(family) > 1 else OTHER_NAMES for family in own]


def _compared(levels: SolvedLevels, name: str, groups: Mapping[str, np.ndarray], num_groups: int) -> dict[str, Any]:
    rates = levels.rates
    compared = [_group(levels, label, is_in, num_groups) for label, is_in in groups.items()]
    return {
        "feature": name,
        "explained": _explained(rates, list(groups.values())),
        "least_explained": max(_least_explained(rates, group) for group in compared),
        "is_clear": any(group["is_clear"] for group in compared),
        "groups": compared,
    }


def _group(levels: SolvedLevels, label: str, is_in: np.ndarray, num_groups: int) -> dict[str, Any]:
    own, others = _rate(levels, is_in), _rate(levels, ~is_in)
    strict = [_interval(levels, mask, num_groups) for mask in (is_in, ~is_in)]
    difference = None
    if strict[0] is not None and strict[1] is not None:
        value, low, high = difference_interval((own["rate"], *strict[0]), (others["rate"], *strict[1]))
        difference = {"value": value, "low": low, "high": high}
    is_clear = difference is not None and not difference["low"] <= 0 <= difference["high"]
    indices = np.flatnonzero(is_in).tolist()
    return {
        "label": label,
        "levels": indices,
        **own,
        "others": others,
        "difference": difference,
        "is_clear": is_clear,
    }


def _rate(levels: SolvedLevels, is_in: np.ndarray) -> dict[str, Any]:
    solved = int(np.array(levels.solved)[is_in].sum())
    attempts = int(is_in.sum()) * levels.attempts
    low, high = _interval(levels, is_in) or (None, None)
    return {"solved": solved, "attempts": attempts, "rate": solved / attempts, "low": low, "high": high}


def _interval(levels: SolvedLevels, is_in: np.ndarray, comparisons: int = 1) -> tuple[float, float] | None:
    chosen = np.flatnonzero(is_in)
    solved, base = [levels.solved[k] for k in chosen], [levels.base_levels[k] for k in chosen]
    found = interval_over_levels(solved, levels.attempts, base, comparisons)
    return None if found is None else (found["low"], found["high"])


def _explained(rates: np.ndarray, groups: Sequence[np.ndarray]) -> float:
    """Omega squared of a one-way analysis of variance, at least 0."""
    total = float(((rates - rates.mean()) ** 2).sum())
    num_free = len(rates) - len(groups)
    if total == 0 or num_free < 1:
        return 0.0
    between = sum(is_in.sum() * (rates[is_in].mean() - rates.mean()) ** 2 for is_in in groups)
    within_mean = (total - between) / num_free
    return max(0.0, float((between - (len(groups) - 1) * within_mean) / (total + within_mean)))


def _least_explained(rates: np.ndarray, group: Mapping[str, Any]) -> float:
    """Share of the variance that a group explains by the end of its difference's interval that is nearest to 0."""
    if not group["is_clear"]:
        return 0.0
    bound = min(abs(group["difference"]["low"]), abs(group["difference"]["high"]))
    share = len(group["levels"]) / len(rates)
    return float(share * (1 - share) * bound**2 / rates.var())


def _families(families: Sequence[str]) -> dict[str, np.ndarray]:
    names = sorted(set(families), key=lambda name: (name == OTHER_NAMES, name))
    return {name: np.array([family == name for family in families]) for name in names}


def _bins(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return _distances(values) if name == DISTANCE else _counts(name, values)


def _counts(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Levels by a count; rare counts at both ends are put together."""
    bins = [[value] for value in np.unique(values).astype(int).tolist()]
    fewest = max(2, MIN_SHARE * len(values))

    def is_rare(one: Sequence[int]) -> bool:
        return np.isin(values, one).sum() < fewest

    while len(bins) > 1 and (len(bins) > MAX_COUNT_GROUPS or is_rare(bins[-1])):
        bins[-2:] = [bins[-2] + bins[-1]]
    while len(bins) > 1 and is_rare(bins[0]):
        bins[:2] = [bins[0] + bins[1]]
    return {_count_label(name, one, is_last=one is bins[-1]): np.isin(values, one) for one in bins}


def _count_label(name: str, counts: Sequence[int], *, is_last: bool) -> str:
    words = name.replace("_", " ")
    if len(counts) > 1 and is_last:
        return f"{counts[0]} or more {words}"
    noun = words.removesuffix("s") if counts[-1] == 1 else words
    return f"{counts[0]} {noun}" if len(counts) == 1 else f"up to {counts[-1]} {noun}"


def _distances(values: np.ndarray) -> dict[str, np.ndarray]:
    """Levels by a length, as many in each group."""
    count = min(NUM_DISTANCE_GROUPS, len(values) // MIN_LEVELS_PER_DISTANCE_GROUP)
    if count < 2:
        return {}
    edges = np.unique(np.quantile(values, np.linspace(0, 1, count + 1)))
    numbers = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
    return {f"{edges[k]:.2f} to {edges[k + 1]:.2f} m": numbers == k for k in range(len(edges) - 1)}
