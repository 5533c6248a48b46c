"""Pairs of shapes of a capacity, and the contact points of those that are near each other."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Capacity
from jax2d.solver_numbers import Scalar
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies
from jax2d.xla.geometry import Geometry
from jax2d.xla.manifolds import Motion, Points, circle_circle, polygon_circle
from jax2d.xla.polygon_pairs import polygon_polygon
from jax2d.xla.rules import Rules


class PairList(NamedTuple):
    """Pairs a < b of a capacity by kind, and the row of each of their points in the kernel's order. Numpy."""

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


def collide(
    geometry: Geometry, bodies: Bodies, capacity: Capacity, margin: jax.Array, seconds: Scalar, h: Scalar, rules: Rules
) -> Points:
    """Points of all pairs, in order of pairs. margin [n, n] m: points farther apart than this are left out.

    `seconds`: for which bodies move on as they do, in sub-steps of `h` s. For soft step points lie midway, and what
    slides over the seams of a floor is not stopped by them. For `paper` they lie where its appendix says (Collision
    Manifolds), and only what penetrates has any.
    """
    pairs = pair_list(capacity)
    velocity, omega = bodies.velocities
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
        relative_velocity, spin = velocity[b] - velocity[a], omega[a]
        collide_pair = functools.partial(collide_one, rules=rules)
        if collide_one is circle_circle:
            points = jax.vmap(collide_pair)(one, other, d, relative_velocity, margin[a, b])
        else:
            # `seconds` and `h` are those of all pairs.
            collide_moving = jax.vmap(
                lambda one, other, d, velocity, spin, margin, collide_pair=collide_pair: collide_pair(
                    one, other, d, Motion(velocity, spin, seconds, h), margin
                )
            )
            points = collide_moving(one, other, d, relative_velocity, spin, margin[a, b])
        near = bounds_overlap(geometry, a, b, d, margin[a, b])
        points = points._replace(exists=points.exists & near[:, None])
        found.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), points))
    return jax.tree.map(lambda *xs: jnp.concatenate(xs)[pairs.order], *found)


def least_distance(bodies: Bodies, geometry: Geometry) -> jax.Array:
    """Distance that the surfaces of each pair have at least, [n, n] m at [lower, higher]: along the normal of a face,
    between discs along their line."""
    polygons, radius = geometry.polygons, geometry.radius
    n = polygons.corner.shape[0]
    d = bodies.position[None] - bodies.position[:, None]
    to_centre = d[:n, :, None] - polygons.corner[:, None]  # [P, n, edge, 2]
    normal = polygons.normal[:, None]
    beyond = jnp.where(polygons.is_corner[:, None], vec2.dot(normal, to_centre), -C.far_distance)
    to_corner = vec2.dot(normal[..., None, :], polygons.corner[None, :, None])  # [P, P, edge, corner]
    nearest = jnp.min(jnp.where(polygons.is_corner[None, :, None], to_corner, C.far_distance), axis=-1)
    of_polygons = jnp.max(beyond[:, :n] + nearest, axis=-1)
    of_discs = jnp.max(beyond[:, n:], axis=-1) - radius
    between_discs = vec2.length(d[n:, n:]) - radius[:, None] - radius
    upper = jnp.concatenate([jnp.maximum(of_polygons, of_polygons.T), of_discs], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([of_discs.T, between_discs], axis=1)])


def bounds_overlap(geometry: Geometry, a: np.ndarray, b: np.ndarray, d: jax.Array, margin: jax.Array) -> jax.Array:
    reach = margin[:, None]
    below = geometry.lower[b] + d <= geometry.upper[a] + reach
    above = geometry.upper[b] + d >= geometry.lower[a] - reach
    return jnp.all(below & above, axis=-1)
