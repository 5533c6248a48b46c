"""Questions to worlds as they stand: what a ray meets first, and which shapes hold a point. Pure JAX.

    hits = cast_rays(scene, state, origins, translations, ignore=is_sensor)  # [R, 2] m each: where from, and how far
    hits.distance                                                            # [R] m, up to what each meets first

All arrays may have a leading axis of worlds, as for `Engine.step`. Everything works inside jit, vmap and scan, in the
precision of the state, and a world gets the same bits alone and in a batch.

Rays go from shape to shape in coordinates relative to their own origin, so that scenes far from the world's origin lose
no digits but those that positions have lost already. A polygon is the intersection of the half-planes of its edges: a
ray enters it where it has crossed the last edge that it crosses inwards, unless it has left through another by then
(Cyrus and Beck). A disc is met at a = m . u - sqrt(r^2 - (m x u)^2), u the direction and m the way to its centre.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.checks import check_real, check_type, is_known
from jax2d.constants import CONSTANTS as C
from jax2d.fields import Array
from jax2d.scene import Scene
from jax2d.xla import vec2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class RayHits:
    """First hit of each of R rays; [W, R, ...] for a batch of worlds."""

    hit: Array  # [R] bool
    fraction: Array  # [R] share of the ray up to there, 0 to 1; 1 where it meets nothing
    distance: Array  # [R] m up to there; the length of the ray where it meets nothing
    point: Array  # [R, 2] m, world frame; the end of the ray where it meets nothing
    normal: Array  # [R, 2] of the surface, outwards; zero where it meets nothing
    shape: Array  # [R] int32 index; -1 where it meets nothing
    invalid: Array  # [R] bool, no ray: without length or not finite. It meets nothing and all numbers are 0


def cast_rays(scene: Scene, state: Any, origins: Array, translations: Array, *, ignore: Array | None = None) -> RayHits:
    """The first shape on each ray from `origins` to `origins` + `translations`, both [R, 2] m ([W, R, 2] for a batch).

    `state` is anything with `position` and `angle`. `ignore` marks shapes that rays pass, for example the sensor's own
    body: [n] bool for all rays, [R, n] for each, or [W, R, n] in a batch.

    A shape that the ray begins inside of is not met, neither at its start nor on the way out, but whatever lies behind
    it is (as in Box2D before 3.1). Surfaces belong to shapes; what begins on one, or runs along one, is to either side
    of it as rounding falls. Of shapes met at the same distance it is the one of the lowest index.

    Raises ValueError for shapes that do not fit, and outside of jit for rays without length or not finite; inside jit
    `RayHits.invalid` marks them.
    """
    batch, dtype = _check_worlds(scene, state)
    origins, translations = (
        _points(name, x, batch, dtype) for name, x in (("origins", origins), ("translations", translations))
    )
    if origins.shape != translations.shape:
        raise ValueError(f"origins have shape {origins.shape}, translations {translations.shape}; give as many of both")
    seen = _seen(scene, ignore, batch, origins.shape[-2])
    cast = _cast_batch if batch else _cast
    found = cast(scene.shapes, state.position, state.angle, origins, translations, seen)
    if is_known(found.invalid) and (wrong := np.asarray(found.invalid)).any():
        at = tuple(np.argwhere(wrong)[0])
        start, way = (np.asarray(jax.lax.stop_gradient(x))[at].tolist() for x in (origins, translations))
        raise ValueError(
            f"ray {', '.join(map(str, at))} goes from {start} by {way}; a ray has finite numbers and a length above 0 "
            "(inside jit it is marked in RayHits.invalid)"
        )
    return found


def point_in_shapes(scene: Scene, state: Any, points: Array) -> jax.Array:
    """Shapes that hold each of `points` [R, 2] m ([W, R, 2] for a batch): [R, n] bool. Surfaces belong to shapes; what
    is not active holds nothing, and a point that is not finite is in no shape. Raises ValueError for shapes that do
    not fit."""
    batch, dtype = _check_worlds(scene, state)
    holds = _hold_batch if batch else _hold
    return holds(scene.shapes, state.position, state.angle, _points("points", points, batch, dtype))


# One world


def _cast_world(
    shapes: Any, position: Array, angle: Array, origin: jax.Array, way: jax.Array, seen: jax.Array
) -> RayHits:
    num_polygons = shapes.num_vertices.shape[0]
    scale = jnp.max(jnp.abs(way), -1)  # lengths of which the square is no float are lengths
    length = scale * vec2.length(way / jnp.where(scale > 0, scale, 1)[:, None])
    is_ray = (length > 0) & jnp.isfinite(length) & jnp.all(jnp.isfinite(origin), -1)
    along = jnp.where(is_ray[:, None], way, 1) / jnp.where(is_ray, length, 1)[:, None]
    origin = jnp.where(is_ray[:, None], origin, 0)
    length = jnp.where(is_ray, length, 0)

    away = jnp.asarray(position)[None] - origin[:, None]  # [R, n, 2] m, from the start of each ray
    faces = _faces(shapes, angle[:num_polygons])
    to_polygon, face = _reach_polygons(faces, away[:, :num_polygons], along)
    to_circle = _reach_circles(jnp.asarray(shapes.radius), away[:, num_polygons:], along)
    reach = jnp.concatenate([to_polygon, to_circle], axis=1)
    reach = jnp.where(seen & (reach >= 0) & (reach <= length[:, None]) & is_ray[:, None], reach, C.far_distance)

    shape = jnp.argmin(reach, axis=1)
    nearest = jnp.take_along_axis(reach, shape[:, None], axis=1)[:, 0]
    hit = nearest < C.far_distance
    distance = jnp.where(hit, nearest, length)
    normal = _normal_of_hit(faces, face, shape, away, along, distance)
    fraction = jnp.where(hit, distance / jnp.where(is_ray, length, 1), 1)
    return RayHits(
        hit=hit,
        fraction=jnp.where(is_ray, fraction, 0),
        distance=distance,
        point=origin + along * distance[:, None],
        normal=jnp.where(hit[:, None], normal, 0),
        shape=jnp.where(hit, shape, -1).astype(jnp.int32),
        invalid=~is_ray,
    )


def _hold_world(shapes: Any, position: Array, angle: Array, points: jax.Array) -> jax.Array:
    num_polygons = shapes.num_vertices.shape[0]
    away = points[:, None] - jnp.asarray(position)[None]  # [R, n, 2] m, from each centre
    normal, distance = _faces(shapes, angle[:num_polygons])
    holds = jnp.ones(away[:, :num_polygons, 0].shape, bool)
    for k in range(normal.shape[1]):
        holds &= vec2.dot(normal[None, :, k], away[:, :num_polygons]) <= distance[None, :, k]
    radius = jnp.asarray(shapes.radius)
    in_circle = vec2.length(away[:, num_polygons:]) <= radius
    is_place = jnp.isfinite(away).all(-1)  # the length of NaN is 0
    return jnp.concatenate([holds, in_circle], axis=1) & is_place & shapes.active


_cast, _cast_batch = jax.jit(_cast_world), jax.jit(jax.vmap(_cast_world))
_hold, _hold_batch = jax.jit(_hold_world), jax.jit(jax.vmap(_hold_world))


def _faces(shapes: Any, angle: Array) -> tuple[jax.Array, jax.Array]:
    """(outward normals [P, V, 2], distances from the centre of mass [P, V] m) of edges, as the polygons are turned.
    Edges that a polygon has not are far away."""
    vertices, count = jnp.asarray(shapes.vertices), jnp.asarray(shapes.num_vertices)[:, None]
    slot = np.arange(vertices.shape[1])
    following = jnp.take_along_axis(vertices, jnp.where(slot + 1 < count, slot + 1, 0)[..., None], axis=1)
    edge = vec2.right(following - vertices)
    length = vec2.length(edge)
    local = edge / jnp.where(length > 0, length, 1)[..., None]
    is_edge = (slot < count) & (length > 0)
    distance = jnp.where(is_edge, vec2.dot(local, vertices), C.far_distance)
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    x, y = local[..., 0], local[..., 1]
    turned = jnp.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return jnp.where(is_edge[..., None], turned, 0), distance


def _reach_polygons(
    faces: tuple[jax.Array, jax.Array], away: jax.Array, along: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(distance [R, P] m at which each ray enters each polygon, below zero or beyond C.far_distance if it does not; the
    edge there). away [R, P, 2] m: the way to the centres; along [R, 2]: directions of length 1."""
    normal, distance = faces
    enters = jnp.full(away.shape[:2], -C.far_distance, away.dtype)
    leaves = jnp.full(away.shape[:2], C.far_distance, away.dtype)
    face = jnp.zeros(away.shape[:2], jnp.int32)
    for k in range(normal.shape[1]):  # at most 8: no array has an axis for them
        n = normal[None, :, k]
        above = -distance[None, :, k] - vec2.dot(n, away)  # m that the ray starts above the edge's line
        rate = vec2.dot(n, along[:, None])
        crossed = -above / jnp.where(rate == 0, 1, rate)
        later = (rate < 0) & (crossed > enters)
        enters, face = jnp.where(later, crossed, enters), jnp.where(later, k, face)
        leaves = jnp.where((rate > 0) & (crossed < leaves), crossed, leaves)
        leaves = jnp.where((rate == 0) & (above > 0), -C.far_distance, leaves)  # it runs beside the polygon
    return jnp.where(enters <= leaves, enters, -C.far_distance), face


