"""Summaries of a set's solved attempts per level, other than their mean. No jax: results are also summed up later.

worst_share(solved, attempts)          mean rate of the tenth of the levels that were solved least
best_of(solved, attempts, k)           share of levels that k attempts would solve at least once
above_random(rate, random_rate)        0: as random actions, 1: everything
"""

from __future__ import annotations

import math
from collections.abc import Sequence

WORST_SHARE = 0.1


def worst_share(solved: Sequence[int], attempts: int, share: float = WORST_SHARE) -> float:
    """Mean rate of the `share` of the levels (rounded up) with the lowest rates: CVaR of the solve rate.

    solved: attempts that solved each level, of `attempts`. The levels are chosen by the attempts that rate them, so
    it is below the truth, the more the fewer attempts: of levels that are all solved half of the time, ten attempts
    each, the worst tenth is at 0.23. Compare it only at equal attempts.
    """
    _check(solved, attempts)
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share is {share}; it must be above 0 and at most 1")
    worst = sorted(solved)[: math.ceil(round(share * len(solved), 9))]
    return sum(worst) / (len(worst) * attempts)


def best_of(solved: Sequence[int], attempts: int, k: int) -> float:
    """Expected share of levels that k attempts, drawn from the `attempts` made, solve at least once.

    A level that s of n attempts solved counts 1 - C(n - s, k) / C(n, k): unbiased for k independent attempts
    (Chen et al. 2021, Evaluating large language models trained on code, section 2.1). k = 1 is the mean rate.
    """
    _check(solved, attempts)
    if not 1 <= k <= attempts:
        raise ValueError(f"best of {k} cannot be estimated from {attempts} attempts; choose 1 to {attempts}")
    failures = sum(math.comb(attempts - count, k) for count in solved)
    return 1.0 - failures / (math.comb(attempts, k) * len(solved))


def above_random(rate: float, random_rate: float) -> float | None:
    """(rate - random) / (1 - random), negative below random actions; None where these solve everything."""
    return None if random_rate >= 1.0 else (rate - random_rate) / (1.0 - random_rate)


def _check(solved: Sequence[int], attempts: int) -> None:
    if not len(solved):
        raise ValueError("there are no levels to sum up")
    if attempts < 1 or min(solved) < 0 or max(solved) > attempts:
        raise ValueError(f"{min(solved)} to {max(solved)} of {attempts} attempts cannot have solved a level")
