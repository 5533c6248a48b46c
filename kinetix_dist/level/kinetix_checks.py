"""Checks that a public level file can be read without loss. A complaint is one line: field, problem, remedy.

Only fields that `kinetix_format.py` reads are checked: a file may hold anything in slots that are not active and in
its caches of impulses. What files here cannot hold is refused: units of another size, walls elsewhere but for the two
kinds that `kinetix_walls.py` mends.
"""

from __future__ import annotations

import math
from typing import Any

from kinetix_dist.level.kinetix_walls import PublicWalls, check_nothing_falls_out, read_walls
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, Role
from kinetix_dist.level.structure import LevelFormatError, raise_first, size_problem, value_problems
from kinetix_dist.level.walls import COLLIDES_WITH_ALL

VERSION = "kinetix-env 3.0.2"
_EXPORT_AGAIN = f"this file is of another version; write it again with {VERSION}"

_SHAPE_FIELDS = (
    "position", "rotation", "velocity", "angular_velocity", "inverse_mass", "friction", "restitution", "density",
    "role", "collision_mode",
)  # fmt: skip
_JOINT_FIELDS = (
    "a_index", "b_index", "a_relative_pos", "b_relative_pos", "is_fixed_joint", "rotation", "motor_on", "motor_speed",
    "motor_power", "motor_has_joint_limits", "min_rotation", "max_rotation", "motor_binding",
)  # fmt: skip
_THRUSTER_FIELDS = ("object_index", "relative_position", "rotation", "power", "thruster_binding")
_FLAGS = ("is_fixed_joint", "motor_on", "motor_has_joint_limits")
_PAIRS = ("position", "velocity", "a_relative_pos", "b_relative_pos", "relative_position")


def check_kinetix(document: dict[str, Any]) -> PublicWalls:
    """Walls of a public document. Raises `LevelFormatError` for the first reason why the document cannot be read."""
    if (too_large := size_problem(document)) is not None:
        raise too_large
    state = document["env_state"]
    if not isinstance(state, dict):
        raise LevelFormatError("env_state", f"is {type(state).__name__}", _EXPORT_AGAIN)
    shapes = {}
    for kind in ("polygon", "circle"):
        form = ("n_vertices", "vertices") if kind == "polygon" else ("radius",)
        rows = _active_rows(state, kind, (*_SHAPE_FIELDS, *form))
        for path, shape in rows.values():
            _check_choice(shape["role"], len(Role), f"{path}.role")
            _check_choice(shape["collision_mode"], COLLIDES_WITH_ALL + 1, f"{path}.collision_mode")
            if shape["density"] <= 0:
                raise LevelFormatError(f"{path}.density", f"is {shape['density']}", "give more than 0")
            if kind == "circle" and shape["radius"] <= 0:
                raise LevelFormatError(f"{path}.radius", f"is {shape['radius']}", "give more than 0")
        shapes[kind] = rows
    num_polygons = len(state["polygon"])
    slots = {*shapes["polygon"], *(num_polygons + slot for slot in shapes["circle"])}
    for path, shape in shapes["polygon"].values():
        _check_corners(shape, path)
    walls = read_walls(shapes["polygon"])
    for rows in shapes.values():
        check_nothing_falls_out(rows, walls)
    for path, joint in _active_rows(state, "joint", _JOINT_FIELDS).values():
        for end in ("a_index", "b_index"):
            _check_shape(joint[end], f"{path}.{end}", slots)
        if joint["a_index"] == joint["b_index"]:
            raise LevelFormatError(f"{path}.b_index", "joins a shape to itself", "name another shape")
        _check_choice(joint["motor_binding"], NUM_MOTOR_COLOURS, f"{path}.motor_binding")
        _check_flag(joint.get("motor_auto", False), f"{path}.motor_auto")
    for path, thruster in _active_rows(state, "thruster", _THRUSTER_FIELDS).values():
        _check_shape(thruster["object_index"], f"{path}.object_index", slots)
        _check_choice(thruster["thruster_binding"], NUM_THRUSTER_COLOURS, f"{path}.thruster_binding")
    if "gravity" not in state:
        raise LevelFormatError("env_state.gravity", "is missing", _EXPORT_AGAIN)
    _check_pair(state["gravity"], "env_state.gravity")
    check_params(document)
    return walls


