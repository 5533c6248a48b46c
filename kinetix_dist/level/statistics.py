"""Statistics of a batch of levels: shares of yes-or-no properties, and distributions of numbers.

    found = statistics(levels)
    compare(found, reference)      # where two batches differ by more than chance

Used to hold the random generator against the public package, whose levels tests/level/data describes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, JointKind
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, ROLE_NAMES, Level, Role
from kinetix_dist.level.overlap import separation, surface_distance, world_corners

NUM_POINTS = 19  # at which a distribution is described
_EPSILON = 1e-4  # numbers so close are one: float32 rounds the same value differently on two ways
_MAX_COUNT = 8  # "8 or more" in histograms


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share:
    """`hits` of `total`."""

    hits: int
    total: int

    @property
    def value(self) -> float:
        return self.hits / self.total if self.total else math.nan


@dataclasses.dataclass(frozen=True, kw_only=True)
class Distribution:
    """Shares of `total` numbers that are not larger than each of `points`."""

    points: tuple[float, ...]
    shares: tuple[float, ...]
    total: int


Statistics = dict[str, Share | np.ndarray]


def statistics(levels: Level) -> Statistics:
    """Shares, and samples of numbers, by name. `levels`: a batch, [W, ...] on every field."""
    levels = jax.tree.map(np.asarray, levels)
    return {**_of_shapes(levels), **_of_joints(levels), **_of_thrusters(levels)}


def describe(found: Statistics) -> dict[str, Any]:
    """Statistics as JSON types, numbers as distributions."""
    texts: dict[str, Any] = {}
    for name, value in found.items():
        if isinstance(value, Share):
            texts[name] = [value.hits, value.total]
        elif len(value):
            points = np.unique(np.quantile(value, np.linspace(0, 1, NUM_POINTS + 2)[1:-1], method="nearest"))
            points = [float(f"{point:.6g}") for point in points]
            shares = [round(float(np.mean(value <= point + _EPSILON)), 6) for point in points]
            texts[name] = {"points": points, "shares": shares, "total": len(value)}
    return texts


def read(texts: Mapping[str, Any]) -> dict[str, Share | Distribution]:
    """The inverse of `describe`."""
    return {
        name: Share(hits=value[0], total=value[1])
        if isinstance(value, list)
        else Distribution(points=tuple(value["points"]), shares=tuple(value["shares"]), total=value["total"])
        for name, value in texts.items()
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """One statistic of two batches. deviation: in standard errors of the difference (the largest, of distributions)."""

    name: str
    ours: float
    theirs: float
    deviation: float


def compare(found: Statistics, reference: Mapping[str, Share | Distribution]) -> list[Comparison]:
    """Every statistic of both; a distribution at the point where the two are farthest apart.

    Raises ValueError where one has statistics that the other lacks.
    """
    samples = {name for name, value in found.items() if isinstance(value, Share) or len(value)}
    if lacking := samples ^ set(reference):
        raise ValueError(f"only one of the two has {', '.join(sorted(lacking))}")
    rows = []
    for name, theirs in reference.items():
        ours = found[name]
        if isinstance(theirs, Share):
            assert isinstance(ours, Share)
            rows.append(_compare_shares(name, ours.value, ours.total, theirs.value, theirs.total))
        else:
            assert isinstance(ours, np.ndarray)
            rows.append(
                max(
                    (
                        _compare_shares(name, float(np.mean(ours <= point + _EPSILON)), len(ours), share, theirs.total)
                        for point, share in zip(theirs.points, theirs.shares, strict=True)
                    ),
                    key=lambda row: row.deviation,
                )
            )
    return rows


def _compare_shares(name: str, ours: float, num_ours: int, theirs: float, num_theirs: int) -> Comparison:
    if not num_ours or not num_theirs:
        return Comparison(name=name, ours=ours, theirs=theirs, deviation=0.0 if num_ours == num_theirs else math.inf)
    # With half a hit and half a miss added, so that shares of 0 and 1 have an error too.
    total = num_ours + num_theirs
    pooled = (ours * num_ours + theirs * num_theirs + 0.5) / (total + 1.0)
    error = math.sqrt(pooled * (1.0 - pooled) * (1.0 / num_ours + 1.0 / num_theirs))
    return Comparison(name=name, ours=ours, theirs=theirs, deviation=abs(ours - theirs) / error)


def _share(hits: np.ndarray | np.bool) -> Share:
    return Share(hits=int(np.sum(hits)), total=int(np.size(hits)))


def _histogram(name: str, counts: np.ndarray, largest: int) -> Statistics:
    """`name 0`, `name 1`, ...: shares of levels with so many."""
    largest = min(largest, _MAX_COUNT)
    return {f"{name} {k}": _share(np.minimum(counts, largest) == k) for k in range(largest + 1)}


def _mass(levels: Level) -> np.ndarray:
    """[W, n] kg of moving shapes, inf of fixed ones."""
    inverse = levels.scene.shapes.inverse_mass
    return np.where(inverse > 0, 1.0 / np.where(inverse > 0, inverse, 1.0), np.inf)


def _half_extents(levels: Level) -> np.ndarray:
    """[W, P, 2] m, of boxes: of a corner's coordinates."""
    return np.abs(levels.scene.shapes.vertices[:, :, 0])


