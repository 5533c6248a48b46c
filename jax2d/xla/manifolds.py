"""Contact manifolds: where and along which normal two convex shapes meet. C = (pB - pA) . n >= 0

Everything is relative to the centre of mass of shape a. Normals point from a to b; a separation below zero is a
penetration depth. All pairs are computed, those out of reach are masked out.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity, Scene
from jax2d.xla import published, vec2
from jax2d.xla.bodies import Bodies
from jax2d.xla.parameters import Rules, Scalar

FAR_M = 1e30  # distance of what does not exist
COINCIDENT_M = 1e-9  # centres closer than this have no direction of their own
ON_FACE_M = 1e-7  # a circle's centre this near a face counts as inside
FLIP_ADVANTAGE_M = 0.0005  # by which the other face must be better to be the reference: no flicker near a tie
CLEARLY_LARGER = 1.1  # ratio of extents from which the larger shape's face is the reference
# Bits of a feature: which of b's faces or corners meets which of a's. Points of one pair ascend in them.
FLIPPED, EDGE, CORNER_OUTSIDE, CORNER_INSIDE, SEAM, INCIDENT = 64, 8, 128, 256, 384, 512
GRAZING_M = 0.005  # shapes that are level to within this, or miss each other by it, slide past rather than meet
STANDING_M_S = 0.1  # slower than this, what overlaps or is about to meet rests where it is


class Points(NamedTuple):
    """Contact points of a pair, or of all pairs: leading axes are the points'."""

    normal: jax.Array  # [..., 2], from a to b
    point: jax.Array  # [..., 2] m, relative to the centre of mass of a
    separation: jax.Array  # [...] m
    feature: jax.Array  # [...] int32, which vertex on which edge: matches the point between steps
    exists: jax.Array  # [...] bool


class Polygons(NamedTuple):
    """World-oriented polygons, relative to their centres of mass. `V` corner slots."""

    corner: jax.Array  # [P, V, 2] m
    following: jax.Array  # [P, V, 2] m, the next corner counter-clockwise
    normal: jax.Array  # [P, V, 2] outward, of the edge from a corner to the following one
    is_corner: jax.Array  # [P, V] bool
    extent: jax.Array  # [P] m, largest distance from centre to corner


class Geometry(NamedTuple):
    polygons: Polygons
    radius: jax.Array  # [C] m
    lower: jax.Array  # [n, 2] m, axis-aligned bounds relative to the centre of mass
    upper: jax.Array  # [n, 2]
    core: jax.Array  # [n] m, least distance from centre to surface: what a fast body may not step over
    extent: jax.Array  # [n] m, largest distance from centre to surface


def build(scene: Scene, bodies: Bodies) -> Geometry:
    """Shapes as they stand at the start of the step."""
    num_polygons, num_corners = scene.vertices.shape[:2]
    slot = jnp.arange(num_corners)
    is_corner = slot < scene.num_vertices[:, None]
    corner = vec2.rotated(scene.vertices, bodies.angle[:num_polygons, None])
    is_last = slot + 1 >= scene.num_vertices[:, None]
    following = jnp.where(is_last[..., None], corner[:, :1], jnp.roll(corner, -1, axis=1))
    normal = vec2.unit_or_zero(vec2.right(following - corner))
    real = is_corner[..., None]
    extent = jnp.max(jnp.where(is_corner, vec2.length(corner), 0), axis=1, initial=0)
    r = scene.radius
    radii = jnp.stack([r, r], -1)
    return Geometry(
        polygons=Polygons(corner, following, normal, is_corner, extent),
        radius=r,
        lower=jnp.concatenate([jnp.min(jnp.where(real, corner, FAR_M), axis=1, initial=FAR_M), -radii]),
        upper=jnp.concatenate([jnp.max(jnp.where(real, corner, -FAR_M), axis=1, initial=-FAR_M), radii]),
        core=jnp.concatenate([jnp.min(jnp.where(is_corner, vec2.dot(normal, corner), FAR_M), 1, initial=FAR_M), r]),
        extent=jnp.concatenate([extent, r]),
    )


