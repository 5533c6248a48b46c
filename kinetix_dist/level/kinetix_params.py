"""The parameters of a public level file: those of the 74 public ones, and what other values mean here.

A level is data, and most parameters say how the package plays it. Units are part of the level: a file with others is
refused. Settings of the package's solver, its frame skip and its time limit are not read, since whoever plays a level
here gives his own; where they are not the usual ones that is noted. The rest is about pictures and sizes of arrays.
"""

from __future__ import annotations

import math
from typing import Any

from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS
from kinetix_dist.level.structure import LevelFormatError, number_problems, raise_first

# What numbers of a level mean: a level of other units would move otherwise here.
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
    """Raises `LevelFormatError` for parameters with which the level is not what it would be here."""
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
    """What else the file would be played with, of a document that `check_params` passed."""
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
    raise_first(number_problems(value, path))
    return math.isclose(value, usual, rel_tol=_SMALLEST_RELATIVE_DIFFERENCE)