def _of_shapes(levels: Level) -> Statistics:
    shapes, capacity = levels.scene.shapes, capacity_of(levels)
    polygons, circles = capacity.polygons, capacity.circles
    active = shapes.active.copy()
    active[:, :NUM_WALLS] = False
    is_fixed = active & (shapes.inverse_mass == 0)
    role, floor = levels.shape_role, levels.shape_role[:, 0]
    num_polygons, num_circles = active[:, :polygons].sum(1), active[:, polygons:].sum(1)
    box = active[:, NUM_WALLS:polygons]
    half = _half_extents(levels)[:, NUM_WALLS:][box]
    found: Statistics = {
        **_histogram("polygons", num_polygons, polygons - NUM_WALLS),
        **_histogram("circles", num_circles, circles),
        **{f"floor is {ROLE_NAMES[r]}": _share(floor == r) for r in Role},
        "has red": _share((active & (role == Role.RED)).any(1)),
        "is fixed": _share(is_fixed[active]),
        "green is a polygon": _share((active & (role == Role.GREEN))[:, :polygons].any(1)),
        "half extents, smaller": half.min(axis=1),
        "half extents, larger": half.max(axis=1),
        "radius": shapes.radius[active[:, polygons:]],
        "angle": np.mod(levels.angle[active], 2 * math.pi),
    }
    for r in (Role.NONE, Role.GREEN, Role.BLUE, Role.RED):
        here = active & (role == r)
        found[f"{ROLE_NAMES[r]} is fixed"] = _share(is_fixed[here])
        found[f"{ROLE_NAMES[r]} x"], found[f"{ROLE_NAMES[r]} y"] = levels.position[here].T
    overlap = overlaps(levels)
    same_body = ~shapes.can_touch & ~np.eye(shapes.active.shape[1], dtype=bool) & ~_joined(levels)
    same_body &= active[:, :, None] & active[:, None, :] & ~(is_fixed[:, :, None] & is_fixed[:, None, :])
    walls_and_shapes = np.zeros_like(overlap)
    walls_and_shapes[:, :NUM_WALLS, NUM_WALLS:] = True
    both = active[:, :, None] & active[:, None, :]
    found |= {
        "overlap of shapes that may touch": _share((overlap & shapes.can_touch & both).any((1, 2))),
        "overlap with a wall": _share((overlap & walls_and_shapes).any((1, 2))),
        "overlap within a body, not joined to each other": _share((overlap & same_body).any((1, 2))),
    }
    return found


