"""Helpers of the engine tests: one compiled engine a solver, and trajectories as numpy."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import numpy as np

from jax2d import BuiltWorld, Capacity, Controls, Engine, SceneBuilder, Settings, State, preset

CAPACITY = Capacity(polygons=7, circles=3, joints=3, thrusters=2)


def builder(gravity: tuple[float, float] = (0.0, -9.81)) -> SceneBuilder:
    return SceneBuilder(CAPACITY, gravity=gravity)


@functools.cache
def engine(settings: Settings = preset("standard")) -> Engine:
    return Engine(CAPACITY, settings=settings)


def run(
    world: BuiltWorld,
    seconds: float,
    *,
    settings: Settings = preset("standard"),
    motor: float = 0.0,
    thruster: float = 0.0,
    each_step: Callable[[State], object] | None = None,
) -> State:
    """Simulates one world; each_step sees every state. Returns the last one as numpy arrays."""
    one = engine(settings)
    controls = Controls(
        motor=np.full(CAPACITY.joints, motor, np.float32), thruster=np.full(CAPACITY.thrusters, thruster, np.float32)
    )
    states = _trajectory(one, round(seconds / settings.dt))(world.scene, one.initial_state(*world), controls)
    states = jax.tree.map(np.asarray, states)
    steps = states.position.shape[0]
    if each_step is not None:
        for i in range(steps):
            each_step(jax.tree.map(lambda x, i=i: x[i], states))
    return jax.tree.map(lambda x: x[-1], states)


@functools.cache
def _trajectory(one: Engine, steps: int) -> Callable:
    @jax.jit
    def simulate(scene, state, controls):
        scene, state, controls = jax.tree.map(lambda x: x[None], (scene, state, controls))
        packed_scene = one.pack_scene(scene)

        def body(packed, _):
            packed, _ = one.step_packed(packed_scene, packed, controls)
            return packed, jax.tree.map(lambda x: x[0], one.unpack_state(packed))

        return jax.lax.scan(body, one.pack_state(state), length=steps)[1]

    return simulate
