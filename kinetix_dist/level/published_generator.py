"""Details of the public package's random generator that no parameter expresses: `GeneratorConfig.published_details`.

Each function is a step of `proposals.py` and changes nothing where its detail is not in the config, as in all
generators but `kinetix`. docs/level_format.md, "Random levels", describes the effects.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from kinetix_dist.level.draft import Shapes
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.walls import WALL_CENTRES_M


def with_walls_to_join(
    wish_polygon: Array, any_polygon: Array, shapes: Shapes, num_polygons: int, config: GeneratorConfig
) -> tuple[Array, Array]:
    """Weights of polygons to join, and whether there is one. Detail `joined_to_walls`: where every polygon holds two
    joints, any is joined, walls too."""
    if "joined_to_walls" not in config.published_details:
        return wish_polygon, any_polygon
    slots = jnp.arange(shapes.active.shape[0])
    is_polygon = shapes.active & (slots < num_polygons)
    wish_polygon = jnp.where(~any_polygon, is_polygon * 1.0, wish_polygon)
    return wish_polygon, (is_polygon & (slots >= NUM_WALLS)).any()


def with_wide_margin(half_width: Array, is_polygon: Array, is_long: Array, config: GeneratorConfig) -> Array:
    """Half width (m) of a free shape for its distance from the walls. Detail `wide_margins`: boxes have a radius there,
    circles half extents."""
    if "wide_margins" not in config.published_details:
        return half_width
    unused = config.min_half_extent * math.sqrt(2.0) * jnp.where(is_long, config.large_rectangle_scale, 1.0)
    return jnp.maximum(half_width, jnp.where(is_polygon, config.min_radius, unused))


def with_exchanged_anchors(
    anchors: tuple[Array, Array], is_polygon: tuple[Array, Array], partner_slot: Array, config: GeneratorConfig
) -> tuple[Array, Array]:
    """Anchors by which the visibility of a new shape and of its partner is judged. Detail `exchanged_anchors`: each by
    the other's anchor."""
    new, partner = anchors
    if "exchanged_anchors" not in config.published_details:
        return new, partner
    new_is_polygon, partner_is_polygon = is_polygon
    on_partner = partner + _from_published_origin(partner_slot)
    seen_at_new = jnp.where(partner_is_polygon, jnp.where(new_is_polygon, on_partner, 0.0), new)
    return seen_at_new, jnp.where(partner_is_polygon, new, partner)


def rest_angle_of(angle_between: Array, is_fixed: Array, config: GeneratorConfig) -> Array:
    """Rest angle (rad) of a joint. Detail `limits_from_zero`: that of a hinge is 0, so that limits count from equal
    angles of its shapes, not from those at the start."""
    if "limits_from_zero" not in config.published_details:
        return angle_between
    return jnp.where(is_fixed, angle_between, 0.0)


def count_contact_points(shapes: Shapes, new: Shapes) -> Array:
    """Cost of a proposal with detail `contact_points`: its contact points with active shapes, of its own body too."""
    corners = world_corners(shapes.position, shapes.angle, shapes.vertices)
    new_corners = world_corners(new.position, new.angle, new.vertices)
    count = jax.vmap(contact_points, in_axes=(0, 0, 0, None, None, None))
    points = count(corners, shapes.num_vertices, shapes.radius, new_corners, new.num_vertices, new.radius)
    return jnp.sum(points * shapes.active).astype(jnp.float32)


def contact_points(
    corners_a: Array, num_a: Array, radius_a: Array, corners_b: Array, num_b: Array, radius_b: Array
) -> Array:
    """Number of contact points that the public package finds between two shapes: 0, 1, or 2 of two polygons.

    corners `[V, 2]` in the world, of which `num` count (0 of a circle). Two polygons touch in a second point where the
    second deepest corner of one lies behind the other's face of least penetration too; faces are not clipped.
    """
    overlaps = separation(corners_a, radius_a, corners_b, radius_b) < 0.0
    gap_a, second_behind_a = _deepest_face(corners_a, num_a, corners_b, num_b)
    gap_b, second_behind_b = _deepest_face(corners_b, num_b, corners_a, num_a)
    second_behind = jnp.where(gap_a + 0.01 < gap_b, second_behind_b, second_behind_a)
    return overlaps.astype(jnp.int32) * (1 + ((num_a > 0) & (num_b > 0) & second_behind))


def _deepest_face(corners: Array, num_corners: Array, others: Array, num_others: Array) -> tuple[Array, Array]:
    """Gap (m) of the face of a polygon with the largest gap to another, and whether two corners lie behind it."""
    edge = jnp.roll(corners, -1, axis=0) - corners
    # The last corner is repeated in unused slots: the edge of the last of them leads back to the first corner.
    length = jnp.sqrt(jnp.sum(edge * edge, axis=-1))
    outwards = jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1) / jnp.where(length > 1e-6, length, 1.0)[:, None]
    offset = others[None, :, :] - corners[:, None, :]
    depth = jnp.sum(offset * outwards[:, None, :], axis=-1)  # [faces, corners of the other], negative behind
    depth = jnp.where(jnp.arange(others.shape[0])[None, :] < num_others, depth, jnp.inf)
    gap = jnp.where((length > 1e-6) & (num_corners > 0), depth.min(axis=1), -jnp.inf)
    face = jnp.argmax(gap)
    return gap[face], jnp.sort(depth[face])[1] < 0.0


def _from_published_origin(index: Array) -> Array:
    """[2] m, from the origin of a shape's frame in the public package to that of ours: side walls have it at (0, 0)."""
    side_walls = (1, 2)
    offsets = (
        jnp.zeros((NUM_WALLS, 2), jnp.float32)
        .at[jnp.array(side_walls, jnp.int32)]
        .set(WALL_CENTRES_M[list(side_walls)])
    )
    return jnp.where(index < NUM_WALLS, offsets[jnp.minimum(index, NUM_WALLS - 1)], 0.0)