def _of_joints(levels: Level) -> Statistics:
    joints, polygons = levels.scene.joints, capacity_of(levels).polygons
    rows = np.arange(len(joints.a))[:, None]
    held = joints.active
    is_fixed = joints.kind == JointKind.FIXED
    hinge, welded = held & ~is_fixed, held & is_fixed
    has_circle = (joints.b >= polygons) | (joints.a >= polygons)
    pairs, wheels = hinge & ~has_circle, hinge & has_circle
    limited = pairs & joints.has_limits
    bend = levels.angle[rows, joints.b] - levels.angle[rows, joints.a] - joints.rest_angle
    mass = _mass(levels)
    half = _half_extents(levels)
    shown = {"a": (joints.a, joints.anchor_a), "b": (joints.b, joints.anchor_b)}
    is_free = levels.scene.thrusters.active.any(1)
    num_joints_at = np.zeros(levels.scene.shapes.active.shape, int)
    for body, _ in shown.values():
        np.add.at(num_joints_at, (np.broadcast_to(rows, body.shape)[held], body[held]), 1)
    wheel_radius = levels.scene.shapes.radius[rows, np.maximum(joints.b - polygons, 0)][wheels]
    narrow = half[rows, np.minimum(joints.a, polygons - 1)].min(-1)[wheels]
    found: Statistics = {
        **_histogram("hinges", hinge.sum(1), joints.a.shape[1]),
        **_histogram("fixed joints", welded.sum(1), joints.a.shape[1]),
        "no control at all": _share(~(hinge & joints.motor_on).any(1) & ~is_free),
        "joint of polygon and circle": _share(has_circle[held]),
        "fixed, of polygon and polygon": _share(welded[held & ~has_circle]),
        "fixed, of polygon and circle": _share(welded[held & has_circle]),
        "motor on, of hinges": _share(joints.motor_on[hinge]),
        "speed above zero, of polygon and polygon": _share((joints.motor_speed > 0)[pairs]),
        "speed above zero, of polygon and circle": _share((joints.motor_speed > 0)[wheels]),
        "speed, absolute": np.abs(joints.motor_speed[hinge]),
        "power, of polygon and polygon": joints.motor_power[pairs],
        "power, of polygon and circle": joints.motor_power[wheels],
        "limits, of polygon and polygon": _share(joints.has_limits[pairs]),
        "limits, of polygon and circle": _share(joints.has_limits[wheels]),
        "outside limits at the start": _share(((bend < joints.lower_limit) | (bend > joints.upper_limit))[limited]),
        "span of limits": (joints.upper_limit - joints.lower_limit)[limited],
        "bend at the start, absolute": np.abs(bend[hinge]),
        "joined to a wall": _share((held & (np.minimum(joints.a, joints.b) < NUM_WALLS)).any(1)),
        "circle has a joint": _share(
            (num_joints_at > 0)[:, polygons:][levels.scene.shapes.active[:, polygons:]],
        ),
        "circle sticks out of the narrow side": _share(narrow + 0.05 < wheel_radius),
        **{f"motor colour {k}": _share(levels.motor_colour[hinge] == k) for k in range(NUM_MOTOR_COLOURS)},
    }
    mass_a, mass_b = mass[rows, joints.a], mass[rows, joints.b]
    # Which of two polygons is a follows their slots here: they are compared as the heavier and the lighter one.
    for name, these, over, under in (
        ("polygon", pairs, np.maximum(mass_a, mass_b), np.minimum(mass_a, mass_b)),
        ("circle", wheels, mass_a, mass_b),
    ):
        movable = these & np.isfinite(over) & np.isfinite(under)
        found[f"mass ratio, of polygon and {name}"] = over[movable] / under[movable]
    for end, (body, anchor) in shown.items():
        on_polygon = held & (body < polygons) & (body >= NUM_WALLS)
        extent = half[rows, np.minimum(body, polygons - 1)]
        found[f"anchor on {end} over half extent"] = np.abs(anchor / np.where(extent > 0, extent, 1.0))[
            on_polygon
        ].ravel()
    return found