def circle_circle(radius_a: jax.Array, radius_b: jax.Array, d: jax.Array, margin: jax.Array, *, rules: Rules) -> Points:
    """At most one point, [1]. d [2]: centre of b relative to centre of a. In `paper` the point lies on a's surface."""
    distance = vec2.length(d)
    separation = distance - radius_a - radius_b
    normal = vec2.unit_or_zero(d)
    if "coincident_circles" not in rules.published_details:
        # Coincident centres have no direction of their own: any fixed one separates them.
        normal = jnp.where(distance > COINCIDENT_M, normal, jnp.array([0, 1], d.dtype))
    point = normal * (radius_a + (0.5 * separation if rules.is_soft else 0))
    return Points(normal[None], point[None], separation[None], jnp.zeros(1, jnp.int32), (separation <= margin)[None])


def rolls_past(away: jax.Array, motion: jax.Array, radius: jax.Array) -> jax.Array:
    """A disc that moves on as it does leaves the corner beside it, or grazes it: that of the next tile of a floor."""
    speed = vec2.length(motion)
    return (speed > STANDING_M_S) & (
        jnp.abs(vec2.cross(away, motion)) >= (radius - jnp.minimum(GRAZING_M, 0.05 * radius)) * speed
    )


def polygon_circle(
    polygon: Polygons,
    radius: jax.Array,
    centre: jax.Array,
    motion: jax.Array,
    spin: jax.Array,
    margin: jax.Array,
    *,
    rules: Rules,
) -> Points:
    """At most one point, [1]; one polygon, centre [2] relative to it, motion [2] m/s: how that changes, spin [] rad/s
    of the polygon. In `paper` the point lies on the polygon."""
    distances = jnp.where(polygon.is_corner, vec2.dot(polygon.normal, centre - polygon.corner), -FAR_M)
    face = jnp.argmax(distances)
    face_distance = distances[face]
    start, end = polygon.corner[face], polygon.following[face]
    # Outside, the closest feature may be a corner of the face.
    is_outside = face_distance > ON_FACE_M
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
        exists &= ~(at_corner & (separation > 0) & rolls_past(away, motion - vec2.left(corner) * spin, radius))
    return Points(normal[None], point[None], separation[None], jnp.zeros(1, jnp.int32), exists[None])


