"""What holds for the values of every scene, beyond shapes, kinds and being finite: one table of rules.

Rules speak of what is active; slots that are not may hold anything finite. Plain numpy over whole batches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Of a polygon's extent: what vertices may be off by, from rounding and from the public levels' own centres of mass.
OFF_CENTRE = 1e-3
ROUNDING = 1e-5


class Rule(NamedTuple):
    """`holds` of the arrays of `fields` is False where the first field is wrong."""

    fields: tuple[str, ...]
    holds: Callable[..., np.ndarray]
    must: str


def _not_negative(number: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~is_on | (number >= 0)


def _is_share(number: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~is_on | ((number >= 0) & (number <= 1))


def _is_shape(index: np.ndarray, is_on: np.ndarray, shape_active: np.ndarray) -> np.ndarray:
    return ~is_on | ((index >= 0) & (index < shape_active.shape[-1]))


def _is_count(number: np.ndarray, shape_active: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    return ~_polygons(shape_active, number) | ((number >= 3) & (number <= vertices.shape[-2]))


def _has_radius(radius: np.ndarray, shape_active: np.ndarray) -> np.ndarray:
    return ~shape_active[..., shape_active.shape[-1] - radius.shape[-1] :] | (radius > 0)


def _same_both_ways(can_touch: np.ndarray) -> np.ndarray:
    return can_touch == np.swapaxes(can_touch, -1, -2)


def _differs(b: np.ndarray, a: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~is_on | (a != b)


def _motor_has_power(power: np.ndarray, motor_on: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~(is_on & motor_on) | (power >= 0)


def _in_order(lower: np.ndarray, upper: np.ndarray, has_limits: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~(is_on & has_limits) | (lower <= upper)


def _polygons(shape_active: np.ndarray, num_vertices: np.ndarray) -> np.ndarray:
    """[..., P] bool, of [..., n] what is about polygons."""
    return shape_active[..., : num_vertices.shape[-1]]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _convex(vertices: np.ndarray, num_vertices: np.ndarray, shape_active: np.ndarray) -> np.ndarray:
    return _of_each(_is_convex, vertices, num_vertices, _polygons(shape_active, num_vertices))


def _centred(
    vertices: np.ndarray,
    num_vertices: np.ndarray,
    shape_active: np.ndarray,
    inverse_mass: np.ndarray,
    inverse_inertia: np.ndarray,
) -> np.ndarray:
    """Of those that can move: walls of the published engine are not."""
    moves = shape_active & ((inverse_mass > 0) | (inverse_inertia > 0))
    return _of_each(_is_centred, vertices, num_vertices, _polygons(moves, num_vertices))


def _of_each(
    is_fine: Callable[[np.ndarray], np.ndarray], vertices: np.ndarray, num_vertices: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """[..., P] bool; `is_fine` takes the corners of all polygons of one number of vertices, [how many, number, 2]."""
    fine = np.ones(num_vertices.shape, bool)
    for number in range(3, vertices.shape[-2] + 1):
        chosen = asked & (num_vertices == number)
        if chosen.any():
            fine[chosen] = is_fine(vertices[chosen][:, :number].astype(np.float64))
    return fine


def _is_convex(corner: np.ndarray) -> np.ndarray:
    """Left turns only, of one full turn in all, around some area."""
    edge = np.roll(corner, -1, 1) - corner
    next_edge = np.roll(edge, -1, 1)
    turn = _cross(edge, next_edge)
    length = np.abs(edge).sum(-1)
    rounding = ROUNDING * length.sum(-1, keepdims=True) * (length + np.roll(length, -1, 1))
    convex = (turn >= -rounding).all(-1) & (_twice_area(corner) > 0) & (length > 0).all(-1)
    if corner.shape[1] >= 5:  # a pentagram turns around twice
        convex &= np.arctan2(turn, (edge * next_edge).sum(-1)).sum(-1) < 3 * math.pi
    return convex


def _is_centred(corner: np.ndarray) -> np.ndarray:
    local = corner - corner[:, :1]
    cross = _cross(local, np.roll(local, -1, 1))
    twice_area = cross.sum(-1)
    centre = corner[:, 0] + (cross[..., None] * (local + np.roll(local, -1, 1))).sum(1) / (3 * twice_area[:, None])
    extent = np.abs(local).max((1, 2))
    # A sliver's centre of mass moves along it when its vertices are rounded.
    return np.abs(centre).max(-1) <= extent * (OFF_CENTRE + ROUNDING * extent**2 / twice_area)


def _twice_area(corner: np.ndarray) -> np.ndarray:
    local = corner - corner[:, :1]
    return _cross(local, np.roll(local, -1, 1)).sum(-1)


_INDEX = "be the index of a shape"
SCENE_RULES = (
    Rule(("inverse_mass", "shape_active"), _not_negative, "be 0 (fixed) or more"),
    Rule(("inverse_inertia", "shape_active"), _not_negative, "be 0 (does not turn) or more"),
    Rule(("friction", "shape_active"), _not_negative, "be 0 or more"),
    Rule(("restitution", "shape_active"), _is_share, "be from 0 to 1"),
    Rule(("num_vertices", "shape_active", "vertices"), _is_count, "be from 3 to Capacity.vertices"),
    Rule(("vertices", "num_vertices", "shape_active"), _convex, "be convex, counter-clockwise"),
    Rule(
        ("vertices", "num_vertices", "shape_active", "inverse_mass", "inverse_inertia"),
        _centred,
        "have its centre of mass at (0, 0)",
    ),
    Rule(("radius", "shape_active"), _has_radius, "be positive"),
    Rule(("can_touch",), _same_both_ways, "be the same for [i, j] and [j, i]"),
    Rule(("joint_a", "joint_active", "shape_active"), _is_shape, _INDEX),
    Rule(("joint_b", "joint_active", "shape_active"), _is_shape, _INDEX),
    Rule(("joint_b", "joint_a", "joint_active"), _differs, "be another shape than joint_a"),
    Rule(("motor_power", "motor_on", "joint_active"), _motor_has_power, "be 0 or more"),
    Rule(("lower_limit", "upper_limit", "has_limits", "joint_active"), _in_order, "be at most upper_limit"),
    Rule(("thruster_body", "thruster_active", "shape_active"), _is_shape, _INDEX),
)
