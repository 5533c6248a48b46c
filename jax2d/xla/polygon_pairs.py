"""Contact points of two polygons: the incident edge clipped to the reference face, corner against corner, or a seam.

Everything is relative to the centre of mass of polygon a, as in `manifolds.py`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import impact_plane, vec2
from jax2d.xla.branching import choose
from jax2d.xla.geometry import Polygons
from jax2d.xla.manifolds import Motion, Points
from jax2d.xla.rules import Rules
from jax2d.xla.seams import Incident, slides_past

T = TypeVar("T")


class Faces(NamedTuple):
    """The reference face of one polygon and the edge of the other that lies over it."""

    flipped: jax.Array  # [] bool, the face is b's
    from_impact_plane: jax.Array  # [] bool, it was chosen by how they move on: see `impact_plane`
    is_met: jax.Array  # [] bool, and they meet there
    holds_for: jax.Array  # [] s for which they move fast and the face is not crossed, 0 if it is
    velocity: jax.Array  # [2] m/s, of the incident polygon against the reference
    onward: jax.Array  # [2] m by which the incident polygon is looked at where they will meet
    reference: Polygons
    incident: Polygons
    reference_at: jax.Array  # [2] m, centre of its polygon
    incident_at: jax.Array  # where they will meet
    edge: jax.Array  # [] int32 of the reference polygon
    incident_edge: jax.Array
    normal: jax.Array  # [2] outward of the reference polygon
    start: jax.Array  # [2] m, the face's ends in counter-clockwise order
    end: jax.Array
    upper_end: jax.Array  # [2] m, of the incident edge: the farther along the face, and the nearer
    lower_end: jax.Array
    length: jax.Array  # [] m of the face
    u_upper: jax.Array  # [] m along the face from its start
    u_lower: jax.Array

    def choose(self, of_b: T, of_a: T) -> T:
        """`of_b` where the reference face is b's."""
        return choose(self.flipped, of_b, of_a)

    @property
    def base_feature(self) -> jax.Array:
        return jnp.where(self.flipped, C.feature_flipped, 0) + self.edge * C.feature_edge


class Corners(NamedTuple):
    """Corner against corner: for an incident edge beside the reference face."""

    beside: jax.Array  # [] bool, nothing of the incident edge is over the face
    is_outside: jax.Array  # [] bool, the corner is above the face's line
    by_face: jax.Array  # [] bool, the face keeps the two apart
    normal: jax.Array  # [2]
    point: jax.Array  # [2] m
    separation: jax.Array  # [] m
    feature: jax.Array  # [] int32


def polygon_polygon(
    a: Polygons,
    b: Polygons,
    d: jax.Array,
    motion: Motion,
    margin: jax.Array,
    *,
    rules: Rules,
) -> Points:
    """Contact points of two polygons, at most two, [2].

    d [2] m: centre of b relative to centre of a. In `paper` points lie on the incident edge.
    """
    relative_velocity = motion.velocity
    zero = jnp.zeros_like(d)
    of_a, of_b = max_separation(a, zero, b, d), max_separation(b, d, a, zero)
    (depth_a, _), (depth_b, _) = of_a, of_b
    faces = find_faces(a, b, d, of_a, of_b, motion, rules)
    within = (depth_a <= margin) & (depth_b <= margin)
    points = points_of(faces, rules)
    points = points._replace(exists=points.exists & (points.separation <= margin))
    if rules.is_soft:
        points = _at_seams(_deeper_last(points), faces, relative_velocity, margin)
    points = points._replace(
        normal=jnp.broadcast_to(jnp.where(faces.flipped, -points.normal, points.normal), (2, 2)),
        feature=points.feature.astype(jnp.int32),
        exists=within & points.exists,
    )
    if rules.is_soft:
        passing = impact_plane.pass_each_other(a, b, d, relative_velocity)
        passes = faces.from_impact_plane & faces.is_met & passing.exists
        points = Points(
            normal=jnp.where(passes, passing.normal, points.normal),
            point=jnp.where(passes, passing.nearest - 0.5 * passing.separation * passing.normal, points.point),
            separation=jnp.where(passes, passing.separation, points.separation),
            feature=jnp.where(passes, C.feature_seam + 2, points.feature).astype(jnp.int32),
            follows_b=jnp.where(passes, 1, points.follows_b),
            on_face=points.on_face,
            exists=jnp.where(passes, jnp.array([True, False]) & (passing.separation <= margin) & within, points.exists),
        )
    return points


