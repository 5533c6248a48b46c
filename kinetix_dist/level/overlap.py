"""Overlaps of shapes, by separating axes for circles and convex polygons alike, for generators and checks.

A shape is `V` world corners and a radius: a polygon has radius 0, a circle has its centre `V` times. Not the engine's
contact code: this only says yes or no, costs a few dot products and vectorises over anything.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array


def world_corners(position: Array, angle: Array, vertices: Array) -> Array:
    """`[..., V, 2]` corners in the world of shapes `[..., 2]`, `[...]`, `[..., V, 2]`."""
    cos, sin = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    x, y = vertices[..., 0], vertices[..., 1]
    return position[..., None, :] + jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def separation(corners_a: Array, radius_a: Array, corners_b: Array, radius_b: Array) -> Array:
    """Largest gap over all candidate axes (m) of two shapes: negative where they overlap.

    `corners_a` [V, 2], `corners_b` [V, 2]. Axes are the edge normals of both polygons and, for circles, the directions
    from the centre to the corners of the other. Exact in sign; the value is a lower bound of the distance.
    """

    # Corner-to-corner axes matter only where one side is a circle, whose corners are all its centre.
    towards = corners_b - corners_a[:1]
    back = corners_a - corners_b[:1]
    is_round = (radius_a > 0.0) | (radius_b > 0.0)
    axes = jnp.concatenate([_edge_normals(corners_a), _edge_normals(corners_b), towards * is_round, back * is_round])
    return _largest_gap(axes, corners_a, corners_b) - radius_a - radius_b


def surface_distance(corners_a: Array, radius_a: Array, corners_b: Array, radius_b: Array) -> Array:
    """Distance (m) of the surfaces of two shapes, given as for `separation`. Exact where they do not overlap, since the
    shortest way between convex shapes is along the normal of an edge or from corner to corner; negative where they do.
    """
    between = (corners_b[None, :, :] - corners_a[:, None, :]).reshape(-1, 2)
    axes = jnp.concatenate([_edge_normals(corners_a), _edge_normals(corners_b), between])
    return _largest_gap(axes, corners_a, corners_b) - radius_a - radius_b


def _edge_normals(corners: Array) -> Array:
    edge = jnp.roll(corners, -1, axis=0) - corners
    return jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1)


def _largest_gap(axes: Array, corners_a: Array, corners_b: Array) -> Array:
    """Largest gap (m) of the corners of two shapes along any of the axes `[k, 2]`; axes of length 0 do not count."""
    length = jnp.sqrt(jnp.sum(axes * axes, axis=-1))
    usable = length > 1e-6  # zero-length edges of padding and of circles
    axes = axes / jnp.where(usable, length, 1.0)[:, None]

    def project(corners: Array) -> Array:  # [axes, V]; a product of width 2 is faster written out
        return axes[:, :1] * corners[:, 0] + axes[:, 1:] * corners[:, 1]

    along_a, along_b = project(corners_a), project(corners_b)
    gap = jnp.maximum(
        along_b.min(axis=-1) - along_a.max(axis=-1),
        along_a.min(axis=-1) - along_b.max(axis=-1),
    )
    return jnp.max(jnp.where(usable, gap, -jnp.inf))


def reach(point: Array, vertices: Array, radius: Array) -> Array:
    """Distance from a point of the body frame to the farthest point of the shape."""
    distance = jnp.sqrt(jnp.sum((vertices - point) ** 2, axis=-1))
    return jnp.max(distance) + radius


def inset(point: Array, vertices: Array, radius: Array) -> Array:
    """Distance from a point inside the shape (body frame) to its nearest boundary; padding corners are ignored."""
    edge = jnp.roll(vertices, -1, axis=0) - vertices
    length = jnp.sqrt(jnp.sum(edge * edge, axis=-1))
    offset = point - vertices
    depth = (edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0]) / jnp.where(length > 1e-6, length, 1.0)
    from_edges = jnp.min(jnp.where(length > 1e-6, depth, jnp.inf))
    from_circle = radius - jnp.sqrt(jnp.sum(point * point))
    return jnp.where(radius > 0.0, from_circle, from_edges)
