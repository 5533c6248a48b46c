"""Shapes as they stand in the world at the start of a step: corners, normals, bounds."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Scene
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies


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
    num_polygons, num_corners = scene.shapes.vertices.shape[:2]
    slot = jnp.arange(num_corners)
    is_corner = slot < scene.shapes.num_vertices[:, None]
    corner = vec2.rotated(scene.shapes.vertices, bodies.angle[:num_polygons, None])
    is_last = slot + 1 >= scene.shapes.num_vertices[:, None]
    following = jnp.where(is_last[..., None], corner[:, :1], jnp.roll(corner, -1, axis=1))
    normal = vec2.unit_or_zero(vec2.right(following - corner))
    real = is_corner[..., None]
    extent = jnp.max(jnp.where(is_corner, vec2.length(corner), 0), axis=1, initial=0)
    r = scene.shapes.radius
    radii = jnp.stack([r, r], -1)
    return Geometry(
        polygons=Polygons(corner, following, normal, is_corner, extent),
        radius=r,
        lower=jnp.concatenate(
            [jnp.min(jnp.where(real, corner, C.far_distance), axis=1, initial=C.far_distance), -radii]
        ),
        upper=jnp.concatenate(
            [jnp.max(jnp.where(real, corner, -C.far_distance), axis=1, initial=-C.far_distance), radii]
        ),
        core=jnp.concatenate(
            [jnp.min(jnp.where(is_corner, vec2.dot(normal, corner), C.far_distance), 1, initial=C.far_distance), r]
        ),
        extent=jnp.concatenate([extent, r]),
    )
