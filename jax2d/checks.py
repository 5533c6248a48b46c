"""What an engine takes: shapes, kinds and values of scenes, states and controls. One line an error.

Shapes and kinds are checked always; values only where they are known, that is outside of jit.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Capacity, Controls, Scene, State
from jax2d.scene_rules import SCENE_RULES

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
_FIELDS = {Scene: SCENE_FIELDS, State: STATE_FIELDS, Controls: CONTROL_FIELDS}
CONTROL_RANGES = {"motor": (-1.0, 1.0), "thruster": (0.0, 1.0)}

_KINDS = {"F": ("floating-point", np.floating), "I": ("integer", np.integer), "B": ("bool", np.bool_)}


def check_scene(scene: Scene, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("scene", scene, capacity, dtype, batch)
    for name, declared in SCENE_FIELDS.items():
        if declared.startswith("F"):
            _check_finite(f"scene.{name}", getattr(scene, name))
    for fields, holds, must in SCENE_RULES:
        given = [getattr(scene, name) for name in fields]
        if all(map(is_known, given)) and not (fine := holds(*map(np.asarray, given))).all():
            value = np.asarray(given[0])[~fine][0].tolist()
            raise ValueError(f"scene.{fields[0]}{_first(~fine)} is {value}; it must {must}")


def check_state(state: State, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("state", state, capacity, dtype, batch)
    for name, declared in STATE_FIELDS.items():
        if declared.startswith("F") and name != "contact_impulse":
            _check_finite(f"state.{name}", getattr(state, name))
    if is_known(state.contact_key):  # slots without a key are never read
        _check_finite("state.contact_impulse", state.contact_impulse, np.asarray(state.contact_key)[..., None] >= 0)


def check_controls(controls: Controls, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("controls", controls, capacity, dtype, batch)
    for name, (low, high) in CONTROL_RANGES.items():
        if is_known(values := getattr(controls, name)):
            outside = ~((np.asarray(values) >= low) & (np.asarray(values) <= high))
            if outside.any():
                raise ValueError(
                    f"controls.{name}{_first(outside)} is {np.asarray(values)[outside][0]}; it must be from {low:g} to "
                    f"{high:g} (inside jit it is clamped and counted in Touching.invalid_controls)"
                )


def check_batches(scene: Scene, state: State) -> None:
    """Raises ValueError where a scene and a state are not of as many worlds."""
    check_type("scene", scene, Scene)
    check_type("state", state, State)
    scenes, states = np.shape(scene.gravity)[:-1], np.shape(state.position)[:-2]
    if len(states) > 1:
        raise ValueError(f"state has batch shape {states}; fold batches into one leading world axis, or use jax.vmap")
    if scenes == states:
        return
    if scenes and states:
        raise ValueError(f"scene has {scenes[0]} worlds, state {states[0]}")
    single, batch = ("state", "scene") if scenes else ("scene", "state")
    raise ValueError(
        f"{single} is a single world, {batch} a batch of {(scenes or states)[0]}; make both batches (stack_worlds), or "
        f"use jax.vmap with {'(0, None)' if scenes else '(None, 0)'} for the two"
    )


def check_type(name: str, given: Any, expected: type) -> None:
    if isinstance(given, expected):
        return
    remedy = "give its .scene" if isinstance(getattr(given, "scene", None), expected) else "give one"
    raise TypeError(f"{name} is of type {type(given).__name__}, not {expected.__name__}; {remedy}")


def check_packed(name: str, tables: Any, expected: Any, num_worlds: int) -> None:
    """`expected`: shapes of the tables of `num_worlds` worlds, the number that the packed scene has."""
    if jax.tree.structure(tables) != jax.tree.structure(expected):
        raise TypeError(f"{name} is of type {type(tables).__name__}, not what pack_{name} of this engine gives")
    leaves = jax.tree.leaves(tables)
    if len(worlds := {leaf.shape[-1] for leaf in leaves}) == 1 and (found := worlds.pop()) != num_worlds:
        raise ValueError(f"scene has {num_worlds} worlds, {name} {found}")
    for leaf, wanted in zip(leaves, jax.tree.leaves(expected), strict=True):
        if (leaf.shape, leaf.dtype) != (wanted.shape, wanted.dtype):
            raise ValueError(
                f"{name} was packed by an engine of another capacity or precision: a table is {leaf.dtype} of "
                f"{leaf.shape}, this engine's is {wanted.dtype} of {wanted.shape}"
            )


def like(tree: type, capacity: Capacity, dtype: np.dtype, num_worlds: int) -> Any:
    """A batch of Scene or State as shapes and kinds alone."""
    sizes, kinds = _sizes(capacity), {"F": dtype, "I": np.int32, "B": np.bool_}
    fields = {name: declared.split() for name, declared in _FIELDS[tree].items()}
    return tree(
        **{
            name: jax.ShapeDtypeStruct((num_worlds, *(sizes[letter] for letter in dimensions)), kinds[kind])
            for name, (kind, *dimensions) in fields.items()
        }
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


def check_layout(of: str, tree: Any, capacity: Capacity, dtype: np.dtype, batch: tuple[int, ...]) -> None:
    """Types, shapes and kinds, which are known inside jit too."""
    check_type(of, tree, {"scene": Scene, "state": State, "controls": Controls}[of])
    fields, sizes = _FIELDS[type(tree)], _sizes(capacity)
    assert set(fields) == {field.name for field in dataclasses.fields(tree)}
    for name, declared in fields.items():
        kind, *dimensions = declared.split()
        x = getattr(tree, name)
        if not hasattr(x, "dtype"):
            raise TypeError(f"{of}.{name} is of type {type(x).__name__}; it must be a numpy or JAX array")
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


def _sizes(capacity: Capacity) -> dict[str, int]:
    return {
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


def _check_finite(name: str, x: Array, where: Any = True) -> None:
    if is_known(x) and (wrong := ~np.isfinite(x) & where).any():
        raise ValueError(f"{name}{_first(wrong)} is {np.asarray(x)[wrong][0]}; it must be finite")


def _first(mask: np.ndarray) -> str:
    """Index of the first True as [i, j]."""
    return f"[{', '.join(map(str, np.argwhere(mask)[0]))}]"
