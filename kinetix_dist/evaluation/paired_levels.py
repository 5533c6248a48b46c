"""Difference of two policies on the same levels, with an interval over base levels.

d = mean over levels of (rate - other rate); its variance is that of a ratio of sums over base levels (clusters), as in
`intervals.py`. Levels that both policies solve alike say nothing of the difference, so that the interval is narrower
than from two intervals of rates. It says nothing of seeds: two policies are two samples of how training comes out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence


def difference_over_levels(
    rates: Sequence[float], others: Sequence[float], base_levels: Sequence[str]
) -> tuple[float, float, float] | None:
    """(difference, low, high), 95 %, by Student's t with one less than the number of base levels as degrees of freedom;
    None for fewer than two base levels. rates, others: of each level."""
    differences = [one - other for one, other in zip(rates, others, strict=True)]
    sums: dict[str, list[float]] = {}
    for difference, base in zip(differences, base_levels, strict=True):
        of_base = sums.setdefault(base, [0.0, 0.0])
        of_base[0] += difference
        of_base[1] += 1
    if (count := len(sums)) < 2:
        return None
    from scipy.special import stdtrit  # t quantiles; heavy

    mean = sum(differences) / len(differences)
    squares = sum((total - mean * number) ** 2 for total, number in sums.values())
    margin = float(stdtrit(count - 1, 0.975)) * math.sqrt(squares * count / (count - 1)) / len(differences)
    return mean, mean - margin, mean + margin
