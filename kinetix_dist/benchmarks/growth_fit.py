"""How steep cost grows with the number of shapes: the exponent of a power law through the points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kinetix_dist.benchmarks.growth_scenes import SCENES
from kinetix_dist.benchmarks.results import Record

FITTED_FROM_SHAPES = 64  # small heaps have fewer contacts a shape


def exponent(numbers: Sequence[float], costs: Sequence[float]) -> float:
    """k of cost = c number^k, by least squares in logarithms."""
    x, y = np.log(numbers), np.log(costs)
    return float(np.sum((x - x.mean()) * (y - y.mean())) / np.sum((x - x.mean()) ** 2))


def exponents(records: Sequence[Record], min_shapes: int = FITTED_FROM_SHAPES) -> dict[str, float]:
    """Of time a world-step over the number of shapes, from `min_shapes` on, by scene; none for a single point."""
    found = {}
    for name in SCENES:
        points = [
            (record["shapes"], record["us_per_world_step"])
            for record in records
            if record["scene"] == name and record["shapes"] >= min_shapes and record["left_out"] is None
        ]
        if len(points) > 1:
            found[name] = exponent(*zip(*points))
    return found
