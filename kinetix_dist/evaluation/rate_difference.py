"""Difference of two solve rates on one set of levels, with a 95 % interval, for readers of a table.

    difference_of_rates       by solved and attempts alone: attempts are the sample
    difference_for_readers    as `intervals.for_readers`: over base levels where a set has variants of them

Over attempts it is Newcombe's interval, made from Wilson's of both rates (`intervals.difference_interval`). The two
policies play the same levels, so that attempts differ less than independent ones: it is too wide rather than too
narrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from kinetix_dist.evaluation.intervals import difference_interval, wilson_interval
from kinetix_dist.evaluation.paired_levels import difference_over_levels


class Difference(NamedTuple):
    """A rate less another, and its 95 % interval."""

    difference: float
    low: float
    high: float


def difference_of_rates(solved: int, attempts: int, other_solved: int, other_attempts: int) -> Difference:
    """Rate less the other rate. Raises ValueError for no attempts, or more solved than attempts."""
    if min(attempts, other_attempts) < 1:
        raise ValueError(f"a difference of rates of {attempts} and {other_attempts} attempts is not defined")
    rate = (solved / attempts, *wilson_interval(solved, attempts))
    other = (other_solved / other_attempts, *wilson_interval(other_solved, other_attempts))
    return Difference(*difference_interval(rate, other))


def difference_for_readers(
    solved: Sequence[int], attempts: int, other_solved: Sequence[int], other_attempts: int, base_levels: Sequence[str]
) -> Difference:
    """Difference of the rates of a set. solved, other_solved: of each level, in the same order.

    Over base levels it is never narrower than over attempts: a few base levels that gain alike have no spread.
    """
    num_levels = len(base_levels)
    over_attempts = difference_of_rates(
        sum(solved), attempts * num_levels, sum(other_solved), other_attempts * num_levels
    )
    if len(set(base_levels)) == num_levels:
        return over_attempts
    rates = [count / attempts for count in solved]
    others = [count / other_attempts for count in other_solved]
    found = difference_over_levels(rates, others, base_levels)
    if found is None:
        return over_attempts
    return Difference(over_attempts.difference, min(found[1], over_attempts.low), max(found[2], over_attempts.high))
