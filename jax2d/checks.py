"""What an engine takes: shapes, kinds and finite values of scenes, states and controls. One line an error.

Shapes and kinds are checked always; values only where they are known, that is outside of jit.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Capacity, Controls, Scene, State

# Dimensions by letter, as in the comments of `scene.Scene`; F floating, I integer, B bool.
SCENE_FIELDS = {
    "shape_active": "B n",
    "inverse_mass": "F n",
    "inverse_inertia": "F n",
    "density": "F n",
    "friction": "F n",
    "restitution": "F n",
    "vertices": "F P V 2",
    "num_vertices": "I P",
    "radius": "F C",
    "can_touch": "B n n",
    "joint_active": "B J",
    "joint_a": "I J",
    "joint_b": "I J",
    "joint_anchor_a": "F J 2",
    "joint_anchor_b": "F J 2",
    "joint_is_fixed": "B J",
    "joint_rest_angle": "F J",
    "motor_on": "B J",
    "motor_speed": "F J",
    "motor_power": "F J",
    "has_limits": "B J",
    "lower_limit": "F J",
    "upper_limit": "F J",
    "thruster_active": "B T",
    "thruster_body": "I T",
    "thruster_position": "F T 2",
    "thruster_angle": "F T",
    "thruster_power": "F T",
    "gravity": "F 2",
}
STATE_FIELDS = {
    "position": "F n 2",
    "angle": "F n",
    "velocity": "F n 2",
    "angular_velocity": "F n",
    "joint_impulse": "F J 5",
    "contact_key": "I K",
    "contact_impulse": "F K 2",
}
CONTROL_FIELDS = {"motor": "F J", "thruster": "F T"}
CONTROL_RANGES = {"motor": (-1.0, 1.0), "thruster": (0.0, 1.0)}

_MAY_BE_ANYTHING = {"contact_impulse"}  # slots without a key are never read
_KINDS = {"F": ("floating-point", np.floating), "I": ("integer", np.integer), "B": ("bool", np.bool_)}


def check_scene(scene: Scene, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    _check("scene", scene, SCENE_FIELDS, capacity, dtype, batch)


def check_state(state: State, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    _check("state", state, STATE_FIELDS, capacity, dtype, batch)


def check_controls(controls: Controls, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    _check("controls", controls, CONTROL_FIELDS, capacity, dtype, batch)
    for name, (low, high) in CONTROL_RANGES.items():
        if is_known(values := getattr(controls, name)):
            outside = ~((np.asarray(values) >= low) & (np.asarray(values) <= high))
            if outside.any():
                raise ValueError(
                    f"controls.{name}{_first(outside)} is {np.asarray(values)[outside][0]}; it must be from {low:g} to "
                    f"{high:g} (inside jit it is clamped and counted in Touching.invalid_controls)"
                )


def clamped_controls(controls: Controls) -> tuple[Controls, jax.Array]:
    """Controls within their ranges, NaN as 0, and how many were not, [W] int32."""
    clamped, invalid = {}, []
    for name, (low, high) in CONTROL_RANGES.items():
        values = jnp.asarray(getattr(controls, name))
        clamped[name] = jnp.where(jnp.isnan(values), 0, jnp.clip(values, low, high))
        invalid.append(jnp.sum(~((values >= low) & (values <= high)), axis=-1, dtype=jnp.int32))
    return Controls(**clamped), sum(invalid[1:], invalid[0])


def is_known(x: Array) -> bool:
    return not isinstance(x, jax.core.Tracer)


def _check(
    of: str, tree: Any, fields: dict[str, str], capacity: Capacity, dtype: np.dtype, batch: tuple[int, ...]
) -> None:
    sizes = {
        "n": capacity.shapes,
        "P": capacity.polygons,
        "V": capacity.vertices,
        "C": capacity.circles,
        "J": capacity.joints,
        "T": capacity.thrusters,
        "K": capacity.contact_slots,
        "2": 2,
        "5": 5,
    }
    assert set(fields) == {field.name for field in dataclasses.fields(tree)}
    for name, declared in fields.items():
        kind, *dimensions = declared.split()
        x = getattr(tree, name)
        x = x if hasattr(x, "dtype") else np.asarray(x)
        shape = (*batch, *(sizes[letter] for letter in dimensions))
        if x.shape != shape:
            raise ValueError(f"{of}.{name} has shape {x.shape}; this engine ({capacity}) needs {shape}")
        known_as, of_kind = _KINDS[kind]
        if not jnp.issubdtype(x.dtype, of_kind):
            raise ValueError(f"{of}.{name} is {x.dtype}; it must be {known_as}")
        if kind == "F" and x.dtype.itemsize > dtype.itemsize:
            raise ValueError(
                f"{of}.{name} is {x.dtype}, but this engine computes in {dtype}; cast it, or build the engine with "
                f"backend='xla', dtype={x.dtype}"
            )
        if kind == "F" and name not in _MAY_BE_ANYTHING and is_known(x) and not (finite := np.isfinite(x)).all():
            raise ValueError(f"{of}.{name}{_first(~finite)} is {np.asarray(x)[~finite][0]}; it must be finite")


def _first(mask: np.ndarray) -> str:
    """Index of the first True as [i, j]."""
    return f"[{', '.join(map(str, np.argwhere(mask)[0]))}]"