def _active_rows(state: dict[str, Any], part: str, fields: tuple[str, ...]) -> dict[int, tuple[str, dict[str, Any]]]:
    """Slot -> (path, row) of the active ones, which have all fields with numbers that are finite."""
    if not isinstance(state.get(part), list):
        raise LevelFormatError(f"env_state.{part}", "is missing or no list", _EXPORT_AGAIN)
    rows = {}
    for slot, row in enumerate(state[part]):
        path = f"env_state.{part}[{slot}]"
        if not isinstance(row, dict) or "active" not in row:
            raise LevelFormatError(f"{path}.active", "is missing", _EXPORT_AGAIN)
        _check_flag(row["active"], f"{path}.active")
        if not row["active"]:
            continue
        for field in fields:
            if field not in row:
                raise LevelFormatError(f"{path}.{field}", "is missing", _EXPORT_AGAIN)
            if field in _PAIRS:
                _check_pair(row[field], f"{path}.{field}")
            elif field == "vertices":
                raise_first(value_problems(row[field], f"{path}.{field}"))
            elif field in _FLAGS:
                _check_flag(row[field], f"{path}.{field}")
            else:
                _check_number(row[field], f"{path}.{field}")
        rows[slot] = (path, row)
    return rows


def _check_flag(value: Any, path: str) -> None:
    if value not in (True, False):  # also 1 and 0
        raise LevelFormatError(path, f"is {value!r}", "use true or false")


def _check_number(value: Any, path: str) -> None:
    if not isinstance(value, int | float):
        raise LevelFormatError(path, f"is {value!r}", "give a number")
    raise_first(value_problems(value, path))


def _check_pair(value: Any, path: str) -> None:
    if not isinstance(value, dict) or not {"0", "1"} <= set(value):
        raise LevelFormatError(path, "is no pair of numbers", _EXPORT_AGAIN)
    for axis in "01":
        _check_number(value[axis], f"{path}.{axis}")


def _check_choice(value: Any, count: int, path: str) -> None:
    if value not in range(count):
        raise LevelFormatError(path, f"is {value!r}", f"use 0 to {count - 1}")


def _check_shape(index: Any, path: str, slots: set[int]) -> None:
    if index not in slots:
        raise LevelFormatError(path, f"there is no shape {index!r}", f"active shapes are {sorted(slots)}")


def _check_corners(shape: dict[str, Any], path: str) -> None:
    count, corners = shape["n_vertices"], shape["vertices"]
    if not isinstance(count, int) or count < 3:
        raise LevelFormatError(f"{path}.n_vertices", f"is {count!r}", "a polygon has 3 corners or more")
    for corner in range(count):
        if not isinstance(corners, dict) or str(corner) not in corners:
            raise LevelFormatError(f"{path}.vertices.{corner}", "is missing", _EXPORT_AGAIN)
        _check_pair(corners[str(corner)], f"{path}.vertices.{corner}")


# Units of the numbers of a level: a level of other units would move differently.
UNITS = {
    "dt": 1 / 60,
    "base_motor_speed": 6.0,
    "base_motor_power": 900.0,
    "base_thruster_power": 10.0,
    "base_friction": 0.4,
}
_SOLVER = {
    "slop": 0.01,
    "baumgarte_coefficient_joints_v": 2.0,
    "baumgarte_coefficient_joints_p": 0.7,
    "baumgarte_coefficient_fjoint_av": 2.0,
    "baumgarte_coefficient_rjoint_limit_av": 5.0,
    "baumgarte_coefficient_collision": 0.2,
    "joint_stiffness": 0.6,
    "clip_position": 15,
    "clip_velocity": 100,
    "clip_angular_velocity": 50,
    "motor_decay_coefficient": 0.1,
    "motor_joint_limit": 0.1,
}
_STATIC_SOLVER = {"num_solver_iterations": 10, "do_warm_starting": True}
_EPISODE = {"max_timesteps": 256}
_STATIC_EPISODE = {"frame_skip": 2}
_OPTION_OF = {"max_timesteps": "--env.max_steps", "frame_skip": "--env.frame_skip"}
_SMALLEST_RELATIVE_DIFFERENCE = 1e-5  # float32 that went through JSON


