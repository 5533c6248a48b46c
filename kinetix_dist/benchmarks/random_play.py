"""Random actions as the engine benchmarks draw them: inside the compiled program, each held for two physics steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jax2d import Controls, Engine
from kinetix_dist import prng

EPISODE_STEPS = 512  # physics steps: 256 environment steps of 2
FRAME_SKIP = 2  # physics steps that an action is held for, and of one launch

# (packed scene, packed state, key) -> packed state
Play = Callable[[Any, Any, jax.Array], Any]


def random_controls(engine: Engine, shape: tuple[int, ...], key: jax.Array) -> Controls:
    """Motors from -1, 0, 1 and thrusters from 0, 1; `shape` is that of the batch, [..., W]."""
    motor_key, thruster_key = prng.split(key)
    return Controls(
        motor=prng.randint(motor_key, (*shape, engine.capacity.joints), -1, 2).astype(jnp.float32),
        thruster=prng.randint(thruster_key, (*shape, engine.capacity.thrusters), 0, 2).astype(jnp.float32),
    )


def random_play(engine: Engine, worlds: int, steps: int) -> Play:
    """The program that plays `steps` physics steps of `worlds` packed worlds; not compiled yet."""

    def launch(scene: Any, state: Any, key: jax.Array) -> tuple[Any, None]:
        controls = random_controls(engine, (worlds,), key)
        return engine.step_packed(scene, state, controls, num_steps=FRAME_SKIP)[0], None

    def play(scene: Any, state: Any, key: jax.Array) -> Any:
        return jax.lax.scan(partial(launch, scene), state, prng.split(key, steps // FRAME_SKIP))[0]

    return play


def take_worlds(packed: Any, order: jax.Array) -> Any:
    """Packed worlds in this order, some several times: packed arrays have the world axis last."""
    return jax.tree.map(lambda x: jnp.take(x, order, axis=-1), packed)
