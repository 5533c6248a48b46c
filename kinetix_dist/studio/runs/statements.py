"""Statement of a verdict: its subject, its state, one sentence with the numbers, and the page with the evidence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeGuard

from kinetix_dist.evaluation.intervals import Estimate

GOOD, BAD, NEUTRAL, UNKNOWN = "good", "bad", "neutral", "unknown"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Statement:
    """One part of a verdict."""

    key: str  # names the rule, see docs/dashboard.md
    title: str
    state: str  # GOOD, BAD, NEUTRAL (no judgement, or neither) or UNKNOWN (no data)
    sentence: str
    remedy: str = ""
    page: str = "overview"  # of the run, that shows the evidence
    query: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of its address; `panel`: title to scroll to

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"query": dict(self.query)}


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def counted(number: int, noun: str, plural: str = "") -> str:
    """1 level, 2 levels, 2,048 levels"""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def rate_with_count(solved: int, episodes: int, low: float, high: float) -> str:
    """53.6 % (429 of 800; 50.2 to 57.0)"""
    return f"{percent(solved / episodes)} ({solved:,} of {episodes:,}; {100 * low:.1f} to {100 * high:.1f})"


def points(difference: Estimate) -> str:
    """+19.7 points, +14.9 to +24.3"""
    value, low, high = (100 * each for each in difference)
    return f"{value:+.1f} points, {low:+.1f} to {high:+.1f}"


def change(difference: Estimate) -> str:
    """a gain of 19.7 points (14.9 to 24.3); its interval decides whether it is one"""
    value, low, high = (100 * each for each in difference)
    if low > 0:
        return f"a gain of {value:.1f} points ({low:.1f} to {high:.1f})"
    if high < 0:
        return f"a loss of {-value:.1f} points ({-high:.1f} to {-low:.1f})"
    return f"no change by more than chance ({points(difference)})"


def is_above(difference: Estimate | None) -> TypeGuard[Estimate]:
    """True where the whole interval is above 0."""
    return difference is not None and difference[1] > 0


def is_below(difference: Estimate | None) -> bool:
    return difference is not None and difference[2] < 0
