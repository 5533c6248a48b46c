"""Points of error against cost: which of them nothing beats, how steep they are, and means over scenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jax2d.fidelity.peers import PEER_NAMES
from jax2d.fidelity.records import Record, is_preset_itself

SMALLEST_ERROR = 1e-6  # about what float32 resolves over a few hundred steps: smaller errors count as this
NOT_ACCEPTED = "; not accepted: "  # in the metric of a record whose error may be that of its reference solution
LARGEST_ERROR = 1.0  # wrong by all of it: larger errors, and trajectories that are not finite, count as this


class Point(NamedTuple):
    """One setting over all scenes."""

    preset: str
    backend: str
    dtype: str
    setting: str
    cost: float  # us per world-second, geometric mean over scenes
    error: float  # geometric mean over scenes, each between SMALLEST_ERROR and LARGEST_ERROR


def pareto_set(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the (cost, error) pairs that no other pair beats or equals in both, by rising cost."""
    front = []
    least = math.inf
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < least:
            front.append(i)
            least = points[i][1]
    return front


def slope(costs: Sequence[float], errors: Sequence[float]) -> float:
    """Least-squares slope of log error over log cost; NaN for fewer than two different costs. 2^slope is what remains
    of the error when the cost is doubled."""
    x, y = np.log(costs), np.log([bounded(error) for error in errors])
    if len(x) < 2 or np.ptp(x) == 0:
        return math.nan
    return float(np.polyfit(x, y, 1)[0])


def bounded(error: float | None) -> float:
    return LARGEST_ERROR if error is None else min(max(error, SMALLEST_ERROR), LARGEST_ERROR)


def accepted(record: Record) -> bool:
    """Returns True if the reference is accurate enough for the error shown (`references.TRUST`)."""
    return NOT_ACCEPTED not in record["metric"]


def scenes_of_means(records: Sequence[Record]) -> list[str]:
    """Scenes over which means are taken: those of which each preset itself and each peer's first setting have an
    accepted record (without any of these: all settings)."""
    keys = list(dict.fromkeys(setting_key(record) for record in records))
    named = {setting_key(record) for record in records if is_preset_itself(record)}
    for peer in PEER_NAMES:
        named |= set([key for key in keys if key[0] == peer][:1])
    by_setting: dict[tuple[str, ...], set[str]] = {key: set() for key in named or keys}
    for record in records:
        if accepted(record) and setting_key(record) in by_setting:
            by_setting[setting_key(record)].add(record["scene"])
    common = set.intersection(*by_setting.values()) if by_setting else set()
    return [scene for scene in dict.fromkeys(record["scene"] for record in records) if scene in common]


def setting_key(record: Record) -> tuple[str, str, str, str]:
    return record["preset"], record["backend"], record["dtype"], record["setting"]


def points_of(records: Sequence[Record], scenes: Sequence[str] | None = None) -> list[Point]:
    """One point a setting over `scenes`, by default `scenes_of_means`. A setting without an accepted record of one of
    them has no point: its mean would be one over other scenes."""
    chosen = set(scenes_of_means(records) if scenes is None else scenes)
    groups: dict[tuple[str, str, str, str], list[Record]] = {}
    for record in records:
        if record["scene"] in chosen and accepted(record):
            groups.setdefault(setting_key(record), []).append(record)
    return [
        Point(
            *key,
            cost=math.exp(np.mean([math.log(record["us_per_world_second"]) for record in group])),
            error=math.exp(np.mean([math.log(bounded(record["error"])) for record in group])),
        )
        for key, group in groups.items()
        if {record["scene"] for record in group} == chosen
    ]
