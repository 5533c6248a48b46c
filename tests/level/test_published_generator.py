"""Generator "kinetix" draws what the public package draws: statistics of 10,000 levels a size against its own 10,000.

`data/published_levels.json` was written by bench/published_levels.py from levels drawn by the package itself, which
shares no code with ours. Ten thousand draws differ by chance: of some 250 statistics the largest difference is then 3
to 4 standard errors.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GENERATORS, GeneratorConfig, generator
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.statistics import Comparison, compare, describe, read, statistics

REFERENCE = json.loads((Path(__file__).parent / "data" / "published_levels.json").read_text())["sizes"]
NUM_LEVELS = 10_000
MAX_DEVIATION = 4.5  # standard errors; 250 statistics exceed it by chance once in 500 runs


@functools.cache
def levels_of(size: str, config: GeneratorConfig, num_levels: int) -> Level:
    return generate_levels(jax.random.key(11), num_levels, SIZES[size], config)


@functools.cache
def rows_of(size: str, config: GeneratorConfig, num_levels: int = NUM_LEVELS) -> dict[str, Comparison]:
    found = statistics(levels_of(size, config, num_levels))
    return {row.name: row for row in compare(found, read(REFERENCE[size]))}


# What is true of M is of L, which has more of the same; the next test draws L too.
@pytest.mark.parametrize(
    "size", ["s", pytest.param("m", marks=pytest.mark.long), pytest.param("l", marks=pytest.mark.slow)]
)
def test_the_distribution_is_that_of_the_public_package(size: str) -> None:
    far = [row for row in rows_of(size, GENERATORS["kinetix"]).values() if not row.deviation < MAX_DEVIATION]
    assert not far


def test_our_own_distribution_differs_in_what_the_rules_of_the_package_change() -> None:
    rows = rows_of("m", GENERATORS["default"], 2000)
    for name in (
        "fixed joints 0",
        "joint of polygon and circle",
        "overlap within a body, not joined to each other",
        "circle sticks out of the narrow side",
        "outside limits at the start",
    ):
        assert rows[name].deviation > MAX_DEVIATION, rows[name]


@pytest.mark.long
@pytest.mark.parametrize(("details", "closest"), [((), 0.1), (("wide_margins",), 0.1 * 2**0.5)])
def test_wide_margins_keep_circles_from_the_walls(details: tuple[str, ...], closest: float) -> None:
    """Wide margins are a few centimetres, too little for the statistics above. Here every circle has a radius of 0.1
    m."""
    config = GeneratorConfig(published_details=details, max_shape_size=0.25, large_rectangle_chance=1.0)
    levels = jax.tree.map(np.asarray, levels_of("s", config, 2000))
    is_held = levels.scene.joints.active[:, :1] & (levels.scene.joints.b == np.array([5, 6]))  # may be anywhere
    x = levels.position[:, 5:, 0][levels.scene.shapes.active[:, 5:] & ~is_held]
    assert closest <= np.minimum(x, 5.0 - x).min() + 1e-6 < closest + 0.02


def test_statistics_are_read_as_they_were_described() -> None:
    found = statistics(levels_of("m", GENERATORS["default"], 2000))
    again = read(json.loads(json.dumps(describe(found))))
    assert all(row.deviation < 0.5 for row in compare(found, again))


def test_statistics_of_other_names_are_refused() -> None:
    found = statistics(levels_of("m", GENERATORS["default"], 2000))
    with pytest.raises(ValueError, match="only one of the two has radius"):
        compare(found, {name: value for name, value in read(describe(found)).items() if name != "radius"})


def test_an_unknown_generator_or_detail_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown generator 'brax'; generators are default, kinetix"):
        generator("brax")
    with pytest.raises(ValueError, match="published_details has 'magic'; there are contact_points"):
        GeneratorConfig(published_details=("magic",))
