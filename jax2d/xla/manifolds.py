"""Contact manifolds: where and along which normal two convex shapes meet. C = (pB - pA) . n >= 0

Everything is relative to the centre of mass of shape a. Normals point from a to b; a separation below zero is a
penetration depth. Each function is for one pair.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import published, vec2
from jax2d.xla.geometry import Polygons
from jax2d.xla.rules import Rules
from jax2d.xla.seams import Incident, slides_past


class Points(NamedTuple):
    """Contact points of a pair, or of all pairs: leading axes are the points'."""

    normal: jax.Array  # [..., 2], from a to b
    point: jax.Array  # [..., 2] m, relative to the centre of mass of a
    separation: jax.Array  # [...] m
    feature: jax.Array  # [...] int32, which vertex on which edge: matches the point between steps
    exists: jax.Array  # [...] bool


def circle_circle(radius_a: jax.Array, radius_b: jax.Array, d: jax.Array, margin: jax.Array, *, rules: Rules) -> Points:
    """At most one point, [1]. d [2]: centre of b relative to centre of a. In `paper` the point lies on a's surface."""
    distance = vec2.length(d)
    separation = distance - radius_a - radius_b
    normal = vec2.unit_or_zero(d)
    if "coincident_circles" not in rules.published_details:
        # Coincident centres have no direction of their own: any fixed one separates them.
        normal = jnp.where(distance > C.coincident_distance, normal, jnp.array([0, 1], d.dtype))
    point = normal * (radius_a + (0.5 * separation if rules.is_soft else 0))
    return Points(normal[None], point[None], separation[None], jnp.zeros(1, jnp.int32), (separation <= margin)[None])


def rolls_past(away: jax.Array, relative_velocity: jax.Array, radius: jax.Array) -> jax.Array:
    """A disc that moves on as it does leaves the corner beside it, or grazes it: that of the next tile of a floor."""
    speed = vec2.length(relative_velocity)
    return (speed > C.resting_speed) & (
        jnp.abs(vec2.cross(away, relative_velocity))
        >= (radius - jnp.minimum(C.grazing_distance, C.grazing_share * radius)) * speed
    )


def polygon_circle(
    polygon: Polygons,
    radius: jax.Array,
    centre: jax.Array,
    relative_velocity: jax.Array,
    spin: jax.Array,
    margin: jax.Array,
    *,
    rules: Rules,
) -> Points:
    """At most one point, [1]; one polygon, centre [2] relative to it, relative_velocity [2] m/s of the centre,
    spin [] rad/s of the polygon. In `paper` the point lies on the polygon."""
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
    point = centre - normal * (radius + (0.5 if rules.is_soft else 1) * separation)
    exists = (face_distance - radius <= margin) & (separation <= margin)
    if "centre_inside" in rules.published_details:
        normal, separation = published.centre_inside(normal, separation, face_distance, radius)
    if rules.is_soft:
        exists &= ~(
            at_corner & (separation > 0) & rolls_past(away, relative_velocity - vec2.left(corner) * spin, radius)
        )
    return Points(normal[None], point[None], separation[None], jnp.zeros(1, jnp.int32), exists[None])


