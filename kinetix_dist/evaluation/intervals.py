"""Confidence intervals of a rate: how much of a difference between two solve rates could be chance.

Two intervals answer two questions:

    wilson_interval         what is the rate on these levels?   Attempts are the sample.
    interval_of_mean        the same, of rates that each level has on its own.
    interval_over_levels    what is it on levels like these?    Base levels are the sample.

Wilson's score interval: the rates p for which the observed share of k successes in n trials is within z standard
errors sqrt(p (1 - p) / n). Unlike p +- z sqrt(p (1 - p) / n) it is sensible at 0 and n successes and small n.
(E. B. Wilson, Probable inference, the law of succession, and statistical inference, 1927.)

Attempts at one level, and variants of one level, are alike: ten base levels of which each is either mastered or not say
no more of an eleventh by being played a hundred times. `interval_over_levels` estimates the variance of the rate from
base levels (clusters), as of a ratio of their sums, and is Wilson's interval for as many independent trials as have
that variance (the effective sample size), with the quantile of Student's t for one less than the number of base levels.
(E. L. Korn and B. I. Graubard, Confidence intervals for proportions with small expected number of positive counts
estimated from survey data, 1998.) With few base levels, or rates near 0 and 1, it is approximate.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from typing import Any

Z_95 = 1.959963984540054  # 97.5 % quantile of the normal distribution: two-sided 95 %

Estimate = tuple[float, float, float]  # value, and the ends of its interval


def wilson_interval(num_successes: float, num_trials: int, z: float = Z_95) -> tuple[float, float]:
    """(low, high) of the success probability. Trials count as independent. Nothing is known of no trials: (0, 1).

    A trial may succeed in part, as the mean of several outcomes that are not independent: it varies no more then than
    one outcome does, and the interval is too wide rather than too narrow.
    """
    if num_trials < 0 or not 0 <= num_successes <= num_trials:
        raise ValueError(f"{num_successes} successes in {num_trials} trials is not possible")
    if num_trials == 0:
        return 0.0, 1.0
    return _score_interval(num_successes / num_trials, num_trials, z)


def interval_over_levels(
    solved: Sequence[int], attempts: int, base_levels: Sequence[str], comparisons: int = 1
) -> dict[str, Any] | None:
    """{"low", "high", "base_levels", "levels": how many} of the solve rate on levels like these, 95 %; None for fewer
    than two base levels, which say nothing of others.

    solved: of each level, of `attempts`; base_levels: of each level, the one that it is a variant of, or itself.
    comparisons: intervals that hold together (Bonferroni).
    """
    if attempts < 1 or any(not 0 <= count <= attempts for count in solved):
        raise ValueError(f"{list(solved)} of {attempts} attempts cannot have solved the levels")
    sums: dict[str, list[int]] = {}
    for count, base in zip(solved, base_levels, strict=True):
        of_base = sums.setdefault(base, [0, 0])
        of_base[0] += count
        of_base[1] += attempts
    count = len(sums)
    if count < 2:
        return None
    trials = len(solved) * attempts
    rate = sum(solved) / trials
    variance = variance_of_ratio(sums.values(), rate)
    binomial = rate * (1 - rate)
    # All or none solved: each base level is a trial. More than all attempts there cannot be.
    effective = min(binomial / variance, trials) if variance > 0 else (trials if binomial > 0 else count)
    quantile = t_95(count - 1, comparisons)
    low, high = _score_interval(rate, effective, quantile)
    # Nearly all or none solved: the few levels that differ say nothing of the next one. Wide enough for base levels of
    # which all or none are solved.
    low = min(low, _score_interval(1.0, count, quantile)[0])
    high = max(high, _score_interval(0.0, count, quantile)[1])
    return {"low": low, "high": high, "base_levels": count, "levels": len(solved)}


def variance_of_ratio(sums: Collection[Sequence[float]], ratio: float) -> float:
    """Variance of a ratio of sums over two clusters or more: (sum, size) of each."""
    count = len(sums)
    squares = sum((total - ratio * size) ** 2 for total, size in sums)
    return squares / sum(size for _, size in sums) ** 2 * count / (count - 1)


NO_SPREAD = "no spread"  # words in place of an interval that would have no width
NO_WIDTH = 1e-12  # of an interval, relative to its larger end or 1: rounding leaves that much


def has_spread(low: float, high: float) -> bool:
    """Return True if an interval has any width: one without would claim certainty, though nothing is known."""
    return high - low > NO_WIDTH * max(1.0, abs(low), abs(high))


def t_95(degrees_of_freedom: float, comparisons: int = 1) -> float:
    """97.5 % quantile of Student's t: two-sided 95 %, of so many comparisons together (Bonferroni)."""
    from scipy.special import stdtrit  # heavy

    return float(stdtrit(degrees_of_freedom, 1 - 0.025 / comparisons))


def z_95(comparisons: int = 1) -> float:
    """The same quantile of the normal distribution."""
    return statistics.NormalDist().inv_cdf(1 - 0.025 / comparisons)


def difference_interval(estimate: Estimate, other: Estimate) -> Estimate:
    """(difference, low, high) of two independent estimates (value, low, high), from the interval of each.

    Unlike a difference of two normal estimates it is sensible near 0 and 1, since the intervals are. Where the two are
    positively correlated, as two evaluations of the same levels, it is too wide rather than too narrow.
    (R. G. Newcombe, Interval estimation for the difference between independent proportions, 1998, method 10.)
    """
    (value, low, high), (other_value, other_low, other_high) = estimate, other
    difference = value - other_value
    return (
        difference,
        difference - math.hypot(value - low, other_high - other_value),
        difference + math.hypot(high - value, other_value - other_low),
    )


def interval_of_mean(estimates: Sequence[Estimate]) -> Estimate:
    """(mean, low, high) of independent estimates (value, low, high), from the interval of each.

    Where each is of one level, it is narrower than Wilson's of all attempts together: those of a level are compared
    with that level's rate alone. (G. Y. Zou and A. Donner, Construction of confidence limits about effect measures: a
    general approach, 2008.)
    """
    mean = sum(value for value, _, _ in estimates) / len(estimates)
    below = math.sqrt(sum((value - low) ** 2 for value, low, _ in estimates)) / len(estimates)
    above = math.sqrt(sum((high - value) ** 2 for value, _, high in estimates)) / len(estimates)
    return mean, mean - below, mean + above


def for_readers(rate: Mapping[str, Any]) -> tuple[float, float]:
    """The interval to show with a rate {"low", "high", "interval_over_levels"}: over base levels for a set of variants,
    which is a sample of levels like its base levels; over attempts for other sets, which are what they are."""
    over = rate.get("interval_over_levels")
    shown = over if over is not None and over["base_levels"] < over["levels"] else rate
    return shown["low"], shown["high"]


def _score_interval(rate: float, num_trials: float, z: float) -> tuple[float, float]:
    """Wilson's; trials need not be a whole number."""
    shrink = 1 + z**2 / num_trials
    center = (rate + z**2 / (2 * num_trials)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / num_trials + z**2 / (4 * num_trials**2))
    # Exact at the ends, where rounding would leave 1e-17.
    low = 0.0 if rate == 0 else center - half
    high = 1.0 if rate == 1 else center + half
    return low, high
