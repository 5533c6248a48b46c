"""Learnability of fresh levels in training, from pairs of worlds that were given the same fresh level.

Two first episodes at one level of solve rate p differ with the chance 2 p (1 - p): half of the share of pairs of which
one was solved has the mean p (1 - p). Pairs are independent, so that the interval is Wilson's, halved. It is what
training would learn from without a buffer: the control of a curriculum.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from kinetix_dist.evaluation.intervals import wilson_interval

FIELD = "fresh_pairs"  # of a line of outcomes.jsonl; absent where a run does not record it
COUNTS = ("both", "one", "none")  # pairs of which both, one and no first episode was solved


def is_pairs(value: Any) -> bool:
    """True for the content of the field."""
    return isinstance(value, dict) and all(
        isinstance(value.get(name), int) and not isinstance(value[name], bool) and value[name] >= 0 for name in COUNTS
    )


def learnability_of_pairs(windows: Iterable[Mapping[str, Any]]) -> dict[str, Any] | None:
    """{learnability, low, high, pairs, both, one, none} over windows; None where none of them has a pair."""
    rows = [row[FIELD] for row in windows if FIELD in row]
    counts = {name: sum(row[name] for row in rows) for name in COUNTS}
    pairs = sum(counts.values())
    if not pairs:
        return None
    low, high = wilson_interval(counts["one"], pairs)
    return {"learnability": counts["one"] / pairs / 2, "low": low / 2, "high": high / 2, "pairs": pairs} | counts