def max_separation(
    one: Polygons, one_at: jax.Array, other: Polygons, other_at: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Largest over the edges of one polygon of the least distance of the other's corners to that edge, and the edge."""
    origin = one.corner + one_at - other_at
    to_corner = vec2.dot(one.normal[:, None], other.corner[None] - origin[:, None])  # [edge, corner]
    least = jnp.min(jnp.where(other.is_corner, to_corner, C.far_distance), axis=1)
    least = jnp.where(one.is_corner, least, -C.far_distance)
    edge = jnp.argmax(least)
    return least[edge], edge


def polygon_polygon(
    a: Polygons, b: Polygons, d: jax.Array, relative_velocity: jax.Array, margin: jax.Array, *, rules: Rules
) -> Points:
    """At most two points, [2]: the incident edge clipped to the reference face, corner against corner, or a seam.

    d [2] m: centre of b relative to centre of a; relative_velocity [2] m/s: how that changes. In `paper` points lie on
    the incident edge.
    """
    details = rules.published_details
    zero = jnp.zeros_like(d)
    depth_a, edge_a = max_separation(a, zero, b, d)
    depth_b, edge_b = max_separation(b, d, a, zero)
    # The reference face is that of the clearly larger shape (a's if neither is) unless the other's is clearly better: a
    # floor holds its normal while what stands on it rocks.
    larger_b = b.extent > C.clearly_larger * a.extent
    flipped = depth_b > depth_a + jnp.where(larger_b, -C.flip_advantage, C.flip_advantage)
    if "reference_bias" in details:
        flipped = depth_b > depth_a + published.REFERENCE_BIAS_M

    def choose(of_b, of_a):
        return jax.tree.map(lambda x, y: jnp.where(flipped, x, y), of_b, of_a)

    ref, inc = choose(b, a), choose(a, b)
    ref_at, inc_at, edge = choose(d, zero), choose(zero, d), choose(edge_b, edge_a)
    n = ref.normal[edge]
    r1, r2 = ref.corner[edge] + ref_at, ref.following[edge] + ref_at

    # The incident edge is the one that faces the reference face most, in `paper` the one whose corners are deepest.
    alignment = vec2.dot(inc.normal if rules.is_soft else inc.corner + inc.following, n)
    incident = jnp.argmin(jnp.where(inc.is_corner, alignment, C.far_distance))
    # Its first corner is the farther along the reference edge, unless a steep and short edge has the deepest corners.
    upper_end, lower_end = inc.corner[incident] + inc_at, inc.following[incident] + inc_at
    along = vec2.left(n)  # from r1 to r2
    if not rules.is_soft:
        is_steep = vec2.dot(upper_end - lower_end, along) < 0
        upper_end, lower_end = jnp.where(is_steep, lower_end, upper_end), jnp.where(is_steep, upper_end, lower_end)
    edge_length = vec2.dot(r2 - r1, along)
    u_upper, u_lower = vec2.dot(upper_end - r1, along), vec2.dot(lower_end - r1, along)
    base = jnp.where(flipped, C.feature_flipped, 0) + edge * C.feature_edge

    # Nothing of the incident edge is over the reference face: corner against corner.
    before_start = u_upper < 0
    beside = before_start | (u_lower > edge_length)
    ref_corner, inc_corner = jnp.where(before_start, r1, r2), jnp.where(before_start, upper_end, lower_end)
    gap = inc_corner - ref_corner
    distance, face_separation = vec2.length(gap), vec2.dot(n, gap)
    is_outside = face_separation > 0
    corner_separation = jnp.where(is_outside, distance, face_separation)
    halfway = 0.5 if rules.is_soft else 0
    corner_point = jnp.where(is_outside, 0.5 * (ref_corner + inc_corner), inc_corner - halfway * face_separation * n)
    corner_feature = (
        jnp.where(is_outside, C.feature_corner_outside, C.feature_corner_inside) + base + jnp.where(before_start, 0, 1)
    )

    # Clip the incident edge to the sides of the reference face; depth follows the clipped point.
    span = u_upper - u_lower
    is_wide = span > C.min_span
    share = 1 / jnp.where(is_wide, span, 1)
    edge_vector = upper_end - lower_end
    lower_point = jnp.where((u_lower < 0) & is_wide, lower_end - edge_vector * (u_lower * share), lower_end)
    upper_point = jnp.where(
        (u_upper > edge_length) & is_wide, lower_end + edge_vector * ((edge_length - u_lower) * share), upper_end
    )
    clipped = jnp.stack([lower_point, upper_point])
    if "clip_keeps_depth" in details:
        clipped = published.clip_and_keep_depth(jnp.stack([lower_end, upper_end]) - r1, n, edge_length) + r1
        beside = jnp.array(False)
    clipped_separation = vec2.dot(clipped - r1, n)
    clipped_feature = base + incident * C.feature_incident + jnp.arange(2)

    normal = jnp.where(beside & is_outside, vec2.unit_or_zero(gap), n)
    separation = jnp.where(beside, corner_separation, clipped_separation)
    in_reach = (depth_a <= margin) & (depth_b <= margin)
    is_one_of = jnp.where(beside, jnp.array([True, False]), True)
    point = jnp.where(beside, corner_point, clipped - halfway * clipped_separation[:, None] * n)
    feature = jnp.where(beside, corner_feature, clipped_feature)
    exists = is_one_of & (separation <= margin)
    if "deepest_depth" in details:
        separation = jnp.full(2, jnp.maximum(depth_a, depth_b))
    if rules.is_soft:
        closing = vec2.dot(n, choose(relative_velocity, -relative_velocity))
        over = Incident(lower_end - ref_at, upper_end - ref_at, u_lower, u_upper, edge_length, closing)
        seam = slides_past(ref, inc, edge, inc_at - ref_at, over, margin)
        normal = jnp.where(seam.exists, seam.normal, normal)
        point = jnp.where(seam.exists, seam.point + ref_at, point)
        separation = jnp.where(seam.exists, seam.separation, separation)
        feature = jnp.where(seam.exists, C.feature_seam + base + seam.number, feature)
        exists = jnp.where(seam.exists, jnp.array([True, False]), exists)
    points = Points(
        normal=jnp.broadcast_to(jnp.where(flipped, -normal, normal), (2, 2)),
        point=point,
        separation=separation,
        feature=feature.astype(jnp.int32),
        exists=in_reach & exists,
    )
    if details & {"warm_start_by_depth", "solve_order"}:
        depth = jnp.where(beside, corner_separation, clipped_separation)
        points = jax.tree.map(lambda x: jnp.where(depth[0] <= depth[1], x, x[::-1]), points)
    if "warm_start_by_depth" in details:
        points = points._replace(feature=jnp.arange(2, dtype=jnp.int32))
    return points
