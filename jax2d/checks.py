"""Checks of scenes, states and controls: shapes, types, values. One line per error.

Shapes and types are checked always; values only where they are known, that is outside of jit. What is checked follows
from the declarations of the fields (`scene.py`, `scene_rules.py`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array, Field, fields_of, make, tree_like
from jax2d.scene import Capacity, Controls, Scene, State
from jax2d.scene_rules import SCENE_RULES

_RECORDS = {"scene": Scene, "state": State, "controls": Controls}
_KINDS = {float: ("floating-point", np.floating), int: ("integer", np.integer), bool: ("bool", np.bool_)}


def check_scene(scene: Scene, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("scene", scene, capacity, dtype, batch)
    _check_finite("scene", scene)
    for rule in SCENE_RULES:
        given = [field.get(scene) for field in rule.fields]
        if all(map(is_known, given)) and not (fine := rule.holds(*map(np.asarray, given))).all():
            value = np.asarray(given[0])[~fine][0].tolist()
            raise ValueError(f"scene.{rule.fields[0].name}{_first(~fine)} is {value}; it must {rule.must}")


def check_state(state: State, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("state", state, capacity, dtype, batch)
    in_use = np.asarray(state.contact_key)[..., None] >= 0 if is_known(state.contact_key) else None
    _check_finite("state", state, {"contact_impulse": in_use})  # slots without a key are never read


def completed(controls: Controls, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> Controls:
    """Controls with zeros for what callers have left out."""
    check_type("controls", controls, Controls)

    def given(field: Field) -> Array:
        values = field.get(controls)
        left_out = field.may_be_none and values is None
        return jnp.zeros((*batch, *field.shape(capacity.sizes)), dtype) if left_out else values

    return make(Controls, given)


def check_controls(controls: Controls, capacity: Capacity, dtype: np.dtype, *, batch: tuple[int, ...]) -> None:
    check_layout("controls", controls, capacity, dtype, batch)
    for field in fields_of(Controls):
        if is_known(values := field.get(controls)):
            outside = ~_in_range(field, np.asarray(values))
            if outside.any():
                raise ValueError(
                    f"controls.{field.name}{_first(outside)} is {np.asarray(values)[outside][0]}; it must be from "
                    f"{field.at_least:g} to {field.at_most:g} (inside jit it is clamped and counted in "
                    "Touching.invalid_controls)"
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


def check_type(name: str, given: Any, expected: type, remedy: str = "give one") -> None:
    if isinstance(given, expected):
        return
    if isinstance(getattr(given, "scene", None), expected):
        remedy = "give its .scene"
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


def like(kind: type, capacity: Capacity, dtype: np.dtype, num_worlds: int) -> Any:
    """A batch of Scene or State as shapes and types alone."""
    return tree_like(kind, capacity.sizes, dtype, (num_worlds,))


@jax.jit  # one program, not one for each operation, outside of jit too
def clamped_controls(controls: Controls) -> tuple[Controls, jax.Array]:
    """Controls within their ranges, NaN as 0, and how many were not, [W] int32."""
    invalid = []

    def clamped(field: Field) -> jax.Array:
        values = jnp.asarray(field.get(controls))
        invalid.append(jnp.sum(~_in_range(field, values), axis=tuple(range(1, values.ndim)), dtype=jnp.int32))
        return jnp.where(jnp.isnan(values), 0, jnp.clip(values, field.at_least, field.at_most))

    within = make(Controls, clamped)
    return within, sum(invalid[1:], invalid[0])


def check_real(name: str, values: Any) -> None:
    """Raises ValueError for complex numbers, whose imaginary parts a cast would drop."""
    leaves = jax.tree.leaves(values)
    if any(isinstance(leaf, str | bytes) for leaf in leaves):
        raise ValueError(f"{name} has text; give numbers")
    if any(map(np.iscomplexobj, leaves)):
        raise ValueError(f"{name} has complex numbers; give real ones")
    if isinstance(values, list | tuple) and len(set(map(np.shape, values))) > 1:
        raise ValueError(f"{name} has parts of {len(set(map(np.shape, values)))} different shapes; give them one shape")


def check_fixed(scene: Scene, state: State) -> None:
    """Refuses a fixed shape with a velocity, which it would give to what touches it without moving."""
    shapes = scene.shapes
    of_shapes = (shapes.active, shapes.kinematic, shapes.inverse_mass, shapes.inverse_inertia)
    for name, given in (("velocity", state.velocity), ("angular_velocity", state.angular_velocity)):
        if not all(map(is_known, (*of_shapes, given))):
            return
        active, kinematic, inverse_mass, inverse_inertia = map(np.asarray, of_shapes)
        fixed = active & ~kinematic & (inverse_mass <= 0) & (inverse_inertia <= 0)
        values = np.asarray(given)
        wrong = fixed & ((values != 0).any(-1) if values.ndim > fixed.ndim else values != 0)
        if wrong.any():
            raise ValueError(
                f"state.{name}{_first(wrong)} is {values[wrong][0].tolist()} of a fixed shape; give 0, or make the "
                "shape kinematic (inside jit it is taken as 0)"
            )


def is_known(x: Array) -> bool:
    return not isinstance(x, jax.core.Tracer)


def check_layout(of: str, tree: Any, capacity: Capacity, dtype: np.dtype, batch: tuple[int, ...]) -> None:
    """Types, shapes and kinds, which are known inside jit too."""
    check_type(of, tree, _RECORDS[of])
    for field in fields_of(_RECORDS[of]):
        name, x = f"{of}.{field.name}", field.get(tree)
        if not hasattr(x, "dtype"):
            raise TypeError(f"{name} is of type {type(x).__name__}; it must be a numpy or JAX array")
        shape = (*batch, *field.shape(capacity.sizes))
        if x.shape != shape:
            raise ValueError(f"{name} has shape {x.shape}; this engine ({capacity}) needs {shape}")
        known_as, of_kind = _KINDS[field.kind]
        if not jnp.issubdtype(x.dtype, of_kind):
            raise ValueError(f"{name} is {x.dtype}; it must be {known_as}")
        if field.kind is float and x.dtype.itemsize > dtype.itemsize:
            raise ValueError(
                f"{name} is {x.dtype}, but this engine computes in {dtype}; cast it, or build the engine with "
                f"backend='xla', dtype={x.dtype}"
            )


def _in_range(field: Field, values: Array) -> Array:
    """NaN is not."""
    return (values >= field.at_least) & (values <= field.at_most)


def _check_finite(of: str, tree: Any, where: dict[str, Any] | None = None) -> None:
    """Every float of a record, or those that `where` marks for some fields (None: unknown, not checked)."""
    marked = where or {}
    for field in fields_of(_RECORDS[of]):
        x, mask = field.get(tree), marked.get(field.name, True)
        if field.kind is float and mask is not None and is_known(x) and (wrong := ~np.isfinite(x) & mask).any():
            raise ValueError(f"{of}.{field.name}{_first(wrong)} is {np.asarray(x)[wrong][0]}; it must be finite")


def _first(mask: np.ndarray) -> str:
    """Index of the first True as [i, j]."""
    return f"[{', '.join(map(str, np.argwhere(mask)[0]))}]"