def public_params() -> dict[str, Any]:
    """`env_params` of a file that is written."""
    shown = {"pixels_per_unit": 100, "dense_reward_scale": 0.1, "num_shape_roles": 4}
    return {**UNITS, **_SOLVER, **_EPISODE, **shown}


def public_static_params(polygons: int, circles: int, joints: int, thrusters: int) -> dict[str, Any]:
    """`static_env_params` of a file that is written."""
    return {
        "num_polygons": polygons,
        "num_circles": circles,
        "num_joints": joints,
        "num_thrusters": thrusters,
        "max_polygon_vertices": 4,
        **_STATIC_SOLVER,
        "solver_batch_size": 16,
        "num_static_fixated_polys": NUM_WALLS,
        "screen_dim": {"0": 500, "1": 500},
        "downscale": 4,
        **_STATIC_EPISODE,
        "max_shape_size": 2,
        "num_motor_bindings": NUM_MOTOR_COLOURS,
        "num_thruster_bindings": NUM_THRUSTER_COLOURS,
    }


def check_params(document: dict[str, Any]) -> None:
    """Raises `LevelFormatError` for units or walls other than ours."""
    params, static = _params(document, "env_params"), _params(document, "static_env_params")
    for name, usual in UNITS.items():
        if name in params and not _is_usual(params[name], usual, f"env_params.{name}"):
            raise LevelFormatError(
                f"env_params.{name}", f"is {params[name]}", f"levels here are played with {usual:.6g}; scale the level"
            )
    walls = static.get("num_static_fixated_polys", NUM_WALLS)
    if walls != NUM_WALLS:
        raise LevelFormatError(
            "static_env_params.num_static_fixated_polys",
            f"is {walls!r}",
            f"levels here have {NUM_WALLS} walls, the first polygons: floor, left wall, right wall, ceiling",
        )


def param_notes(document: dict[str, Any]) -> list[str]:
    """Unusual settings of a document that `check_params` passed, a phrase each."""
    notes, unread = [], []
    for part, usual_values in (
        ("env_params", _EPISODE | _SOLVER),
        ("static_env_params", _STATIC_EPISODE | _STATIC_SOLVER),
    ):
        params = _params(document, part)
        for name, usual in usual_values.items():
            if name not in params or _is_usual(params[name], usual, f"{part}.{name}"):
                continue
            if name in _OPTION_OF:
                notes.append(f"{name} {params[name]} is not read (here {usual}, or {_OPTION_OF[name]})")
            else:
                unread.append(f"{name} {params[name]}")
    if unread:
        notes.append(f"solver settings of the package are not read: {', '.join(unread)}")
    return notes


def _params(document: dict[str, Any], part: str) -> dict[str, Any]:
    """Parameters by name. The web editor's gallery writes the name of a size, or wraps them."""
    params = document.get(part, {})
    if isinstance(params, dict) and params.get("type") == "size":
        return {}
    if isinstance(params, dict) and params.get("type") == "full":
        params = params.get("params")
    if not isinstance(params, dict):
        raise LevelFormatError(part, f"is {type(params).__name__}", "this file is of another version; give an object")
    return params


def _is_usual(value: Any, usual: float, path: str) -> bool:
    if not isinstance(value, int | float):
        raise LevelFormatError(path, f"is {value!r}", "give a number")
    raise_first(value_problems(value, path))
    return math.isclose(value, usual, rel_tol=_SMALLEST_RELATIVE_DIFFERENCE)
