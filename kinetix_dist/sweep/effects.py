"""Main effects of factors with their errors, and means of arms.

The effect of a factor is the mean over arms at its high level less that at its low level: with N runs, half of them
each, its variance is 4 sigma^2 / N. sigma is estimated
    from replicates    by the variance within arms that were trained with several seeds; or, where there are none,
    from contrasts     that no factor has a part in: each is such a difference of halves, and were its interactions 0
                       its square would estimate the variance of an effect. Those that stand for products of three
                       factors or more are taken; where there are none of these, those of two.
Intervals are of Student's t with the degrees of freedom of that estimate.
(G. Box, S. Hunter, W. Hunter, Statistics for Experimenters, chapter 5.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from kinetix_dist.evaluation.intervals import has_spread, t_95
from kinetix_dist.sweep.factorial import TwoLevelDesign

HIGH_ORDER = 3  # products of so many factors are taken for noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class Error:
    """Standard error with the source of its estimate."""

    standard_error: float
    degrees_of_freedom: int
    source: str  # in words

    @property
    def margin(self) -> float:
        """Half of an interval."""
        return t_95(self.degrees_of_freedom) * self.standard_error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A value with its interval; no error where nothing says how large it is."""

    name: str
    value: float
    error: Error | None

    def as_json(self) -> dict[str, object]:
        """Return the estimate for JSON; `low` and `high` are null without an error, and where it has no spread (0)."""
        error = self.error
        margin = None if error is None else error.margin
        if margin is not None and not has_spread(self.value - margin, self.value + margin):
            margin = None
        return {
            "name": self.name,
            "value": self.value,
            "standard_error": None if error is None else error.standard_error,
            "degrees_of_freedom": None if error is None else error.degrees_of_freedom,
            "error_from": None if error is None else error.source,
            "low": None if margin is None else self.value - margin,
            "high": None if margin is None else self.value + margin,
        }


def main_effects(design: TwoLevelDesign, values: Sequence[Sequence[float]]) -> list[Estimate]:
    """Main effects of all factors, in their order. values: of each arm in the order of `design.levels`, one a seed;
    as many seeds in every arm of a half (ValueError)."""
    counts = [len(of_arm) for of_arm in values]
    if len(counts) != len(design.levels) or min(counts) < 1:
        raise ValueError(f"{len(counts)} arms with {counts} values; {len(design.levels)} arms are needed")
    means = np.array([np.mean(of_arm) for of_arm in values])
    error = _from_replicates(values, counts) or _from_contrasts(design, means)
    return [
        Estimate(name=name, value=contrast(design.column(word), means), error=error)
        for name, word in zip(design.names, design.factor_words, strict=True)
    ]


def contrast(signs: np.ndarray, values: np.ndarray) -> float:
    """Mean of the values with sign 1 less that of those with -1."""
    return float(values[signs > 0].mean() - values[signs < 0].mean())


def mean_of_arms(values: Mapping[str, Sequence[float]]) -> list[Estimate]:
    """Means over seeds. Their error is of the variance within arms, of all arms together."""
    variance = _within(list(values.values()))
    return [
        Estimate(
            name=name,
            value=float(np.mean(of_arm)),
            error=None
            if variance is None
            else Error(
                standard_error=float(np.sqrt(variance[0] / len(of_arm))),
                degrees_of_freedom=variance[1],
                source="seeds of all arms",
            ),
        )
        for name, of_arm in values.items()
    ]


def _within(values: Sequence[Sequence[float]]) -> tuple[float, int] | None:
    """(variance within arms, degrees of freedom); None where no arm has two values."""
    freedom = sum(len(of_arm) - 1 for of_arm in values)
    if freedom < 1:
        return None
    return sum(float(((np.array(v) - np.mean(v)) ** 2).sum()) for v in values) / freedom, freedom


def _from_replicates(values: Sequence[Sequence[float]], counts: Sequence[int]) -> Error | None:
    if (found := _within(values)) is None:
        return None
    # An effect is the difference of means of N / 2 arms each, which weigh the same however many seeds they have.
    variance = found[0] * 4 / len(counts) ** 2 * sum(1 / count for count in counts)
    return Error(standard_error=float(np.sqrt(variance)), degrees_of_freedom=found[1], source="seeds")


def _from_contrasts(design: TwoLevelDesign, means: np.ndarray) -> Error | None:
    # The column of the fold-over itself also stands for its other seeds.
    fold_over = {1 << design.num_basic} if design.fold_over else set()
    words = set(range(1, 1 << design.num_columns)) - set(design.factor_words) - fold_over
    # Words that no product of factors gives stand for nothing but noise.
    high = [word for word in words if design.orders.get(word, HIGH_ORDER) >= HIGH_ORDER]
    chosen = high or sorted(words)
    if not chosen:
        return None
    squares = [contrast(design.column(word), means) ** 2 for word in chosen]
    order = f"{HIGH_ORDER} factors or more" if high else "two factors"
    return Error(
        standard_error=float(np.sqrt(np.mean(squares))),
        degrees_of_freedom=len(chosen),
        source=f"contrasts of {order}",
    )