def points_of(faces: Faces, rules: Rules) -> Points:
    """Two points of the incident edge over the reference face, or one of corner against corner, outward of the face."""
    corners, clipped = find_corners(faces, rules), clipped_points(faces, clip(faces), rules)
    beside = corners.beside
    return clipped._replace(
        normal=jnp.where(beside & corners.is_outside & ~corners.by_face, corners.normal, clipped.normal),
        point=jnp.where(beside, corners.point, clipped.point),
        separation=jnp.where(beside, corners.separation, clipped.separation),
        feature=jnp.where(beside, corners.feature, clipped.feature),
        exists=jnp.where(beside, jnp.array([True, False]), True),
    )


def clipped_points(faces: Faces, clipped: jax.Array, rules: Rules) -> Points:
    """Points at the ends [2, 2] m of the clipped incident edge."""
    clipped = clipped - faces.onward
    separation = vec2.dot(clipped - faces.start, faces.normal)
    return Points(
        normal=faces.normal,
        point=clipped - _halfway(rules) * separation[:, None] * faces.normal,
        separation=separation,
        feature=faces.base_feature + faces.incident_edge * C.feature_incident + jnp.arange(2),
        follows_b=jnp.broadcast_to(jnp.where(faces.flipped, 0.0, 1.0).astype(clipped.dtype), (2,)),  # corners on a face
        exists=jnp.ones(2, bool),
        on_face=jnp.zeros(2, bool),
    )


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


def find_faces(
    a: Polygons,
    b: Polygons,
    d: jax.Array,
    of_a: tuple[jax.Array, jax.Array],
    of_b: tuple[jax.Array, jax.Array],
    motion: Motion,
    rules: Rules,
) -> Faces:
    """`of_a`, `of_b`: what `max_separation` says of the edges of each."""
    (depth_a, edge_a), (depth_b, edge_b) = of_a, of_b
    relative_velocity, seconds, h = motion.velocity, motion.seconds, motion.h
    zero = jnp.zeros_like(d)
    # The reference face is that of the clearly larger shape (a's if neither is) unless the other's is clearly better: a
    # floor holds its normal while what stands on it rocks.
    larger_b = b.extent > C.clearly_larger * a.extent
    advantage = jnp.where(larger_b, -C.flip_advantage, C.flip_advantage)
    flipped = depth_b > depth_a + advantage

    from_impact_plane, holds_for, impact_edge, impact_seconds = (
        jnp.array(False),
        jnp.zeros_like(depth_a),
        edge_a,
        jnp.zeros_like(depth_a),
    )
    if rules.is_soft:
        towards = jnp.where(flipped, -b.normal[edge_b], a.normal[edge_a])
        rate = vec2.dot(towards, relative_velocity)
        apart = jnp.maximum(depth_a, depth_b)
        impact = impact_plane.of_polygons(a, b, d, relative_velocity, advantage, seconds)
        passes = (apart > 0) & impact_plane.moves(relative_velocity)
        # The last relax pass asks what would be met in a sub-step more; what goes half a graze in one needs no care.
        is_fast = vec2.dot(relative_velocity, relative_velocity) * h * h > 0.25 * C.grazing_distance**2
        lookahead = jnp.where(is_fast, seconds + h, seconds)
        is_crossed = apart + rate * lookahead < 0
        holds_for = jnp.where(passes & is_fast & ~is_crossed, lookahead, 0)
        from_impact_plane = passes & is_crossed & impact.exists
        flipped = jnp.where(from_impact_plane, impact.flipped, flipped)
        impact_edge, impact_seconds = impact.edge, jnp.where(from_impact_plane, impact.seconds, 0)
    velocity = jnp.where(flipped, -relative_velocity, relative_velocity)
    onward = velocity * impact_seconds

    ref, inc = choose(flipped, b, a), choose(flipped, a, b)
    ref_at, inc_at = choose(flipped, d, zero), choose(flipped, zero, d) + onward
    edge = jnp.where(from_impact_plane, impact_edge, jnp.where(flipped, edge_b, edge_a))
    n = ref.normal[edge]
    start, end = ref.corner[edge] + ref_at, ref.following[edge] + ref_at

    # The incident edge is the one that faces the reference face most, in `paper` the one whose corners are deepest.
    alignment = vec2.dot(inc.normal if rules.is_soft else inc.corner + inc.following, n)
    incident = jnp.argmin(jnp.where(inc.is_corner, alignment, C.far_distance))
    # Its first corner is the farther along the reference edge, unless a steep and short edge has the deepest corners.
    upper_end, lower_end = inc.corner[incident] + inc_at, inc.following[incident] + inc_at
    along = vec2.left(n)  # from the start to the end
    if not rules.is_soft:
        is_steep = vec2.dot(upper_end - lower_end, along) < 0
        upper_end, lower_end = jnp.where(is_steep, lower_end, upper_end), jnp.where(is_steep, upper_end, lower_end)
    return Faces(
        flipped=flipped,
        from_impact_plane=from_impact_plane,
        is_met=impact_seconds > 0,
        holds_for=holds_for,
        velocity=velocity,
        onward=onward,
        reference=ref,
        incident=inc,
        reference_at=ref_at,
        incident_at=inc_at,
        edge=edge,
        incident_edge=incident,
        normal=n,
        start=start,
        end=end,
        upper_end=upper_end,
        lower_end=lower_end,
        length=vec2.dot(end - start, along),
        u_upper=vec2.dot(upper_end - start, along),
        u_lower=vec2.dot(lower_end - start, along),
    )


