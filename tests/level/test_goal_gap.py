"""The distance that counts for solving: from the edge of green to that of blue, by hand-worked figures."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from kinetix_dist.level.goal_gap import goal_gap, goal_pairs
from kinetix_dist.level.level import Level, Role
from kinetix_dist.level.schema import level_from_json


def level_of(green: dict[str, Any], blue: dict[str, Any]) -> Level:
    shapes = [{"id": "g", "role": "green", **green}, {"id": "b", "role": "blue", **blue}]
    return level_from_json({"format": "kinetix-dist-level", "version": 1, "name": "x", "size": "m", "shapes": shapes})


def box(x: float, y: float, angle: float = 0.0) -> dict[str, Any]:
    return {"type": "box", "width": 0.4, "height": 0.2, "position": [x, y], "angle": angle}


def circle(x: float, y: float) -> dict[str, Any]:
    return {"type": "circle", "radius": 0.3, "position": [x, y]}


@pytest.mark.parametrize(
    ("green", "blue", "gap"),
    [
        (circle(1, 2), circle(3, 2), 1.4),  # 2 - 0.3 - 0.3
        (box(1, 2), circle(3, 2), 1.5),  # 2 - 0.2 - 0.3
        (box(1, 2), circle(1.2 + 0.3, 2.1 + 0.4), 0.2),  # corner to centre 0.5, less 0.3
        (box(1, 2), box(1.4 + 0.3, 2.2 + 0.4), 0.5),  # corner to corner, 3-4-5; along an axis 0.4 at most
        (box(1, 2), box(1, 2.6, np.pi / 2), 0.3),  # turned upright: 0.6 - 0.1 - 0.2
        (circle(1, 2), circle(1.4, 2), 0.0),  # they overlap
    ],
)
def test_the_gap_is_that_of_the_edges(green: dict[str, Any], blue: dict[str, Any], gap: float) -> None:
    level = level_of(green, blue)
    found = jax.jit(goal_gap)(goal_pairs(level), level.position, level.angle)
    assert float(found) == pytest.approx(gap, abs=1e-6)  # float32


def test_of_several_pairs_the_closest_counts_and_without_one_there_is_no_distance() -> None:
    level = level_of(circle(1, 2), circle(3, 2))
    roles = np.array(level.shape_role)
    roles[0] = Role.BLUE  # the floor, 0.4 m high: 2 - 0.3 - 0.4
    pairs = goal_pairs(dataclasses.replace(level, shape_role=roles))
    assert len(pairs.slots) == 2
    assert float(goal_gap(pairs, level.position, level.angle)) == pytest.approx(1.3, abs=1e-6)
    none = goal_pairs(dataclasses.replace(level, shape_role=np.zeros_like(roles)))
    assert float(goal_gap(none, level.position, level.angle)) == 0
