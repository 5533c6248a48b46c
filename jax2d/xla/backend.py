"""Engine backend in plain JAX: the step of one world mapped over a batch.

Packed scenes and states are `Scene` and `State` themselves, in the engine's precision and with the world axis last.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.effects import Effects
from jax2d.fields import Array
from jax2d.scene import BackendReport, Capacity, Controls, Scene, State, only_what_acts
from jax2d.settings import Settings
from jax2d.solver_numbers import SolverNumbers, solver_numbers
from jax2d.xla import step
from jax2d.xla.rules import Rules, rules_of


class XlaBackend:
    """Steps batches of worlds of one capacity by a compiled JAX program, on any device, with gradients."""

    def __init__(
        self,
        capacity: Capacity,
        settings: Settings,
        dtype: np.dtype,
        effects: Effects,
        *,
        numbers: Any = None,
        report_contacts: bool = False,
    ):
        """The reference computes every pair and slot, whatever the `effects`."""
        del effects
        if dtype not in (np.float32, np.float64):
            raise ValueError(f"backend 'xla' computes in float32 or float64, not {dtype}")
        if jax.dtypes.canonicalize_dtype(dtype) != dtype:
            raise ValueError("dtype float64 needs JAX's 64-bit mode: jax.config.update('jax_enable_x64', True)")
        self.capacity = capacity
        self.num_contact_slots = capacity.contact_slots
        self.dtype = dtype
        self.numbers = solver_numbers(settings) if numbers is None else numbers
        self.rules = rules_of(settings, report_contacts=report_contacts)

    def pack_scene(self, scene: Scene) -> Scene:
        """A batch of scenes, worlds last."""
        return _packed_scene(self.dtype, scene)

    def pack_state(self, state: State) -> State:
        return _packed_state(self.dtype, state)

    def unpack_state(self, packed: State) -> State:
        return _unpacked(packed)

    def bodies(self, packed: State) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(position [W, n, 2], angle [W, n], velocity [W, n, 2], angular velocity [W, n])."""
        state = self.unpack_state(packed)
        return state.position, state.angle, state.velocity, state.angular_velocity

    def step_packed(
        self, scene: Scene, state: State, controls: Controls, num_steps: int
    ) -> tuple[State, BackendReport]:
        controls = jax.tree.map(lambda x: jnp.asarray(x, self.dtype), controls)
        return _step_worlds(
            scene,
            state,
            controls,
            self.numbers,
            rules=self.rules,
            capacity=self.capacity,
            num_steps=num_steps,
        )


def _worlds_last(dtype: np.dtype, x: Array) -> jax.Array:
    x = jnp.asarray(x)
    x = x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
    return jnp.moveaxis(x, 0, -1)


# One program each, also outside of jit, where every operation in them would be a program of its own to compile.


@functools.partial(jax.jit, static_argnums=0)
def _packed_scene(dtype: np.dtype, scene: Scene) -> Scene:
    return jax.tree.map(functools.partial(_worlds_last, dtype), only_what_acts(scene))


@functools.partial(jax.jit, static_argnums=0)
def _packed_state(dtype: np.dtype, state: State) -> State:
    return jax.tree.map(functools.partial(_worlds_last, dtype), state)


@jax.jit
def _unpacked(packed: State) -> State:
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), packed)


@functools.partial(jax.jit, static_argnames=("rules", "capacity", "num_steps"))
def _step_worlds(
    scene: Scene,
    state: State,
    controls: Controls,
    params: SolverNumbers,
    *,
    rules: Rules,
    capacity: Capacity,
    num_steps: int,
) -> tuple[State, BackendReport]:
    run = functools.partial(step.run, rules=rules, capacity=capacity, num_steps=num_steps)
    # Packed trees have worlds last, controls and BackendReport first.
    return jax.vmap(run, in_axes=(-1, -1, 0, None), out_axes=(-1, 0))(scene, state, controls, params)