def _of_thrusters(levels: Level) -> Statistics:
    thrusters, polygons = levels.scene.thrusters, capacity_of(levels).polygons
    active = thrusters.active
    rows = np.arange(len(active))[:, None]
    carrier_role = levels.shape_role[rows, thrusters.body]
    joints = levels.scene.joints
    is_end = (joints.a[:, None] == thrusters.body[..., None]) | (joints.b[:, None] == thrusters.body[..., None])
    on_jointed = (is_end & joints.active[:, None]).any(-1)
    position, angle = thrusters.position, thrusters.angle
    length = np.linalg.norm(position, axis=-1)
    away = (np.cos(angle) * position[..., 0] + np.sin(angle) * position[..., 1]) / np.maximum(length, 1e-9)
    on_circle = active & (thrusters.body >= polygons)
    radius = levels.scene.shapes.radius[rows, np.maximum(thrusters.body - polygons, 0)]
    return {
        **_histogram("thrusters", active.sum(1), active.shape[1]),
        **{f"thruster on {ROLE_NAMES[r]}": _share(carrier_role[active] == r) for r in Role},
        "thruster on a polygon": _share(thrusters.body[active] < polygons),
        "thruster on a jointed shape": _share(on_jointed[active]),
        "thruster pushes outwards": _share(away[active] > 1 - 1e-5),
        "thruster pushes inwards": _share(away[active] < -1 + 1e-5),
        "thruster power over mass": (thrusters.power * levels.scene.shapes.inverse_mass[rows, thrusters.body])[active],
        "thruster at share of radius": (length / np.where(radius > 0, radius, 1.0))[on_circle],
        **{f"thruster colour {k}": _share(levels.thruster_colour[active] == k) for k in range(NUM_THRUSTER_COLOURS)},
    }


def _joined(levels: Level) -> np.ndarray:
    """[W, n, n] bool: the two are ends of one joint."""
    joints = levels.scene.joints
    joined = np.zeros(levels.scene.shapes.can_touch.shape, bool)
    rows = np.broadcast_to(np.arange(len(joints.a))[:, None], joints.a.shape)
    for a, b in ((joints.a, joints.b), (joints.b, joints.a)):
        joined[rows[joints.active], a[joints.active], b[joints.active]] = True
    return joined


def separations(level: Level) -> Array:
    """[n, n] m, of all pairs of shapes of one level, active or not: negative where they overlap. Pure."""
    corners, radius = _corners_and_radii(level)
    against = jax.vmap(separation, in_axes=(None, None, 0, 0))
    return jax.vmap(lambda own, r: against(own, r, corners, radius))(corners, radius)


def own_corners(level: Level) -> tuple[Array, Array]:
    """[n, V, 2] corners, each in the frame of its shape, and [n] radii: of a polygon 0, of a circle the corners are."""
    shapes, capacity = level.scene.shapes, capacity_of(level)
    vertices = jnp.concatenate([shapes.vertices, jnp.zeros((capacity.circles, capacity.vertices, 2), jnp.float32)])
    radius = jnp.concatenate([jnp.zeros(capacity.polygons, jnp.float32), shapes.radius])
    return vertices, radius


def _corners_and_radii(level: Level) -> tuple[Array, Array]:
    """[n, V, 2] corners in the world and [n] radii, as `separation` takes them."""
    vertices, radius = own_corners(level)
    return world_corners(jnp.asarray(level.position), jnp.asarray(level.angle), vertices), radius


def point_distances(level: Level, point: Array) -> Array:
    """[n] m, of a point of the world [2] from all shapes of one level, active or not: negative inside. Pure."""
    corners, radius = _corners_and_radii(level)
    at = jnp.broadcast_to(jnp.asarray(point, corners.dtype), corners.shape[1:])
    return jax.vmap(surface_distance, in_axes=(0, 0, None, None))(corners, radius, at, 0.0)


def overlaps(levels: Level) -> np.ndarray:
    """[W, n, n] bool: which active shapes overlap, each pair once (the lower slot first)."""

    def of_level(level: Level) -> jax.Array:
        gap, active = separations(level), jnp.asarray(level.scene.shapes.active)
        return (gap < 0.0) & active[:, None] & active[None, :] & jnp.triu(jnp.ones_like(gap, dtype=bool), 1)

    return np.asarray(jax.jit(jax.vmap(of_level))(levels))
