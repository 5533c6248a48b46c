"""Geometry and mechanics in float64 that share no code with the engine: what tests judge it by."""

from __future__ import annotations

import math

import numpy as np

from jax2d import BuiltWorld


def rotation(angle: np.ndarray | float) -> np.ndarray:
    """[..., 2, 2] of angles [...] rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[c, -s], [s, c]]), (0, 1), (-2, -1))


def corners_of(world: BuiltWorld, shape: int, position: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """[..., k, 2] m: corners of a polygon of a scene where it stands, at [..., 2] m and [...] rad."""
    shapes = world.scene.shapes
    local = np.asarray(shapes.vertices[shape][: int(shapes.num_vertices[shape])], np.float64)
    return local @ np.swapaxes(rotation(angle), -1, -2) + position[..., None, :]


def faces(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward unit normals and starts of the faces of counter-clockwise polygons [..., k, 2]."""
    along = np.roll(corners, -1, -2) - corners
    normals = np.stack([along[..., 1], -along[..., 0]], -1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True), corners


def polygons_overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[...] m: depth of two convex polygons [..., k, 2] in each other, negative where they are apart (separating
    axes)."""

    def least(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        normals, starts = faces(one)
        gaps = ((other[..., None, :, :] - starts[..., :, None, :]) * normals[..., :, None, :]).sum(-1)
        return gaps.min(-1).max(-1)

    return -np.maximum(least(a, b), least(b, a))


def disc_overlap(polygon: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """[...] m: depth of a disc at [..., 2] in a convex polygon [..., k, 2], negative where they are apart."""
    normals, starts = faces(polygon)
    away = centre[..., None, :] - polygon
    inside = ((centre[..., None, :] - starts) * normals).sum(-1).max(-1)
    edges = np.roll(polygon, -1, -2) - polygon
    share = np.clip((away * edges).sum(-1) / (edges * edges).sum(-1), 0, 1)
    nearest = np.linalg.norm(away - share[..., None] * edges, axis=-1).min(-1)
    return radius - np.where(inside <= 0, inside, nearest)


def regained_height(num_facets: int, radius: float, start: int, bowl_radius: float, gravity: float) -> float:
    """m above the lowest point of its path: how high a disc rises that slides without friction or bounce from rest on
    facet `start` through half a regular polygon of 2 `num_facets` sides. Its centre moves on a smaller polygon, and at
    every corner of it keeps the part of its speed along the next side, cos^2 of its energy."""
    turn = math.pi / num_facets
    inner = bowl_radius - radius / math.cos(turn / 2)
    heights = [inner * math.sin(math.pi + turn * k) for k in range(num_facets + 1)]
    lowest = -inner * math.cos(turn / 2)
    middle = inner * math.cos(turn / 2) * math.sin(math.pi + turn * (start + 0.5))
    energy = gravity * middle
    for k in range(start + 1, num_facets):
        kinetic = energy - gravity * heights[k]
        if kinetic <= 0:
            break
        energy = gravity * heights[k] + kinetic * math.cos(turn) ** 2
    return energy / gravity - lowest


def sticking_impact(
    arm: np.ndarray, velocity: np.ndarray, spin: float, squared_radius: float
) -> tuple[np.ndarray, float]:
    """Velocity and spin after a body met something fixed at `arm` [2] m from its centre of mass and did not slip or
    bounce there: angular momentum about that point is kept. `squared_radius` m^2: inertia over mass."""
    centre = -arm
    about_point = squared_radius * spin + centre[0] * velocity[1] - centre[1] * velocity[0]
    after = about_point / (squared_radius + centre @ centre)
    return after * np.array([-centre[1], centre[0]]), float(after)


def speeds_after_collisions(
    centres: np.ndarray, speeds: np.ndarray, masses: np.ndarray, radii: np.ndarray, restitution: float
) -> np.ndarray:
    """[n] m/s of discs in a row, from left to right, after all of their collisions in order of time."""
    x, v = np.array(centres, np.float64), np.array(speeds, np.float64)
    for _ in range(10_000):
        gaps, closing = np.maximum(np.diff(x) - radii[1:] - radii[:-1], 0), v[:-1] - v[1:]
        approaches = closing > 1e-9
        if not approaches.any():
            return v
        seconds = np.where(approaches, gaps / np.where(approaches, closing, 1), np.inf)
        i = int(np.argmin(seconds))
        x += v * seconds[i]
        impulse = (1 + restitution) * closing[i] * masses[i] * masses[i + 1] / (masses[i] + masses[i + 1])
        v[i] -= impulse / masses[i]
        v[i + 1] += impulse / masses[i + 1]
    raise AssertionError("collisions without end")
