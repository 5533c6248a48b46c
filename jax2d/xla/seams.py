"""Seams between the tiles of a floor, which do not stop what slides over them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import vec2
from jax2d.xla.geometry import Polygons


class Incident(NamedTuple):
    """The incident edge over the reference face, positions relative to the centre of the reference polygon."""

    lower_end: jax.Array  # [2] m
    upper_end: jax.Array
    u_lower: jax.Array  # [] m along the reference face from its start
    u_upper: jax.Array
    face_length: jax.Array  # [] m
    closing: jax.Array  # [] m/s at which the two meet along the face's normal


class Seam(NamedTuple):
    """The one point of a pair that slides past the end of a face."""

    normal: jax.Array
    point: jax.Array
    separation: jax.Array
    number: jax.Array  # [] int32, 0 at the start of the reference face, 1 at its end
    exists: jax.Array


def slides_past(
    ref: Polygons, inc: Polygons, edge: jax.Array, inc_from_ref: jax.Array, over: Incident, margin: jax.Array
) -> Seam:
    """About to meet (or just met) along the reference face's normal, and level with one of its ends: such a pair slides
    along the neighbouring face, which gives the normal then; with the reference face's own every seam of a tiled floor
    would stop what slides over it."""
    overlap = jnp.minimum(over.u_upper, over.face_length) - jnp.maximum(over.u_lower, 0)
    is_level = jnp.abs(overlap) <= C.grazing_distance
    is_thin = overlap > C.thin_share * jnp.minimum(over.u_upper - over.u_lower, over.face_length)  # met in full
    at_start = over.u_upper < over.face_length - over.u_lower
    end = jnp.where(at_start, over.upper_end, over.lower_end)
    origin = jnp.where(at_start, ref.corner[edge], ref.following[edge])
    separation = vec2.dot(ref.normal[edge], end - origin)
    is_ahead = separation > jnp.where(over.closing > C.resting_speed, -C.grazing_distance, 0)
    num_corners = jnp.sum(ref.is_corner, dtype=edge.dtype)
    neighbour = jnp.where(at_start, edge - 1, edge + 1) % num_corners
    n = ref.normal[neighbour]
    gap = jnp.min(jnp.where(inc.is_corner, vec2.dot(inc.corner + inc_from_ref - origin, n), C.far_distance))
    exists = is_level & ~is_thin & is_ahead & (gap >= -C.grazing_distance) & (gap <= margin)
    gap = jnp.maximum(gap, 0)
    return Seam(n, end - 0.5 * gap * n, gap, jnp.where(at_start, 0, 1), exists)
