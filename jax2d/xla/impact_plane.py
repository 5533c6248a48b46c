"""Plane that keeps two shapes apart while they move on as they do: C = n . (p_b - p_a) >= 0 for the rest of the step.

Every plane that has one shape behind it and the other before it is safe: while it holds, nothing passes. The nearest
features give one, but one that a shape may have to cross on its way past: the side of the next tile of a floor, the
plane of a wall beyond the wall's end. So the plane is chosen by the path: one that the path does not cross, else the
one that it crosses last, which is where the shapes meet (separating axes in time).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar
from jax2d.xla import vec2
from jax2d.xla.geometry import Polygons


class ImpactPlane(NamedTuple):
    """Plane of what a disc may hit."""

    normal: jax.Array  # [2] outward
    separation: jax.Array  # [] m
    exists: jax.Array  # [] bool; False: as the shapes stand
    on_face: jax.Array  # [] bool, it is that of a face, not of a corner


def moves(motion: jax.Array) -> jax.Array:
    return vec2.dot(motion, motion) > C.resting_speed * C.resting_speed


def _unless_zero(x: jax.Array) -> jax.Array:
    return jnp.where(x == 0, 1, x)


def of_corner(away: jax.Array, motion: jax.Array, r: jax.Array, graze: Scalar) -> ImpactPlane:
    """A disc against one corner or another disc, `away` [2] m from it: `r` is the sum of both radii. `graze`: passing
    by so much less than `r` is passing."""
    squared, beside, along = vec2.dot(motion, motion), vec2.cross(away, motion), vec2.dot(away, motion)
    speed = vec2.sqrt_or_zero(squared)
    passes = beside * beside >= (r - graze) * (r - graze) * squared
    besides_normal = vec2.left(motion) * (jnp.where(beside < 0, 1, -1) / _unless_zero(speed))
    besides_separation = jnp.maximum(jnp.abs(beside) / _unless_zero(speed) - r, 0)
    clearance_squared = vec2.dot(away, away) - r * r
    seconds = (-along - vec2.sqrt_or_zero(along * along - squared * clearance_squared)) / _unless_zero(squared)
    met_normal = (away + motion * seconds) / _unless_zero(r)
    return ImpactPlane(
        normal=jnp.where(passes, besides_normal, met_normal),
        separation=jnp.where(passes, besides_separation, vec2.dot(met_normal, away) - r),
        exists=(along < 0) & (passes | (clearance_squared > 0)),
        on_face=jnp.zeros_like(passes),
    )


def of_polygon(
    polygon: Polygons, centre: jax.Array, r: jax.Array, motion: jax.Array, seconds: Scalar, graze: jax.Array
) -> ImpactPlane:
    """A disc against one polygon; centre [2] m and motion [2] m/s of the disc against it."""
    separation = vec2.dot(polygon.normal, centre - polygon.corner) - r
    rate = vec2.dot(polygon.normal, motion)
    is_before = polygon.is_corner & (separation >= -graze)
    # Along a face and onto it, as over the next tile of a floor: not into it, and not off its end.
    over = _is_over(polygon.corner, polygon.following, centre, motion)
    inert = is_before & (rate * seconds >= -graze) & over
    crossed = jnp.where(rate < 0, jnp.maximum(separation, 0) / _unless_zero(-rate), C.far_distance)
    crossed = jnp.where(is_before, crossed, -1)
    last_face = jnp.argmax(crossed)
    is_inert, last = jnp.any(inert), crossed[last_face]
    face = jnp.where(is_inert, jnp.argmax(jnp.where(inert, separation, -C.far_distance)), last_face)
    start, end = polygon.corner[face], polygon.following[face]
    is_crossed = (last >= 0) & (last < C.far_distance)
    # Where it crosses the last plane, beyond the face it meets the corner there, or passes it.
    at, edge = centre + motion * jnp.where(is_crossed, last, 0), end - start
    before, after = vec2.dot(at - start, edge) < 0, vec2.dot(at - end, edge) > 0
    away, inward = centre - jnp.where(before, start, end), jnp.where(before, edge, -edge)
    corner = of_corner(away, motion, r, graze)
    dives = _grazes_onto(away, inward, polygon.normal[face], r, graze, motion, seconds)
    at_corner = ~is_inert & (before | after) & ~dives
    return ImpactPlane(
        normal=jnp.where(at_corner, corner.normal, polygon.normal[face]),
        separation=jnp.where(at_corner, corner.separation, jnp.maximum(separation[face], 0)),
        exists=jnp.where(at_corner, corner.exists & is_crossed, is_inert | is_crossed),
        on_face=~at_corner,
    )


def _grazes_onto(
    away: jax.Array,
    inward: jax.Array,
    face_normal: jax.Array,
    r: jax.Array,
    graze: jax.Array,
    motion: jax.Array,
    seconds: Scalar,
) -> jax.Array:
    """Returns True if a disc, `away` [2] m from the end of a face, grazes the corner there and then goes on into the
    face, which leads along `inward` from there: passing the corner would let it in."""
    beside, squared = vec2.cross(away, motion), vec2.dot(motion, motion)
    grazes = (beside * beside < r * r * squared) & (beside * beside >= (r - graze) * (r - graze) * squared)
    then = away + motion * seconds
    return grazes & (vec2.dot(then, inward) > 0) & (vec2.dot(face_normal, then) - r < -graze)


def _is_over(start: jax.Array, end: jax.Array, point: jax.Array, motion: jax.Array) -> jax.Array:
    """Returns True for each edge [V] that a point [2] is over or on its way to."""
    edge = end - start
    heading = vec2.dot(edge, motion)
    return ((vec2.dot(edge, point - start) >= 0) | (heading > 0)) & ((vec2.dot(edge, point - end) <= 0) | (heading < 0))


class ImpactFace(NamedTuple):
    """Face that keeps two polygons apart while they move on."""

    exists: jax.Array  # [] bool
    flipped: jax.Array  # [] bool, it is b's
    edge: jax.Array  # [] int32
    seconds: jax.Array  # [] until they meet there, 0 if they do not


def of_polygons(
    a: Polygons, b: Polygons, d: jax.Array, motion: jax.Array, advantage: jax.Array, seconds: Scalar
) -> ImpactFace:
    """d [2] m and motion [2] m/s: of b against a. `advantage` [] m by which a face of b must be better."""
    of_a, of_b = _faces(a, b, d, motion, seconds), _faces(b, a, -d, -motion, seconds)
    inert = of_b.inert_separation > jnp.maximum(of_a.inert_separation, -C.far_distance) + jnp.where(
        of_a.inert_separation > -C.far_distance, advantage, 0
    )
    has_inert = jnp.maximum(of_a.inert_separation, of_b.inert_separation) > -C.far_distance
    met = of_b.crossed > of_a.crossed
    flipped = jnp.where(has_inert, inert, met)
    edge = jnp.where(
        has_inert,
        jnp.where(inert, of_b.inert_edge, of_a.inert_edge),
        jnp.where(met, of_b.edge, of_a.edge),
    )
    last = jnp.maximum(of_a.crossed, of_b.crossed)
    is_met = (last >= 0) & (last < C.far_distance)
    return ImpactFace(has_inert | is_met, flipped, edge, jnp.where(has_inert | ~is_met, 0, last))


class Passing(NamedTuple):
    """Plane between two polygons that pass each other, along their motion."""

    exists: jax.Array  # [] bool
    normal: jax.Array  # [2], from a to b
    nearest: jax.Array  # [2] m, corner of b
    separation: jax.Array  # [] m


def pass_each_other(a: Polygons, b: Polygons, d: jax.Array, motion: jax.Array) -> Passing:
    """d [2] m and motion [2] m/s: of b against a."""
    n = vec2.left(motion) / _unless_zero(vec2.length(motion))
    of_a, of_b = vec2.dot(a.corner, n), vec2.dot(b.corner + d, n)
    lowest = jnp.argmin(jnp.where(b.is_corner, of_b, C.far_distance))
    highest = jnp.argmax(jnp.where(b.is_corner, of_b, -C.far_distance))
    a_lower = jnp.min(jnp.where(a.is_corner, of_a, C.far_distance))
    a_upper = jnp.max(jnp.where(a.is_corner, of_a, -C.far_distance))
    above = of_b[lowest] - a_upper > a_lower - of_b[highest]
    gap = jnp.where(above, of_b[lowest] - a_upper, a_lower - of_b[highest])
    nearest = jnp.where(above, b.corner[lowest], b.corner[highest]) + d
    return Passing(gap >= 0, jnp.where(above, n, -n), nearest, gap)


class _Faces(NamedTuple):
    """Faces of one of two polygons."""

    inert_separation: jax.Array  # [] m of the best face that is not crossed, -C.far_distance if there is none
    inert_edge: jax.Array
    crossed: jax.Array  # [] s until the last one is, -1 if the other polygon is before none
    edge: jax.Array


def _faces(one: Polygons, other: Polygons, other_at: jax.Array, motion: jax.Array, seconds: Scalar) -> _Faces:
    along = vec2.dot(one.normal[:, None], other.corner[None] + other_at - one.corner[:, None])  # [edge, corner]
    nearest = jnp.min(jnp.where(other.is_corner, along, C.far_distance), axis=1)
    farthest = jnp.max(jnp.where(other.is_corner, along, -C.far_distance), axis=1)
    own = vec2.dot(one.normal[:, None], one.corner[None] - one.corner[:, None])
    thickness = -jnp.min(jnp.where(one.is_corner, own, C.far_distance), axis=1)
    # A thin shape is met in full, not passed over.
    is_thin = (nearest < 0) & (nearest < -C.thin_share * jnp.minimum(thickness, farthest - nearest))
    is_before = one.is_corner & (nearest >= -C.grazing_distance) & ~is_thin
    rate = vec2.dot(one.normal, motion)
    # Along its plane, as over the next tile of a floor: not into it.
    inert = jnp.where(is_before & (rate * seconds >= -C.grazing_distance), nearest, -C.far_distance)
    crossed = jnp.where(rate < 0, jnp.maximum(nearest, 0) / _unless_zero(-rate), C.far_distance)
    crossed = jnp.where(is_before, crossed, -1)
    inert_edge, edge = jnp.argmax(inert), jnp.argmax(crossed)
    return _Faces(inert[inert_edge], inert_edge, crossed[edge], edge)
