"""Contact points of circles, and of polygons with circles. C = (pB - pA) . n >= 0

Everything is relative to the centre of mass of shape a. Normals point from a to b; a separation below zero is a
penetration depth. Each function is for one pair.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar
from jax2d.xla import impact_plane, vec2
from jax2d.xla.geometry import Polygons
from jax2d.xla.rules import Rules


class Points(NamedTuple):
    """Contact points of a pair, or of all pairs: leading axes are the points'."""

    normal: jax.Array  # [..., 2], from a to b
    point: jax.Array  # [..., 2] m, relative to the centre of mass of a
    separation: jax.Array  # [...] m
    feature: jax.Array  # [...] int32, which vertex on which edge: matches the point between steps
    follows_b: jax.Array  # [...] share by which the point goes with b while both bodies move
    exists: jax.Array  # [...] bool
    on_face: jax.Array  # [...] bool, b is a disc on a face of a


class Motion(NamedTuple):
    """Motion of shape b against shape a, which goes on so for `seconds`, in sub-steps of `h`."""

    velocity: jax.Array  # [2] m/s, of the centre of b
    spin: jax.Array  # [] rad/s, of a
    seconds: Scalar
    h: Scalar  # s


def circle_circle(
    radius_a: jax.Array,
    radius_b: jax.Array,
    d: jax.Array,
    relative_velocity: jax.Array,
    margin: jax.Array,
    *,
    rules: Rules,
) -> Points:
    """Contact point of two discs, at most one, [1]. d [2] m: centre of b relative to centre of a; relative_velocity [2]
    m/s of b. In `paper` the point lies on a's surface."""
    distance = vec2.length(d)
    separation = distance - radius_a - radius_b
    normal = vec2.unit_or_zero(d)
    # Coincident centres have no direction of their own: any fixed one separates them.
    normal = jnp.where(distance > C.coincident_distance, normal, jnp.array([0, 1], d.dtype))
    exists = (separation <= margin)[None]
    if rules.is_soft:
        plane = impact_plane.of_corner(d, relative_velocity, radius_a + radius_b, 0.0)
        is_met = (separation > 0) & impact_plane.moves(relative_velocity) & plane.exists
        normal = jnp.where(is_met, plane.normal, normal)
        separation = jnp.where(is_met, plane.separation, separation)
    point = normal * (radius_a + (0.5 * separation if rules.is_soft else 0))
    follows_b = radius_a / jnp.maximum(radius_a + radius_b, jnp.finfo(d.dtype).tiny)  # no radius in free slots
    feature = jnp.zeros(1, jnp.int32)
    return Points(normal[None], point[None], separation[None], feature, follows_b[None], exists, jnp.zeros(1, bool))


def polygon_circle(
    polygon: Polygons,
    radius: jax.Array,
    centre: jax.Array,
    motion: Motion,
    margin: jax.Array,
    *,
    rules: Rules,
) -> Points:
    """Contact point of a disc and one polygon, at most one, [1]; centre [2] m relative to it. In `paper` the point lies
    on the polygon."""
    distances = jnp.where(polygon.is_corner, vec2.dot(polygon.normal, centre - polygon.corner), -C.far_distance)
    face = jnp.argmax(distances)
    face_distance = distances[face]
    start, end = polygon.corner[face], polygon.following[face]
    # Outside, the closest feature may be a corner of the face.
    is_outside = face_distance > C.on_face_distance
    before = is_outside & (vec2.dot(centre - start, end - start) < 0)
    after = is_outside & ~before & (vec2.dot(centre - end, start - end) < 0)
    at_corner = before | after
    corner = jnp.where(before, start, end)
    away = centre - corner
    distance = jnp.where(at_corner, vec2.length(away), face_distance)
    normal = jnp.where(at_corner, vec2.unit_or_zero(away), polygon.normal[face])
    separation = distance - radius
    on_face = ~at_corner
    exists = (face_distance - radius <= margin) & (separation <= margin)
    if rules.is_soft:
        graze = jnp.minimum(C.grazing_distance, C.grazing_share * radius)
        velocity = motion.velocity - vec2.left(centre) * motion.spin  # as a point of the polygon there sees it
        plane = impact_plane.of_polygon(polygon, centre, radius, velocity, motion.seconds, graze)
        is_met = (separation > jnp.where(at_corner, -graze, 0)) & impact_plane.moves(velocity) & plane.exists
        normal = jnp.where(is_met, plane.normal, normal)
        separation = jnp.where(is_met, plane.separation, separation)
        on_face = jnp.where(is_met, plane.on_face, on_face)
    point = centre - normal * (radius + (0.5 if rules.is_soft else 1) * separation)
    feature, follows_b = jnp.zeros(1, jnp.int32), jnp.ones(1, centre.dtype)  # it stays below the disc's centre
    return Points(normal[None], point[None], separation[None], feature, follows_b, exists[None], on_face[None])