def deepest_axis(one: Polygons, one_at: jax.Array, other: Polygons, other_at: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Largest over the edges of one polygon of the least distance of the other's corners to that edge, and the edge."""
    origin = one.corner + one_at - other_at
    to_corner = vec2.dot(one.normal[:, None], other.corner[None] - origin[:, None])  # [edge, corner]
    least = jnp.min(jnp.where(other.is_corner, to_corner, FAR_M), axis=1)
    least = jnp.where(one.is_corner, least, -FAR_M)
    edge = jnp.argmax(least)
    return least[edge], edge


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
    is_level = jnp.abs(overlap) <= GRAZING_M
    is_thin = overlap > 0.5 * jnp.minimum(over.u_upper - over.u_lower, over.face_length)  # met in full
    at_start = over.u_upper < over.face_length - over.u_lower
    end = jnp.where(at_start, over.upper_end, over.lower_end)
    origin = jnp.where(at_start, ref.corner[edge], ref.following[edge])
    separation = vec2.dot(ref.normal[edge], end - origin)
    is_ahead = separation > jnp.where(over.closing > STANDING_M_S, -GRAZING_M, 0)
    num_corners = jnp.sum(ref.is_corner, dtype=edge.dtype)
    neighbour = jnp.where(at_start, edge - 1, edge + 1) % num_corners
    n = ref.normal[neighbour]
    gap = jnp.min(jnp.where(inc.is_corner, vec2.dot(inc.corner + inc_from_ref - origin, n), FAR_M))
    exists = is_level & ~is_thin & is_ahead & (gap >= -GRAZING_M) & (gap <= margin)
    gap = jnp.maximum(gap, 0)
    return Seam(n, end - 0.5 * gap * n, gap, jnp.where(at_start, 0, 1), exists)


def polygon_polygon(
    a: Polygons, b: Polygons, d: jax.Array, motion: jax.Array, margin: jax.Array, *, rules: Rules
) -> Points:
    """At most two points, [2]: the incident edge clipped to the reference face, corner against corner, or a seam.

    d [2] m: centre of b relative to centre of a; motion [2] m/s: how that changes. In `paper` points lie on the
    incident edge.
    """
    details = rules.published_details
    zero = jnp.zeros_like(d)
    depth_a, edge_a = deepest_axis(a, zero, b, d)
    depth_b, edge_b = deepest_axis(b, d, a, zero)
    # The reference face is that of the clearly larger shape (a's if neither is) unless the other's is clearly better: a
    # floor holds its normal while what stands on it rocks.
    larger_b = b.extent > CLEARLY_LARGER * a.extent
    flipped = depth_b > depth_a + jnp.where(larger_b, -FLIP_ADVANTAGE_M, FLIP_ADVANTAGE_M)
    if "reference_bias" in details:
        flipped = depth_b > depth_a + published.REFERENCE_BIAS_M

    def choose(of_b, of_a):
        return jax.tree.map(lambda x, y: jnp.where(flipped, x, y), of_b, of_a)

    ref, inc = choose(b, a), choose(a, b)
    ref_at, inc_at, edge = choose(d, zero), choose(zero, d), choose(edge_b, edge_a)
    n = ref.normal[edge]
    r1, r2 = ref.corner[edge] + ref_at, ref.following[edge] + ref_at

    # The incident edge is the one that faces the reference face most, in `paper` the one whose corners are deepest.
    opposed = vec2.dot(inc.normal if rules.is_soft else inc.corner + inc.following, n)
    incident = jnp.argmin(jnp.where(inc.is_corner, opposed, FAR_M))
    # Its first corner is the farther along the reference edge, unless a steep and short edge has the deepest corners.
    upper_end, lower_end = inc.corner[incident] + inc_at, inc.following[incident] + inc_at
    along = vec2.left(n)  # from r1 to r2
    if not rules.is_soft:
        is_steep = vec2.dot(upper_end - lower_end, along) < 0
        upper_end, lower_end = jnp.where(is_steep, lower_end, upper_end), jnp.where(is_steep, upper_end, lower_end)
    edge_length = vec2.dot(r2 - r1, along)
    u_upper, u_lower = vec2.dot(upper_end - r1, along), vec2.dot(lower_end - r1, along)
    base = jnp.where(flipped, FLIPPED, 0) + edge * EDGE

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
    corner_feature = jnp.where(is_outside, CORNER_OUTSIDE, CORNER_INSIDE) + base + jnp.where(before_start, 0, 1)

    # Clip the incident edge to the sides of the reference face; depth follows the clipped point.
    span = u_upper - u_lower
    is_wide = span > 1e-9
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
    clipped_feature = base + incident * INCIDENT + jnp.arange(2)

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
        closing = vec2.dot(n, choose(motion, -motion))
        over = Incident(lower_end - ref_at, upper_end - ref_at, u_lower, u_upper, edge_length, closing)
        seam = slides_past(ref, inc, edge, inc_at - ref_at, over, margin)
        normal = jnp.where(seam.exists, seam.normal, normal)
        point = jnp.where(seam.exists, seam.point + ref_at, point)
        separation = jnp.where(seam.exists, seam.separation, separation)
        feature = jnp.where(seam.exists, SEAM + base + seam.number, feature)
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


class PairList(NamedTuple):
    """All pairs a < b of a capacity by kind, and where each of their points stands in the kernel's order. Numpy."""

    polygon_polygon: np.ndarray  # [:, 2] shape indices
    polygon_circle: np.ndarray
    circle_circle: np.ndarray
    order: np.ndarray  # [points] position among points by kind, for each point in order of pairs
    point_a: np.ndarray  # [points] shape indices of each point, in order of pairs
    point_b: np.ndarray


@functools.cache
def pair_list(capacity: Capacity) -> PairList:
    n, polygons = capacity.shapes, capacity.polygons
    a, b = np.triu_indices(n, 1)
    pairs = np.stack([a, b], -1).astype(np.int32)
    kinds = [pairs[b < polygons], pairs[(a < polygons) & (b >= polygons)], pairs[a >= polygons]]
    points = np.concatenate([np.repeat(kinds[0], 2, axis=0), *kinds[1:]])
    order = np.lexsort((points[:, 1], points[:, 0])).astype(np.int32)  # stable: the two points of a pair stay in order
    return PairList(*kinds, order=order, point_a=points[order, 0], point_b=points[order, 1])


def collide(geometry: Geometry, bodies: Bodies, capacity: Capacity, margin: jax.Array, rules: Rules) -> Points:
    """Points of all pairs, in order of pairs. margin [n, n] m: points farther apart than this are left out.

    For soft step points lie midway, and what slides over the seams of a floor is not stopped by them. For `paper` they
    lie where its appendix says (Collision Manifolds), and only what penetrates has any.
    """
    pairs = pair_list(capacity)
    velocity, omega = bodies.motion
    first_circle = capacity.polygons
    found = []
    for kind, collide_one, geometry_a, geometry_b, first_a, first_b in (
        (pairs.polygon_polygon, polygon_polygon, geometry.polygons, geometry.polygons, 0, 0),
        (pairs.polygon_circle, polygon_circle, geometry.polygons, geometry.radius, 0, first_circle),
        (pairs.circle_circle, circle_circle, geometry.radius, geometry.radius, first_circle, first_circle),
    ):
        if not len(kind):
            continue
        a, b = kind[:, 0], kind[:, 1]
        d = bodies.position[b] - bodies.position[a]
        one = jax.tree.map(lambda x, i=a - first_a: x[i], geometry_a)
        other = jax.tree.map(lambda x, i=b - first_b: x[i], geometry_b)
        motion, spin = velocity[b] - velocity[a], omega[a]
        if collide_one is polygon_polygon:
            points = jax.vmap(functools.partial(polygon_polygon, rules=rules))(one, other, d, motion, margin[a, b])
        elif collide_one is polygon_circle:
            collide_circle = functools.partial(polygon_circle, rules=rules)
            points = jax.vmap(collide_circle)(one, other, d, motion, spin, margin[a, b])
        else:
            points = jax.vmap(functools.partial(circle_circle, rules=rules))(one, other, d, margin[a, b])
        near = bounds_overlap(geometry, a, b, d, margin[a, b])
        points = points._replace(exists=points.exists & near[:, None])
        found.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), points))
    return jax.tree.map(lambda *xs: jnp.concatenate(xs)[pairs.order], *found)


