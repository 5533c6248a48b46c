"""Rules for the values of every scene, beyond shapes, types and being finite.

Limits of single numbers follow from the declarations of the fields; rules about several fields stand here. Rules speak
of what is active; slots that are not may hold anything finite. Plain numpy over whole batches.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from jax2d.fields import Field, field_of, fields_of
from jax2d.scene import JointDrive, JointKind, Scene
from jax2d.xla.vec2 import cross

# Of a polygon's extent: what vertices may be off by, from rounding and from the public levels' own centres of mass.
OFF_CENTRE = 1e-3
ROUNDING = 1e-5


class Rule(NamedTuple):
    """`holds` of the arrays of `fields` is False where the first field is wrong."""

    fields: tuple[Field, ...]
    holds: Callable[..., np.ndarray]
    must: str


def _rule(names: str, holds: Callable[..., np.ndarray], must: str) -> Rule:
    return Rule(tuple(field_of(Scene, name) for name in names.split()), holds, must)


def _declared() -> Iterator[Rule]:
    """Limits that fields are declared with."""
    for field in fields_of(Scene):
        has_range = (field.at_least, field.at_most, field.above) != (None, None, None)
        if not has_range and field.refers_to is None:
            continue
        owner = "shapes.active" if field.path[0] == "shapes" else f"{field.path[0]}.active"
        needed = [field.name, owner, "shapes.active"]
        if field.only_where is not None:
            needed.append(".".join((*field.path[:-1], field.only_where)))
        if field.refers_to is not None:
            yield _rule(" ".join(needed), _is_shape, "be the index of a shape")
        else:
            yield _rule(" ".join(needed), functools.partial(_within, field), _range_text(field))


def _range_text(field: Field) -> str:
    if field.above is not None:
        return "be positive" if field.above == 0 else f"be above {field.above:g}"
    if field.at_most is None:
        return f"be {field.at_least:g} or more" + (f" ({field.meaning})" if field.meaning.startswith("0:") else "")
    return f"be from {field.at_least:g} to {field.at_most:g}"


def _within(field: Field, number: np.ndarray, is_on: np.ndarray, shape_active: np.ndarray, *only: np.ndarray):
    del shape_active
    if field.dims[0] in "CE":  # of the last shapes, of all, or of none
        is_on = is_on[..., is_on.shape[-1] - number.shape[-1] :]
    for also in only:
        is_on = is_on & also
    fine = np.ones(number.shape, bool)
    if field.at_least is not None:
        fine &= number >= field.at_least
    if field.at_most is not None:
        fine &= number <= field.at_most
    if field.above is not None:
        fine &= number > field.above
    return ~is_on | fine


def _is_shape(index: np.ndarray, is_on: np.ndarray, shape_active: np.ndarray) -> np.ndarray:
    return ~is_on | ((index >= 0) & (index < shape_active.shape[-1]))


def _is_count(number: np.ndarray, shape_active: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    return ~_polygons(shape_active, number) | ((number >= 3) & (number <= vertices.shape[-2]))


def _same_both_ways(can_touch: np.ndarray) -> np.ndarray:
    return can_touch == np.swapaxes(can_touch, -1, -2)


def _differs(b: np.ndarray, a: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~is_on | (a != b)


def _in_order(lower: np.ndarray, upper: np.ndarray, has_limits: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~(is_on & has_limits) | (lower <= upper)


def _has_no_mass(kinematic: np.ndarray, mass: np.ndarray, inertia: np.ndarray, active: np.ndarray) -> np.ndarray:
    return ~(kinematic & active) | ((mass == 0) & (inertia == 0))


def _is_at_most(shortest: np.ndarray, longest: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    return ~is_on | (shortest <= longest)


def _bounds_servo(
    has_limits: np.ndarray, drive: np.ndarray, motor_on: np.ndarray, kind: np.ndarray, is_on: np.ndarray
) -> np.ndarray:
    return has_limits | ~(is_on & motor_on & (drive == JointDrive.SERVO) & (kind != JointKind.FIXED))


def _polygons(shape_active: np.ndarray, num_vertices: np.ndarray) -> np.ndarray:
    """[..., P] bool, of [..., n] what is about polygons."""
    return shape_active[..., : num_vertices.shape[-1]]


def _convex(vertices: np.ndarray, num_vertices: np.ndarray, shape_active: np.ndarray) -> np.ndarray:
    return _of_each(_is_convex, vertices, num_vertices, _polygons(shape_active, num_vertices))


def _centred(
    vertices: np.ndarray,
    num_vertices: np.ndarray,
    shape_active: np.ndarray,
    inverse_mass: np.ndarray,
    inverse_inertia: np.ndarray,
) -> np.ndarray:
    """Returns True where a polygon that can move is centred; walls of the published engine are not."""
    moves = shape_active & ((inverse_mass > 0) | (inverse_inertia > 0))
    return _of_each(_is_centred, vertices, num_vertices, _polygons(moves, num_vertices))


def _of_each(
    is_fine: Callable[[np.ndarray], np.ndarray], vertices: np.ndarray, num_vertices: np.ndarray, is_checked: np.ndarray
) -> np.ndarray:
    """[..., P] bool; `is_fine` takes the corners of all polygons of one number of vertices, [how many, number, 2]."""
    fine = np.ones(num_vertices.shape, bool)
    for number in range(3, vertices.shape[-2] + 1):
        chosen = is_checked & (num_vertices == number)
        if chosen.any():
            fine[chosen] = is_fine(vertices[chosen][:, :number].astype(np.float64))
    return fine


def _is_convex(corner: np.ndarray) -> np.ndarray:
    """Left turns only, of one full turn in all, around some area."""
    edge = np.roll(corner, -1, 1) - corner
    next_edge = np.roll(edge, -1, 1)
    turn = cross(edge, next_edge)
    length = np.abs(edge).sum(-1)
    rounding = ROUNDING * length.sum(-1, keepdims=True) * (length + np.roll(length, -1, 1))
    convex = (turn >= -rounding).all(-1) & (_twice_area(corner) > 0) & (length > 0).all(-1)
    if corner.shape[1] >= 5:  # a pentagram turns around twice
        convex &= np.arctan2(turn, (edge * next_edge).sum(-1)).sum(-1) < 3 * math.pi
    return convex


def _is_centred(corner: np.ndarray) -> np.ndarray:
    local = corner - corner[:, :1]
    twice_areas = cross(local, np.roll(local, -1, 1))  # of the triangles from the first corner
    twice_area = twice_areas.sum(-1)
    centre = corner[:, 0] + (twice_areas[..., None] * (local + np.roll(local, -1, 1))).sum(1) / (
        3 * twice_area[:, None]
    )
    extent = np.abs(local).max((1, 2))
    # A sliver's centre of mass moves along it when its vertices are rounded.
    return np.abs(centre).max(-1) <= extent * (OFF_CENTRE + ROUNDING * extent**2 / twice_area)


def _twice_area(corner: np.ndarray) -> np.ndarray:
    local = corner - corner[:, :1]
    return cross(local, np.roll(local, -1, 1)).sum(-1)


SCENE_RULES = (
    *_declared(),
    _rule("shapes.num_vertices shapes.active shapes.vertices", _is_count, "be from 3 to Capacity.vertices"),
    _rule("shapes.vertices shapes.num_vertices shapes.active", _convex, "be convex, counter-clockwise"),
    _rule(
        "shapes.vertices shapes.num_vertices shapes.active shapes.inverse_mass shapes.inverse_inertia",
        _centred,
        "have its centre of mass at (0, 0)",
    ),
    _rule("shapes.can_touch", _same_both_ways, "be the same for [i, j] and [j, i]"),
    _rule(
        "shapes.kinematic shapes.inverse_mass shapes.inverse_inertia shapes.active",
        _has_no_mass,
        "be False, or inverse_mass and inverse_inertia 0: nothing pushes a kinematic shape",
    ),
    _rule("joints.b joints.a joints.active", _differs, "be another shape than joints.a"),
    _rule("joints.lower_limit joints.upper_limit joints.has_limits joints.active", _in_order, "be at most upper_limit"),
    _rule("springs.b springs.a springs.active", _differs, "be another shape than springs.a"),
    _rule("springs.min_length springs.max_length springs.active", _is_at_most, "be at most max_length"),
    _rule(
        "joints.has_limits joints.drive joints.motor_on joints.kind joints.active",
        _bounds_servo,
        "be True: a servo without limits has no positions to move between",
    ),
)
