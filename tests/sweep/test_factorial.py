"""Two-level designs: levels, aliases and resolution against the ones in textbooks."""

import itertools

import numpy as np
import pytest

from kinetix_dist.sweep.design import DesignError, Factor, Factorial
from kinetix_dist.sweep.factorial import two_level_design

# 2^(7-4) of Box, Hunter & Hunter: D = AB, E = AC, F = BC, G = ABC.
SEVEN = {"A": "", "B": "", "C": "", "D": "AB", "E": "AC", "F": "BC", "G": "ABC"}


def factorial(generators, *, fold_over=False):
    """One option a factor."""
    return Factorial(
        factors=tuple(
            Factor(name=name, low={f"x.{name}": 0}, high={f"x.{name}": 1}, generator=tuple(generator))
            for name, generator in generators.items()
        ),
        fold_over=fold_over,
    )


def seven(*, fold_over):
    return two_level_design(factorial(SEVEN, fold_over=fold_over))


def test_a_full_design_has_every_combination_once_and_no_alias():
    design = two_level_design(factorial({"A": "", "B": "", "C": ""}))
    assert sorted(map(tuple, design.levels.tolist())) == sorted(itertools.product((-1, 1), repeat=3))
    assert design.resolution is None
    assert design.aliases() == {"A": [], "B": [], "C": []}


def test_the_fraction_of_seven_factors_in_eight_arms():
    design = seven(fold_over=False)
    a, b, c, d, e, f, g = design.levels.T
    for product, column in ((a * b, d), (a * c, e), (b * c, f), (a * b * c, g)):
        np.testing.assert_array_equal(product, column)
    np.testing.assert_array_equal(design.levels.T @ design.levels, 8 * np.eye(7))  # balanced and orthogonal
    assert design.resolution == 3
    assert design.aliases()["A"] == ["B x D", "C x E", "F x G"]  # as in their table
    assert all(len(interactions) == 3 for interactions in design.aliases().values())


def test_the_fold_over_has_all_levels_changed_and_resolution_four():
    design = seven(fold_over=True)
    np.testing.assert_array_equal(design.levels[:8], seven(fold_over=False).levels)
    np.testing.assert_array_equal(design.levels[8:], -design.levels[:8])
    assert design.resolution == 4
    assert not any(design.aliases().values())


def test_aliases_are_those_of_the_columns_themselves():
    design = two_level_design(factorial({"A": "", "B": "", "C": "", "D": "", "E": "ABC", "F": "BCD"}))
    columns = dict(zip(design.names, design.levels.T))
    for name, interactions in design.aliases().items():
        same = [
            f"{a} x {b}"
            for a, b in itertools.combinations(design.names, 2)
            if np.array_equal(columns[a] * columns[b], columns[name])
        ]
        assert interactions == same
    assert design.resolution == 4


def test_designs_that_cannot_tell_factors_apart_are_refused():
    with pytest.raises(DesignError, match="factors C and D have the same levels in every arm"):
        two_level_design(factorial({"A": "", "B": "", "C": "AB", "D": "AB"}))
    with pytest.raises(DesignError, match="at most 15 can be planned"):
        two_level_design(factorial({f"f{number}": "" for number in range(16)}))
    with pytest.raises(DesignError, match="generator 'D', which is no basic factor; these are A, B"):
        factorial({"A": "", "B": "", "C": "AD"})
    with pytest.raises(DesignError, match="needs a generator of two different factors or more"):
        factorial({"A": "", "B": "", "C": "A"})
