"""Difference of two policies on the same levels, with an interval over base levels.

d = mean over levels of (rate - other rate); its variance is that of a ratio of sums over base levels (clusters), as in
`intervals.py`. Levels that both policies solve alike say nothing of the difference, so that the interval is narrower
than from two intervals of rates. It says nothing of seeds: two policies are two samples of how training comes out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from kinetix_dist.evaluation.intervals import has_spread, t_95, variance_of_ratio


def difference_over_levels(
    rates: Sequence[float], others: Sequence[float], base_levels: Sequence[str], *, comparisons: int = 1
) -> tuple[float, float, float] | None:
    """(difference, low, high), 95 %, by Student's t with one less than the number of base levels as degrees of freedom;
    None for fewer than two base levels, and where all differ alike. rates, others: of each level. comparisons: that are
    made at once."""
    differences = [one - other for one, other in zip(rates, others, strict=True)]
    sums: dict[str, list[float]] = {}
    for difference, base in zip(differences, base_levels, strict=True):
        of_base = sums.setdefault(base, [0.0, 0.0])
        of_base[0] += difference
        of_base[1] += 1
    if (count := len(sums)) < 2:
        return None
    mean = sum(differences) / len(differences)
    margin = t_95(count - 1, comparisons) * math.sqrt(variance_of_ratio(sums.values(), mean))
    return (mean, mean - margin, mean + margin) if has_spread(mean - margin, mean + margin) else None
