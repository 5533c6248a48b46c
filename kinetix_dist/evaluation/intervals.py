"""Confidence intervals of a rate: how much of a difference between two solve rates could be chance.

Wilson's score interval: the rates p for which the observed share of k successes in n trials is within z standard
errors sqrt(p (1 - p) / n). Unlike p +- z sqrt(p (1 - p) / n) it is sensible at 0 and n successes and small n.
(E. B. Wilson, Probable inference, the law of succession, and statistical inference, 1927.)
"""

from __future__ import annotations

import math

Z_95 = 1.959963984540054  # 97.5 % quantile of the normal distribution: two-sided 95 %


def wilson_interval(num_successes: float, num_trials: int, z: float = Z_95) -> tuple[float, float]:
    """(low, high) of the success probability. Trials count as independent. Nothing is known of no trials: (0, 1).

    A trial may succeed in part, as the mean of several outcomes that are not independent: it varies no more then than
    one outcome does, and the interval is too wide rather than too narrow.
    """
    if num_trials < 0 or not 0 <= num_successes <= num_trials:
        raise ValueError(f"{num_successes} successes in {num_trials} trials is not possible")
    if num_trials == 0:
        return 0.0, 1.0
    rate = num_successes / num_trials
    shrink = 1 + z**2 / num_trials
    center = (rate + z**2 / (2 * num_trials)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / num_trials + z**2 / (4 * num_trials**2))
    # Exact at the ends, where rounding would leave 1e-17.
    low = 0.0 if num_successes == 0 else center - half
    high = 1.0 if num_successes == num_trials else center + half
    return low, high