def _reach_circles(radius: jax.Array, away: jax.Array, along: jax.Array) -> jax.Array:
    """Distance [R, C] m at which each ray enters each disc, below zero if it does not. Arguments as above."""
    beside = vec2.cross(away, along[:, None])
    half_chord_squared = (radius - beside) * (radius + beside)
    reach = vec2.dot(away, along[:, None]) - vec2.sqrt_or_zero(half_chord_squared)
    return jnp.where(half_chord_squared >= 0, reach, -C.far_distance)


def _normal_of_hit(
    faces: tuple[jax.Array, jax.Array],
    face: jax.Array,
    shape: jax.Array,
    away: jax.Array,
    along: jax.Array,
    distance: jax.Array,
) -> jax.Array:
    """[R, 2] outward normal where each ray meets its shape."""
    rays, num_polygons = np.arange(shape.shape[0]), face.shape[1]
    from_centre = along * distance[:, None] - away[rays, shape]
    of_circle = vec2.unit_or_zero(from_centre)
    if num_polygons == 0:
        return of_circle
    polygon = jnp.minimum(shape, num_polygons - 1)
    of_polygon = faces[0][polygon, face[rays, polygon]]
    return jnp.where((shape < num_polygons)[:, None], of_polygon, of_circle)


# Arguments


