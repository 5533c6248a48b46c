"""Where the worlds of the growth benchmark start: levels at moments of an episode, and scenes that have settled."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import Controls, Engine
from jax2d.scene import stack_worlds
from kinetix_dist import prng
from kinetix_dist.benchmarks.growth_scenes import SCENES
from kinetix_dist.benchmarks.random_play import take_worlds
from kinetix_dist.level.level import Level

MOMENTS = 16  # of an episode of 512 physics steps
STEPS_BETWEEN_MOMENTS = 32
SETTLING_STEPS = 180  # 3 s
SETTLED_WORLDS = 4  # of one growth scene, with other seeds


@dataclasses.dataclass(frozen=True)
class Start:
    """Packed worlds from which the worlds of a run are taken in order; every leaf has the world axis last."""

    engine: Engine
    scene: Any
    state: Any
    seed: int

    def worlds(self, count: int) -> tuple[Any, Any]:
        """Scene and state of `count` worlds, in an order drawn at random."""
        available = jax.tree.leaves(self.state)[0].shape[-1]
        order = np.random.default_rng(self.seed).permutation(available)[np.arange(count) % available]
        return jax.block_until_ready(jax.jit(take_worlds)((self.scene, self.state), order))

    @property
    def contacts_per_world(self) -> float:
        """Contacts on average."""
        return float((self.engine.unpack_state(self.state).contact_key >= 0).sum(-1).mean())


def levels_at_all_moments(engine: Engine, levels: Level, seed: int) -> Start:
    """Every level at 16 moments of an episode of random actions."""
    num_levels = len(levels.position)
    scene = engine.pack_scene(levels.scene)
    state = engine.pack_state(
        engine.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    )

    def until_next_moment(packed: Any, key: jax.Array) -> tuple[Any, Any]:
        motor_key, thruster_key = prng.split(key)
        motor = prng.uniform(motor_key, (num_levels, engine.capacity.joints), minval=-1, maxval=1)
        thruster = prng.uniform(thruster_key, (num_levels, engine.capacity.thrusters))
        controls = Controls(motor=motor, thruster=thruster)
        return engine.step_packed(scene, packed, controls, num_steps=STEPS_BETWEEN_MOMENTS)[0], packed

    keys = prng.split(prng.key(seed), MOMENTS)
    moments = jax.jit(lambda packed: jax.lax.scan(until_next_moment, packed, keys)[1])(state)
    joined = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1), moments)
    scenes = jax.tree.map(lambda x: jnp.tile(x, MOMENTS), scene)  # the world axis is the last one
    return Start(engine, scenes, joined, seed)


def settled_scene(engine: Engine, name: str, seed: int) -> Start:
    """Worlds of a growth scene that fills the engine's capacity, at rest or nearly so."""
    worlds = [SCENES[name](engine.capacity.shapes, seed=seed + i) for i in range(SETTLED_WORLDS)]
    scene = engine.pack_scene(stack_worlds([world.scene for world in worlds]))
    state = engine.pack_state(stack_worlds([engine.initial_state(*world) for world in worlds]))
    settle = jax.jit(partial(engine.step_packed, num_steps=SETTLING_STEPS))
    return Start(engine, scene, settle(scene, state, engine.no_controls(SETTLED_WORLDS))[0], seed)