def bounds_overlap(
    geometry: Geometry | Foresight, a: np.ndarray, b: np.ndarray, d: jax.Array, margin: jax.Array
) -> jax.Array:
    reach = margin[:, None]
    below = geometry.lower[b] + d <= geometry.upper[a] + reach
    above = geometry.upper[b] + d >= geometry.lower[a] - reach
    return jnp.all(below & above, axis=-1)


class Foresight(NamedTuple):
    """How far each surface goes at most at the speed that its body has when contacts are found."""

    distance: jax.Array  # [n] m
    core: jax.Array  # [n] m
    arm: jax.Array  # [n] m, of what swings: a disc's surface does not leave its place by turning
    lower: jax.Array  # [n, 2] m, bounds
    upper: jax.Array


def foresee(bodies: Bodies, geometry: Geometry, seconds: Scalar) -> Foresight:
    arm = geometry.extent - geometry.core
    distance = travel(bodies, arm, seconds)
    return Foresight(distance, geometry.core, arm, geometry.lower, geometry.upper)


def travel(bodies: Bodies, arm: jax.Array, left: Scalar) -> jax.Array:
    """How far each surface gets by the end of the step, at most, [n] m."""
    velocity, omega = bodies.motion
    gone = vec2.length(bodies.delta) + arm * jnp.abs(bodies.turn)
    there = gone + (vec2.length(velocity) + arm * jnp.abs(omega)) * left
    return jnp.where(bodies.is_dynamic, there, 0)


def margins(foreseen: Foresight, reach: Scalar, *, ahead: bool) -> jax.Array:
    """Distance at which a contact of each pair is prepared, [n, n] m.

    `ahead`: within what both move in a step if that is more than `reach`, so that no step ends inside; and within both
    where a body could step over what is in its way.
    """
    n, dtype = foreseen.distance.shape[0], foreseen.distance.dtype
    if not ahead:
        return jnp.full((n, n), reach, dtype)
    motion = foreseen.distance[:, None] + foreseen.distance[None]
    safe = 0.5 * jnp.minimum(foreseen.core[:, None], foreseen.core[None])
    return jnp.where(motion > safe, reach + motion, jnp.maximum(reach, motion)).astype(dtype)