def _check_worlds(scene: Scene, state: Any) -> tuple[tuple[int, ...], np.dtype]:
    """The batch shape of scene and state, () or (W,), and the precision that is computed in."""
    check_type("scene", scene, Scene)
    batch, num_shapes = np.shape(scene.gravity)[:-1], np.shape(scene.shapes.active)[-1]
    if len(batch) > 1:
        raise ValueError(f"scene has batch shape {batch}; fold batches into one leading world axis, or use jax.vmap")
    for name, trailing in (("position", (num_shapes, 2)), ("angle", (num_shapes,))):
        if not hasattr(state, name):
            raise TypeError(f"state is of type {type(state).__name__}, without {name}; give a State of the scene")
        shape = np.shape(getattr(state, name))
        if shape != (*batch, *trailing):
            raise ValueError(f"state.{name} has shape {shape}; this scene needs {(*batch, *trailing)}")
    return batch, jnp.result_type(state.position, jnp.float32)


def _points(name: str, x: Array, batch: tuple[int, ...], dtype: np.dtype) -> jax.Array:
    if x is None:
        raise TypeError(f"{name} is None; give points in metres, an array [R, 2]")
    check_real(name, x)
    x = jnp.asarray(x, dtype)
    if x.ndim != len(batch) + 2 or x.shape[: len(batch)] != batch or x.shape[-1] != 2:
        wanted = f"[{', '.join([*map(str, batch), 'R', '2'])}]"
        raise ValueError(f"{name} have shape {x.shape}; worlds of this scene need {wanted}")
    return x


def _seen(scene: Scene, ignore: Array | None, batch: tuple[int, ...], num_rays: int) -> jax.Array:
    """[*batch, R, n] bool, shapes that each ray can meet."""
    active = jnp.asarray(scene.shapes.active)[..., None, :]
    shape = (*batch, num_rays, active.shape[-1])
    if ignore is None:
        return jnp.broadcast_to(active, shape)
    ignore = jnp.asarray(ignore)
    if ignore.dtype != bool or ignore.shape not in {shape, shape[-2:], shape[-1:]}:
        whole = f", {list(shape)}" if batch else ""
        raise ValueError(
            f"ignore is {ignore.dtype} of shape {ignore.shape}; give bool of shape {list(shape[-1:])} for all rays"
            f"{whole} or {list(shape[-2:])} for each"
        )
    return jnp.broadcast_to(active & ~ignore, shape)
