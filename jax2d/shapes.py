"""Mass, centroid and moment of inertia of circles and convex polygons of uniform area density.

Polygon integrals by the triangle fan about the first vertex (Green's theorem); moments are about the centroid.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array


def circle_mass_properties(radius: Array, density: Array) -> tuple[Array, Array]:
    """Mass (kg) and moment of inertia (kg m^2) of a disc: m = rho pi r^2, I = m r^2 / 2."""
    mass = density * jnp.pi * radius**2
    return mass, 0.5 * mass * radius**2


def polygon_integrals(corners: Array) -> tuple[Array, Array, Array]:
    """Area (m^2, negative for corners that run clockwise), centroid (m, [2]) and second moment of area about it (m^4).

    `corners` is [V, 2]; equal corners in a row span nothing. numpy arrays give numpy's float64, for builders. Without
    area the centroid is the first corner.
    """
    xp = np if isinstance(corners, np.ndarray) else jnp
    local = corners - corners[0]
    following = xp.roll(local, -1, axis=0)
    cross = local[:, 0] * following[:, 1] - local[:, 1] * following[:, 0]
    area = 0.5 * xp.sum(cross)
    safe_area = xp.where(area == 0.0, 1.0, area)
    centroid = xp.where(area == 0.0, 0.0, xp.sum(cross[:, None] * (local + following), axis=0) / (6.0 * safe_area))
    second = xp.sum(local * local + local * following + following * following, axis=-1)
    moment = xp.sum(cross * second) / 12.0 - area * xp.sum(centroid * centroid)
    return area, centroid + corners[0], moment


def polygon_mass_properties(vertices: Array, num_vertices: Array, density: Array) -> tuple[Array, Array, Array]:
    """Mass (kg), area centroid (m, [2], frame of the vertices) and moment of inertia about it (kg m^2).

    `vertices` is [V, 2] in either order of rotation; entries from `num_vertices` on are ignored. A polygon
    of zero area has zero mass, its first vertex as centroid, and zero inertia: builders refuse it.
    """
    vertices = jnp.asarray(vertices)
    used = jnp.arange(vertices.shape[0]) < num_vertices
    # Unused corners fall back on the first vertex, where they span triangles of no area.
    area, centroid, moment = polygon_integrals(jnp.where(used[:, None], vertices, vertices[0]))
    sign = jnp.sign(area)
    return density * area * sign, centroid, density * moment * sign
