"""Overlap of circles and polygons, against cases worked by hand."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.level.overlap import inset, reach, separation, surface_distance

SQUARE = jnp.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
POINT = jnp.zeros((4, 2))
TRIANGLE = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [0.0, 2.0]])  # the last corner is padding


@pytest.mark.parametrize(
    ("corners_a", "radius_a", "corners_b", "radius_b", "gap"),
    [
        (SQUARE, 0.0, SQUARE + jnp.array([3.0, 0.0]), 0.0, 1.0),
        (SQUARE, 0.0, SQUARE + jnp.array([1.5, 1.8]), 0.0, -0.2),
        (POINT, 0.5, POINT + jnp.array([0.0, 2.0]), 0.7, 0.8),
        (POINT, 0.5, POINT + jnp.array([0.0, 1.0]), 0.7, -0.2),
        (SQUARE, 0.0, POINT + jnp.array([1.5, 0.0]), 0.4, 0.1),
        (SQUARE, 0.0, POINT + jnp.array([2.0, 2.0]), 1.0, np.sqrt(2.0) - 1.0),  # nearest is the corner
        (TRIANGLE, 0.0, POINT + jnp.array([1.5, 1.5]), 0.5, np.sqrt(0.5) - 0.5),
        (TRIANGLE, 0.0, SQUARE * 0.4 + jnp.array([1.6, 1.6]), 0.0, np.sqrt(0.5) * 0.4),
    ],
)
def test_separation(corners_a: object, radius_a: float, corners_b: object, radius_b: float, gap: float) -> None:
    there = separation(corners_a, jnp.array(radius_a), corners_b, jnp.array(radius_b))
    back = separation(corners_b, jnp.array(radius_b), corners_a, jnp.array(radius_a))
    np.testing.assert_allclose([there, back], gap, atol=1e-6)


@pytest.mark.parametrize(
    ("corners_a", "radius_a", "corners_b", "radius_b", "gap"),
    [
        (SQUARE, 0.0, SQUARE + jnp.array([3.0, 4.0]), 0.0, np.hypot(1.0, 2.0)),  # corner to corner
        (SQUARE, 0.0, SQUARE + jnp.array([1.5, 1.8]), 0.0, -0.2),
        (SQUARE, 0.0, POINT + jnp.array([2.0, 2.0]), 1.0, np.sqrt(2.0) - 1.0),
        (TRIANGLE, 0.0, POINT + jnp.array([1.5, 1.5]), 0.0, np.sqrt(0.5)),
        (POINT, 0.5, POINT + jnp.array([0.0, 2.0]), 0.7, 0.8),
    ],
)
def test_surface_distance(corners_a: object, radius_a: float, corners_b: object, radius_b: float, gap: float) -> None:
    there = surface_distance(corners_a, radius_a, corners_b, radius_b)
    back = surface_distance(corners_b, radius_b, corners_a, radius_a)
    np.testing.assert_allclose([there, back], gap, atol=1e-6)


def test_one_shape_inside_another_overlaps() -> None:
    assert separation(SQUARE, jnp.array(0.0), SQUARE * 0.1, jnp.array(0.0)) < 0
    assert separation(SQUARE, jnp.array(0.0), POINT, jnp.array(0.1)) < 0


def test_reach_and_inset_of_a_square_and_a_disc() -> None:
    at = jnp.array([0.5, 0.0])
    np.testing.assert_allclose(reach(at, SQUARE, jnp.array(0.0)), np.hypot(1.5, 1.0), rtol=1e-6)
    np.testing.assert_allclose(inset(at, SQUARE, jnp.array(0.0)), 0.5, rtol=1e-6)
    np.testing.assert_allclose(inset(at, POINT, jnp.array(2.0)), 1.5, rtol=1e-6)
    np.testing.assert_allclose(inset(jnp.array([0.5, 0.5]), TRIANGLE, jnp.array(0.0)), 0.5, rtol=1e-6)
