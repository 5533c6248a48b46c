"""Two-level designs: levels of every arm, and aliased effects.

A factor is a word over basic columns, stored as a set of bits; the product of two factors is the exclusive or of their
words, and two products are aliases where their words are the same. The fold-over is one basic column more, which
changes the sign of all factors, so that words of odd and of even products differ in it.
(G. Box, S. Hunter, W. Hunter, Statistics for Experimenters, chapters 5 and 6.)
"""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np

from kinetix_dist.sweep.design import DesignError, Factorial

MAX_FACTORS = 15  # words of all products are enumerated: 2^15 of them


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoLevelDesign:
    """Two-level design. `fold_over`: the second half, with all levels changed, belongs to it."""

    names: tuple[str, ...]  # of the factors
    words: tuple[int, ...]  # of the factors, as bits over basic columns, without the fold-over
    num_basic: int
    fold_over: bool

    @property
    def num_columns(self) -> int:
        """Basic columns, with that of the fold-over."""
        return self.num_basic + self.fold_over

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """[arms, num_columns] of -1 and 1, in standard order: the first column changes fastest, the fold-over last (-1
        in the second half)."""
        number = np.arange(2**self.num_basic)
        basic = 2 * ((number[:, None] >> np.arange(self.num_basic)) & 1) - 1
        if not self.fold_over:
            return basic
        halves = [np.column_stack([basic, np.full(len(basic), sign)]) for sign in (1, -1)]
        return np.concatenate(halves)

    @property
    def factor_words(self) -> tuple[int, ...]:
        """Words of the factors with the column of the fold-over, which all of them have."""
        return tuple(word | (self.fold_over << self.num_basic) for word in self.words)

    @property
    def levels(self) -> np.ndarray:
        """[arms, factors] of -1 and 1."""
        return np.column_stack([self.column(word) for word in self.factor_words])

    def column(self, word: int) -> np.ndarray:
        """[arms] of -1 and 1: the product of the basic columns of a word."""
        chosen = [index for index in range(self.num_columns) if word >> index & 1]
        return self.columns[:, chosen].prod(axis=1)

    @functools.cached_property
    def orders(self) -> dict[int, int]:
        """Number of factors of the shortest product that gives each word; words that none gives are left out. Word 0
        has the order of the shortest product that is constant: the resolution."""
        orders: dict[int, int] = {}
        words = self.factor_words
        products = [0] * (1 << len(words))  # of every set of factors, a set being the bits of its number
        for members in range(1, 1 << len(words)):
            lowest = members & -members
            products[members] = products[members ^ lowest] ^ words[lowest.bit_length() - 1]
            size = members.bit_count()
            orders[products[members]] = min(size, orders.get(products[members], size))
        return orders

    @property
    def resolution(self) -> int | None:
        """Length of the shortest product of factors that is constant; None in a full design: there is none."""
        return self.orders.get(0)

    def aliases(self) -> dict[str, list[str]]:
        """Two-factor interactions, as "a x b", that are aliases of each factor's main effect."""
        found: dict[str, list[str]] = {name: [] for name in self.names}
        by_word = dict(zip(self.factor_words, self.names, strict=True))
        for (a, word_a), (b, word_b) in itertools.combinations(zip(self.names, self.factor_words, strict=True), 2):
            if (name := by_word.get(word_a ^ word_b)) is not None:
                found[name].append(f"{a} x {b}")
        return found

    def first_half(self) -> TwoLevelDesign:
        """The design without its fold-over."""
        return dataclasses.replace(self, fold_over=False)


def two_level_design(factorial: Factorial) -> TwoLevelDesign:
    """The two-level design of a factorial. Raises DesignError where two factors are aliases."""
    names = tuple(factor.name for factor in factorial.factors)
    if len(names) > MAX_FACTORS:
        raise DesignError(f"factorial has {len(names)} factors; at most {MAX_FACTORS} can be planned")
    basic = {name: 1 << index for index, name in enumerate(f.name for f in factorial.factors if not f.generator)}
    words = tuple(
        functools.reduce(lambda word, name: word ^ basic[name], factor.generator, 0)
        if factor.generator
        else basic[factor.name]
        for factor in factorial.factors
    )
    by_word: dict[int, str] = {}
    for name, word in zip(names, words, strict=True):
        if word in by_word:
            raise DesignError(
                f"factors {by_word[word]} and {name} have the same levels in every arm; give one another generator"
            )
        by_word[word] = name
    return TwoLevelDesign(names=names, words=words, num_basic=len(basic), fold_over=factorial.fold_over)
