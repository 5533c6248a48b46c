"""Mass, centroid and moment of inertia of circles and convex polygons of uniform area density.

Polygon integrals by the triangle fan about the first vertex (Green's theorem); moments are about the
centroid. Everything here works on numpy and on traced jax arrays alike.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array


def circle_mass_properties(radius: Array, density: Array) -> tuple[Array, Array]:
    """Mass (kg) and moment of inertia (kg m^2) of a disc: m = rho pi r^2, I = m r^2 / 2."""
    mass = density * jnp.pi * radius**2
    return mass, 0.5 * mass * radius**2


def polygon_mass_properties(vertices: Array, num_vertices: Array, density: Array) -> tuple[Array, Array, Array]:
    """Mass (kg), area centroid (m, [2], frame of the vertices) and moment of inertia about it (kg m^2).

    `vertices` is [V, 2] in either order of rotation; entries from `num_vertices` on are ignored. A polygon
    of zero area has zero mass, its first vertex as centroid, and zero inertia: builders refuse it.
    """
    vertices = jnp.asarray(vertices)
    max_vertices = vertices.shape[0]
    origin = vertices[0]
    index = jnp.arange(max_vertices)
    used = index < num_vertices
    # Unused corners fall back on the first vertex, where they span triangles of no area.
    corner = jnp.where(used[:, None], vertices - origin, 0.0)
    following = jnp.roll(corner, -1, axis=0)
    cross = corner[:, 0] * following[:, 1] - corner[:, 1] * following[:, 0]
    area = 0.5 * jnp.sum(cross)
    safe_area = jnp.where(area == 0.0, 1.0, area)
    centroid = jnp.sum(cross[:, None] * (corner + following), axis=0) / (6.0 * safe_area)
    centroid = jnp.where(area == 0.0, 0.0, centroid)
    second = jnp.sum(corner * corner + corner * following + following * following, axis=-1)
    inertia_origin = jnp.sum(cross * second) / 12.0
    sign = jnp.sign(area)
    mass = density * area * sign
    inertia = density * inertia_origin * sign - mass * jnp.sum(centroid * centroid)
    return mass, centroid + origin, inertia
