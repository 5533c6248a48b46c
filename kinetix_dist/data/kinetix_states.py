"""States of the public Kinetix package, as arrays, in this project's: levels, and what moves in them.

Levels go through the reader of public level files (`level.kinetix_format`), which checks them, mends walls, moves
frames of polygons onto their centroids and computes masses. Positions and velocities of a trajectory are moved along:
a point that lies d from the package's origin of a shape has the velocity v + w x d.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jax2d.scene import pack_bits
from kinetix_dist.env.observations import Moving
from kinetix_dist.level.kinetix_format import import_kinetix
from kinetix_dist.level.level import NUM_WALLS, Level

_ROLES = {"polygon": "polygon_shape_roles", "circle": "circle_shape_roles"}
_DENSITIES = {"polygon": "polygon_densities", "circle": "circle_densities"}
_CEILING = 3  # slot
# A random level of the package has the first corner of the ceiling there, outside of the box; its level files do not.
_CORNER_OF_CEILING, _MENDED_CORNER = (5.0, 5.2), (2.5, 5.2)  # m
_PAIRS = ("position", "velocity", "a_relative_pos", "b_relative_pos", "relative_position")
State = Mapping[str, np.ndarray]  # leaves of the package's EnvState by their paths, without leading axes


def level_of(state: State) -> Level:
    """Level (numpy) that an episode begins with. Raises `LevelFormatError` as the reader of public files does."""
    return import_kinetix({"env_state": _document(state)})


def capacity_counts(state: State) -> dict[str, int]:
    """Slots of a state, with any leading axes."""
    counts = {"polygons": "polygon/active", "circles": "circle/active", "joints": "joint/active"}
    return {name: state[field].shape[-1] for name, field in (counts | {"thrusters": "thruster/active"}).items()}


def _document(state: State) -> dict[str, Any]:
    """The state as a public level file has it; see `kinetix_checks` for what is read of it.

    The ceiling of random levels gets the corner that public level files have.
    """
    parts: dict[str, Any] = {"gravity": _pair(state["gravity"])}
    for part in ("polygon", "circle"):
        rows = _rows(state, part)
        roles, densities = state[_ROLES[part]].tolist(), state[_DENSITIES[part]].tolist()
        parts[part] = [row | {"role": role, "density": d} for row, role, d in zip(rows, roles, densities, strict=True)]
    ceiling = parts["polygon"][_CEILING]["vertices"]
    if np.allclose(list(ceiling["0"].values()), _CORNER_OF_CEILING, atol=1e-4):
        ceiling["0"] = _pair(np.array(_MENDED_CORNER))
    bindings, auto = state["motor_bindings"].tolist(), state["motor_auto"].tolist()
    parts["joint"] = [
        row | {"motor_binding": binding, "motor_auto": bool(runs)}
        for row, binding, runs in zip(_rows(state, "joint"), bindings, auto, strict=True)
    ]
    parts["thruster"] = [
        row | {"thruster_binding": binding}
        for row, binding in zip(_rows(state, "thruster"), state["thruster_bindings"].tolist(), strict=True)
    ]
    return parts


def _rows(state: State, part: str) -> list[dict[str, Any]]:
    """Rows of a part, one for each slot."""
    fields = {name.removeprefix(f"{part}/"): array for name, array in state.items() if name.startswith(f"{part}/")}
    columns = {name: [_value(name, value) for value in array] for name, array in fields.items()}
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _value(name: str, value: np.ndarray) -> Any:
    if name in _PAIRS:
        return _pair(value)
    if name == "vertices":
        return {str(i): _pair(corner) for i, corner in enumerate(value)}
    return value.item()


def _pair(value: np.ndarray) -> dict[str, float]:
    return {"0": float(value[0]), "1": float(value[1])}


def moving_of(states: State, levels: Level) -> Moving:
    """States [N, T, ...] of trajectories on levels [N, ...], as [N * T, ...] numpy arrays that observations are of.

    The first state of a trajectory is the one that its level was read from. Walls stand where those of the level do.
    """
    position, velocity = _of_shapes(states, "position"), _of_shapes(states, "velocity")
    angle, spin = _of_shapes(states, "rotation"), _of_shapes(states, "angular_velocity")
    # Centroid of a shape from the package's origin of it, in the frame of the shape: zero for most.
    shift = _rotated(levels.position - position[:, 0], -angle[:, 0])
    offset = _rotated(np.broadcast_to(shift[:, None], position.shape), angle)
    position = position + offset
    velocity = velocity + spin[..., None] * np.stack([-offset[..., 1], offset[..., 0]], axis=-1)
    active = levels.scene.shapes.active[:, None]
    is_wall = np.arange(active.shape[-1]) < NUM_WALLS
    still = {"position": levels.position, "angle": levels.angle, "velocity": 0 * levels.velocity}
    moved = {"position": position, "angle": angle, "velocity": velocity, "angular_velocity": spin}
    still["angular_velocity"] = 0 * levels.angular_velocity
    flat = {}
    for name, array in moved.items():
        extra = (1,) * (array.ndim - 3)
        array = np.where(active.reshape(*active.shape, *extra), array, 0)
        array = np.where(is_wall.reshape(-1, *extra), still[name][:, None], array).astype(np.float32)
        flat[name] = array.reshape(-1, *array.shape[2:])
    touching = touch_matrix_of(states) & levels.scene.shapes.can_touch[:, None]
    words = np.asarray(pack_bits(touching.reshape(-1, *touching.shape[2:])))
    return Moving(touching=words, has_stepped=(states["timestep"] > 0).reshape(-1), **flat)


def touch_matrix_of(states: State) -> np.ndarray:
    """[..., n, n] bool, symmetric: pairs whose contact was active in the physics step that led to a state.

    Pairs of the package's manifolds, in its order: polygons i < j but for two walls, circle and polygon with the
    polygon running faster, circles i < j.
    """
    polygons, circles = states["polygon/active"].shape[-1], states["circle/active"].shape[-1]
    pairs = {
        "rr": [(i, j) for i in range(polygons) for j in range(i + 1, polygons) if j >= NUM_WALLS],
        "cr": [(polygons + c, p) for c in range(circles) for p in range(polygons)],
        "cc": [(polygons + i, polygons + j) for i in range(circles) for j in range(i + 1, circles)],
    }
    leading = states["timestep"].shape
    touching = np.zeros((*leading, polygons + circles, polygons + circles), bool)
    for kind, slots in pairs.items():
        if not slots:
            continue
        active = states[f"acc_{kind}_manifolds/active"].astype(bool)
        if kind == "rr":  # two points of a pair of polygons
            active = active.any(axis=-1)
        a, b = np.array(slots).T
        touching[..., a, b] = touching[..., b, a] = active
    return touching


def same_level(state: State, other: State) -> np.ndarray:
    """[...] bool: two states, or batches of them, are the same in all that a level is made of."""
    leading = state["timestep"].ndim
    result = np.ones(state["timestep"].shape, bool)
    for name in state:
        if name != "timestep" and not name.startswith("acc_"):
            equal = (state[name] == other[name]) | ((state[name] != state[name]) & (other[name] != other[name]))
            result &= equal.reshape(*equal.shape[:leading], -1).all(axis=-1)
    return result


def stacked(levels: list[Level]) -> Level:
    """[N, ...] of each level (numpy)."""
    return jax.tree.map(lambda *parts: np.stack(parts), *levels)


def _of_shapes(states: State, field: str) -> np.ndarray:
    """[..., n, ...] float64 of polygons, then circles."""
    return np.concatenate([states[f"{part}/{field}"] for part in ("polygon", "circle")], axis=2).astype(np.float64)


def _rotated(vector: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Vectors [..., 2] turned by angles [...]."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