def find_corners(faces: Faces, rules: Rules) -> Corners:
    before_start = faces.u_upper < 0
    ref_corner = jnp.where(before_start, faces.start, faces.end)
    inc_corner = jnp.where(before_start, faces.upper_end, faces.lower_end)
    gap = inc_corner - ref_corner
    distance, face_separation = vec2.length(gap), vec2.dot(faces.normal, gap)
    # Where the path crosses the plane between two corners, but not the face, it passes: the face keeps them apart.
    passes = (faces.holds_for > 0) & (distance * distance + vec2.dot(gap, faces.velocity) * faces.holds_for < 0)
    by_face = faces.from_impact_plane | passes
    face_separation = jnp.where(
        by_face, jnp.maximum(face_separation - vec2.dot(faces.normal, faces.onward), 0), face_separation
    )
    is_outside = (face_separation > 0) | by_face
    at_face = inc_corner - faces.onward - _halfway(rules) * face_separation * faces.normal
    kind = jnp.where(is_outside, C.feature_corner_outside, C.feature_corner_inside)
    between = is_outside & ~by_face
    return Corners(
        beside=before_start | (faces.u_lower > faces.length),
        is_outside=is_outside,
        by_face=by_face,
        normal=vec2.unit_or_zero(gap),
        point=jnp.where(between, 0.5 * (ref_corner + inc_corner), at_face),
        separation=jnp.where(between, distance, face_separation),
        feature=kind + faces.base_feature + jnp.where(before_start, 0, 1),
    )


def clip(faces: Faces) -> jax.Array:
    """[2, 2] m: the lower and the upper end of the incident edge, clipped to the sides of the reference face."""
    span = faces.u_upper - faces.u_lower
    is_wide = span > C.min_span
    share = 1 / jnp.where(is_wide, span, 1)
    lower_end, upper_end = faces.lower_end, faces.upper_end
    edge_vector = upper_end - lower_end
    lower = jnp.where((faces.u_lower < 0) & is_wide, lower_end - edge_vector * (faces.u_lower * share), lower_end)
    upper = jnp.where(
        (faces.u_upper > faces.length) & is_wide,
        lower_end + edge_vector * ((faces.length - faces.u_lower) * share),
        upper_end,
    )
    return jnp.stack([lower, upper])


def _halfway(rules: Rules) -> float:
    """Share of an overlap by which points lie above the incident edge."""
    return 0.5 if rules.is_soft else 0


def _deeper_last(points: Points) -> Points:
    """Points are solved one after another: the deeper last, so that a mirror image is solved alike."""
    is_first_deeper = jnp.all(points.exists) & (points.separation[0] < points.separation[1])
    swapped = points._replace(
        point=points.point[::-1], separation=points.separation[::-1], feature=points.feature[::-1]
    )
    return choose(is_first_deeper, swapped, points)


def _at_seams(points: Points, faces: Faces, relative_velocity: jax.Array, margin: jax.Array) -> Points:
    """The points, or the one of a pair that slides past the end of the face."""
    centre = faces.reference_at
    over = Incident(
        lower_end=faces.lower_end - centre,
        upper_end=faces.upper_end - centre,
        u_lower=faces.u_lower,
        u_upper=faces.u_upper,
        face_length=faces.length,
        closing=vec2.dot(faces.normal, faces.choose(relative_velocity, -relative_velocity)),
    )
    seam = slides_past(faces.reference, faces.incident, faces.edge, faces.incident_at - centre, over, margin)
    seam = seam._replace(exists=seam.exists & ~faces.from_impact_plane)
    return Points(
        normal=jnp.where(seam.exists, seam.normal, points.normal),
        point=jnp.where(seam.exists, seam.point + centre, points.point),
        separation=jnp.where(seam.exists, seam.separation, points.separation),
        feature=jnp.where(seam.exists, C.feature_seam + faces.base_feature + seam.number, points.feature),
        follows_b=points.follows_b,
        exists=jnp.where(seam.exists, jnp.array([True, False]), points.exists),
        on_face=points.on_face,
    )
