"""The engine: steps worlds of one capacity with one solver on one backend.

    engine = Engine(capacity, settings=preset("standard"))
    state = engine.initial_state(scene, position, angle, velocity, angular_velocity)
    state, touching = engine.step(scene, state, controls)            # convenient: any batch or a single world
    packed, touching = engine.step_packed(packed_scene, packed, controls, num_steps=2)  # hot loop

`step` converts between Scene and State and the backend's own tables on every call; loops convert once
with `pack_scene` and `pack_state`, or with `pack_sorted` for a GPU, and read positions with `bodies`.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
import weakref
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import after_fork
from jax2d.backend import Backend, BackendFactory
from jax2d.checks import (
    check_batches,
    check_controls,
    check_fixed,
    check_layout,
    check_packed,
    check_real,
    check_scene,
    check_state,
    check_type,
    clamped_controls,
    completed,
    is_known,
    like,
)
from jax2d.effects import Effects, MissingEffectError, called_for, check_effects, names_of_bits
from jax2d.fields import Array, Field, broadcast, empty, make
from jax2d.scene import Capacity, Controls, Scene, State, Touching, num_invalid
from jax2d.settings import Settings, checked_settings
from jax2d.whole_numbers import whole_number
from jax2d.world_order import WorldOrder, order_by_structure

MAX_STEPS = 2**31 - 1  # an int32 of the kernel


def _warp_backend(capacity: Capacity, settings: Settings, dtype: np.dtype, effects: Effects, **options: Any) -> Backend:
    from jax2d.warp.ffi import WarpBackend

    return WarpBackend(capacity, settings, dtype, effects, **options)


def _xla_backend(capacity: Capacity, settings: Settings, dtype: np.dtype, effects: Effects, **options: Any) -> Backend:
    from jax2d.xla.backend import XlaBackend

    return XlaBackend(capacity, settings, dtype, effects, **options)


BACKENDS: dict[str, BackendFactory] = {"warp": _warp_backend, "xla": _xla_backend}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PackedScene:
    """A batch of scenes as an engine steps them; every leaf has the world axis last."""

    tables: Any  # the backend's
    missing: Array  # [num_worlds] int32, see `Touching.missing`
    invalid: Array  # [num_worlds] int32, see `Touching.invalid_scene`


class Engine:
    """Steps batches of worlds. Building one compiles nothing; the first step does (a few seconds, then cached)."""

    def __init__(
        self,
        capacity: Capacity,
        *,
        settings: Settings | None = None,
        effects: Effects | None = None,
        backend: str | BackendFactory = "warp",
        dtype: Any = jnp.float32,
        report_contacts: bool = False,
    ):
        """`effects`: what the kernel is compiled for, `effects_of(scenes)`; by default everything that the solver has
        (the paper's lacks those of `effects.NOT_IN_PAPER`). `backend`: "warp", the fused kernel, or "xla", the
        reference in plain JAX (slow, differentiable, also in float64), or what makes another. `dtype` is that of states
        and of the arithmetic. With `report_contacts` every call says in `Touching.contacts` what contacts did in its
        last physics step; states are bitwise the same."""
        after_fork.check()
        check_type("capacity", capacity, Capacity)
        if not callable(backend) and not (isinstance(backend, str) and backend in BACKENDS):
            raise ValueError(f"unknown engine backend {backend!r}; known backends: {', '.join(BACKENDS)}")
        self.capacity = capacity
        self.settings = checked_settings(settings)
        if capacity.extended_shapes and self.settings.solver != "soft_step":
            raise ValueError(
                f"Capacity.extended_shapes is True, but solver {self.settings.solver!r} (preset paper) has nothing of "
                "what it adds; leave it out, or use a preset of soft_step"
            )
        wanted = effects if effects is not None else Effects.full(capacity)
        check_type("effects", wanted, Effects, "give effects_of(scenes), or leave it out for all")
        check_effects(wanted, capacity)
        self.effects = wanted.known_to(self.settings.solver)
        self.dtype = np.dtype(dtype)
        if not isinstance(report_contacts, bool):
            raise ValueError(f"report_contacts is {report_contacts!r}; give True or False")
        self.report_contacts = report_contacts
        factory = BACKENDS[backend] if isinstance(backend, str) else backend
        self.backend = factory(capacity, self.settings, self.dtype, self.effects, report_contacts=report_contacts)
        self._packed_shapes = functools.cache(self._shapes_of_packed)
        self._last_checked: weakref.ref[Scene] | None = None

    # Single worlds and batches

    def initial_state(
        self,
        scene: Scene,
        position: Array,
        angle: Array | None = None,
        velocity: Array | None = None,
        angular_velocity: Array | None = None,
    ) -> State:
        """A state with zero warm-start impulses, for one world or a batch. Omitted parts are zero. Numbers of any kind
        come out in the engine's dtype. Raises ValueError for complex ones and for shapes that are not the scene's."""
        after_fork.check()
        check_type("scene", scene, Scene)
        batch = np.shape(scene.gravity)[:-1]
        check_layout("scene", scene, self.capacity, self.dtype, batch)
        if position is None:
            raise ValueError("position is None; give one point for each shape (only what follows it may be left out)")

        given = {"position": position, "angle": angle, "velocity": velocity, "angular_velocity": angular_velocity}
        state = broadcast(empty(State, self.capacity.sizes), batch)

        def start(field: Field) -> jax.Array:
            x = given.get(field.name)
            if x is None:
                zeros, dtype = field.get(state), field.dtype(self.dtype)
                # What holds nothing is made by a program, not captured by it: jax 0.11 cannot compile some that do.
                return jnp.zeros(np.shape(zeros), dtype) if np.size(zeros) == 0 else jnp.asarray(zeros, dtype)
            check_real(field.name, x)
            x, shape = jnp.asarray(x, self.dtype), (*batch, *field.shape(self.capacity.sizes))
            if x.shape != shape:
                raise ValueError(f"{field.name} has shape {x.shape}; a state of this scene needs {shape}")
            return x

        return make(State, start)

    def no_controls(self, *batch: int) -> Controls:
        """Controls that do nothing, for a batch of the given shape."""
        sizes = self.capacity.sizes
        return make(Controls, lambda field: jnp.zeros((*batch, *field.shape(sizes)), self.dtype))

    def step(
        self, scene: Scene, state: State, controls: Controls | None = None, num_steps: int = 1
    ) -> tuple[State, Touching]:
        """Steps one world or a batch (leading axis on every field) by `num_steps` steps of `settings.dt`.

        Raises ValueError or TypeError, with the field, for shapes and types that do not fit, and outside of jit for
        values that make no world, controls out of range and scenes that call for effects this engine was compiled
        without.
        """
        after_fork.check()
        check_batches(scene, state)
        batch = np.shape(state.position)[:-2]
        if controls is None:
            controls = self.no_controls(*batch)
        self._check_scene(scene, batch)
        check_state(state, self.capacity, self.dtype, batch=batch)
        check_fixed(scene, state)
        controls = completed(controls, self.capacity, self.dtype, batch=batch)
        check_controls(controls, self.capacity, self.dtype, batch=batch)
        single = not batch
        if single:
            scene, state, controls = _batch_of_one((scene, state, controls))
        packed, touching = self._step_packed(
            self._pack_scene(scene), self.backend.pack_state(state), controls, num_steps
        )
        state = self.unpack_state(packed)
        if single:
            state, touching = _first_of_batch((state, touching))
        return state, touching

    # Hot loops

    def pack_scene(self, scene: Scene) -> PackedScene:
        """A batch of scenes (leading world axis on every field) as this engine steps them. Raises as `step` does."""
        after_fork.check()
        check_type("scene", scene, Scene)
        self._check_scene(scene, np.shape(scene.gravity)[:1])
        return self._pack_scene(scene)

    def pack_state(self, state: State) -> Any:
        """The backend's tables of a batch of states; every leaf has the world axis last. Raises as `step` does."""
        after_fork.check()
        check_type("state", state, State)
        check_state(state, self.capacity, self.dtype, batch=np.shape(state.angle)[:1])
        return self.backend.pack_state(state)

    def pack_sorted(self, scene: Scene, state: State) -> tuple[PackedScene, Any, WorldOrder]:
        """`pack_scene`, `pack_state` and the order of the worlds in both, by structure: like worlds stand side by side.

        A GPU steps worlds that are drawn from many levels faster so; each world moves bit for bit as in any other
        order. Everything that goes with these tables is in their order, too: controls are `order.sort(controls)`, and
        `order.restore(x)` gives reports, bodies and unpacked states in the order of `scene`.
        """
        check_batches(scene, state)
        packed = self.pack_scene(scene), self.pack_state(state)  # before sorting: errors name worlds of `scene`
        order = order_by_structure(scene)
        return *order.sort(packed, axis=-1), order

    def unpack_state(self, packed: Any) -> State:
        return self.backend.unpack_state(packed)

    def bodies(self, packed: Any) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(position [W, n, 2], angle [W, n], velocity [W, n, 2], angular velocity [W, n]) of a packed state."""
        after_fork.check()
        return self.backend.bodies(packed)

    def step_packed(
        self, scene: PackedScene, state: Any, controls: Controls, num_steps: int = 1
    ) -> tuple[Any, Touching]:
        """Steps a packed batch. Controls are batch-first: motor [W, J], thruster [W, T], of extended shapes also force
        [W, n, 2] and torque [W, n], which may be None. Inside jit those out of range are clamped and counted in
        `Touching.invalid_controls`, outside they raise ValueError."""
        after_fork.check()
        check_type("scene", scene, PackedScene)
        num_worlds = scene.missing.shape[-1]
        for name, tables, expected in zip(("scene", "state"), (scene.tables, state), self._packed_shapes(num_worlds)):
            check_packed(name, tables, expected, num_worlds)
        controls = completed(controls, self.capacity, self.dtype, batch=(num_worlds,))
        check_controls(controls, self.capacity, self.dtype, batch=(num_worlds,))
        return self._step_packed(scene, state, controls, num_steps)

    # Inside

    def _check_scene(self, scene: Scene, batch: tuple[int, ...]) -> None:
        """Once for a scene of JAX arrays, which cannot change: checking many worlds costs as much as stepping them."""
        if self._last_checked is not None and self._last_checked() is scene:
            return
        check_scene(scene, self.capacity, self.dtype, batch=batch)
        if all(isinstance(x, jax.Array) and is_known(x) for x in jax.tree.leaves(scene)):
            self._last_checked = weakref.ref(scene)

    def _pack_scene(self, scene: Scene) -> PackedScene:
        if self.effects == Effects.full(self.capacity):
            missing = jnp.zeros(np.shape(scene.gravity)[0], jnp.int32)
        else:
            missing = self.effects.missing_worlds(called_for(scene))
            if is_known(missing):
                _refuse(np.asarray(missing))
        return PackedScene(tables=self.backend.pack_scene(scene), missing=missing, invalid=num_invalid(scene))

    def _shapes_of_packed(self, num_worlds: int) -> tuple[Any, Any]:
        """(scene, state) tables as shapes and kinds alone."""
        scene, state = (like(tree, self.capacity, self.dtype, num_worlds) for tree in (Scene, State))
        return jax.eval_shape(self.backend.pack_scene, scene), jax.eval_shape(self.backend.pack_state, state)

    def _step_packed(self, scene: PackedScene, state: Any, controls: Controls, num_steps: int) -> tuple[Any, Touching]:
        if not is_known(num_steps):
            raise ValueError("num_steps is known inside jit only; give a whole number known when a step is compiled")
        if not 1 <= whole_number("num_steps", num_steps) <= MAX_STEPS:
            raise ValueError(f"num_steps is {num_steps}; a call takes 1 to {MAX_STEPS} steps")
        controls, invalid = clamped_controls(controls)
        state, report = self.backend.step_packed(scene.tables, state, controls, operator.index(num_steps))
        return state, Touching(
            **report._asdict(), invalid_controls=invalid, invalid_scene=scene.invalid, missing=scene.missing
        )


@jax.jit
def _batch_of_one(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[None], tree)


@jax.jit
def _first_of_batch(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)


def _refuse(missing: np.ndarray) -> None:
    """Raises for the first world that calls for something missing."""
    if missing.any():
        world = int(np.flatnonzero(missing)[0])
        names = ", ".join(names_of_bits(int(missing[world])))
        raise MissingEffectError(
            f"scene {world} calls for {names}, which this engine was compiled without; "
            "build the engine with effects=effects_of(scenes) of all scenes, or without `effects`"
        )
