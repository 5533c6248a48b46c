"""Changes of each evaluated level: newest evaluation against the last, the first and the best before it.

evaluations.jsonl --evaluations()--> points of sets --with_changes()--> + changes of levels, intervals of counts
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.evaluation.intervals import Estimate, difference_interval, wilson_interval

RANDOM_POLICY = "random_policy"  # the phase that is no evaluation of the policy
DIGITS = 4  # of rates that are sent: 0.01 %


def with_changes(evaluated: Mapping[str, Any]) -> dict[str, Any]:
    """The result of `evaluations` with `changes` of each set, and `intervals` of all counts.

    `changes` is {"last", "first", "best": {points, value, low, high}} of the newest evaluation of the policy against
    the one before it, the first, and the best of each level before it; lists with an entry for each level. `points`
    are numbers of points of the set; `value` is the new rate less the old one, with its 95 % interval. A set with fewer
    than two evaluations of the policy has no changes (None). `intervals` has Wilson's 95 % interval of each count:
    {attempts: [[low, high] of 0, 1, ... solved]}.
    """
    attempts = {
        point["attempts"] for each in evaluated["sets"].values() for point in each["points"] if point["attempts"]
    }
    intervals = {count: [wilson_interval(solved, count) for solved in range(count + 1)] for count in sorted(attempts)}
    sets = {
        name: {**each, "changes": None if each["names"] is None else _changes(each, intervals)}
        for name, each in evaluated["sets"].items()
    }
    sent = {str(count): [[_short(low), _short(high)] for low, high in table] for count, table in intervals.items()}
    return {**evaluated, "sets": sets, "intervals": sent}


def _changes(evaluated_set: Mapping[str, Any], intervals: Mapping[int, list]) -> dict[str, Any] | None:
    points = evaluated_set["points"]
    of_policy = policy_points(points)
    if len(of_policy) < 2:
        return None
    *before, newest = of_policy
    levels = range(len(evaluated_set["names"]))
    best = [max(reversed(before), key=lambda k: points[k]["solved"][level] / points[k]["attempts"]) for level in levels]
    old = {"last": [before[-1] for _ in levels], "first": [before[0] for _ in levels], "best": best}
    return {name: _against(points, newest, chosen, intervals) for name, chosen in old.items()}


def policy_points(points: Sequence[Mapping[str, Any]]) -> list[int]:
    """Numbers of the points that are evaluations of the policy, with counts of levels."""
    return [k for k, point in enumerate(points) if point["phase"] != RANDOM_POLICY and point["attempts"]]


def _against(
    points: Sequence[Mapping[str, Any]], newest: int, old: Sequence[int], intervals: Mapping[int, list]
) -> dict[str, Any]:
    found: dict[str, Any] = {"points": list(old), "value": [], "low": [], "high": []}
    for level, number in enumerate(old):
        now, before = (_rate(points[k], level, intervals) for k in (newest, number))
        for name, value in zip(("value", "low", "high"), difference_interval(now, before), strict=True):
            found[name].append(_short(value))
    return found


def _rate(point: Mapping[str, Any], level: int, intervals: Mapping[int, list]) -> Estimate:
    solved = point["solved"][level]
    low, high = intervals[point["attempts"]][solved]
    return solved / point["attempts"], low, high


def _short(value: float) -> float:
    return round(value, DIGITS)
