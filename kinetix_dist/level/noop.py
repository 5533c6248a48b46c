"""What becomes of a level when nobody acts: a level that solves itself teaches nothing.

On the engine alone, since levels do not know the environment; the rules are its rules (green touches blue: solved;
green touches red, also in the same step: failed).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.engine import Engine
from jax2d.scene import Array, Controls, touch_matrix
from jax2d.settings import Settings, preset
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import Level
from kinetix_dist.level.roles import Role

NOOP_STEPS = 64  # environment steps looked ahead, about two seconds
FRAME_SKIP = 2  # physics steps in one


def noop_solved(levels: Level, *, settings: Settings = preset("standard"), num_steps: int = NOOP_STEPS) -> Array:
    """[W] bool: levels of a batch that are solved although no motor (but automatic ones) and no thruster is used."""
    return _noop_solved(jax.tree.map(jnp.asarray, levels), settings, num_steps)


@functools.partial(jax.jit, static_argnames=("settings", "num_steps"))
def _noop_solved(levels: Level, settings: Settings, num_steps: int) -> Array:
    scene = levels.scene
    engine = Engine(capacity_of(levels), settings=settings)
    packed_scene = engine.pack_scene(scene)
    state = engine.initial_state(scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    controls = Controls(
        motor=levels.motor_auto.astype(jnp.float32), thruster=jnp.zeros_like(scene.thrusters.angle, jnp.float32)
    )
    is_green, is_blue, is_red = (scene.shapes.active & (levels.shape_role == role) for role in list(Role)[1:])

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        state, is_solved, is_over = carry
        state, touching = engine.step_packed(packed_scene, state, controls, num_steps=FRAME_SKIP)
        touches = touch_matrix(touching.during, scene.shapes.active.shape[1]) & is_green[:, :, None]
        touched_blue = (touches & is_blue[:, None, :]).any(axis=(1, 2))
        touched_red = (touches & is_red[:, None, :]).any(axis=(1, 2))
        is_solved = is_solved | (touched_blue & ~touched_red & ~is_over)
        return (state, is_solved, is_over | touched_blue | touched_red), None

    nobody = jnp.zeros(np.shape(levels.shape_role)[0], bool)
    (_, is_solved, _), _ = jax.lax.scan(step, (engine.pack_state(state), nobody, nobody), None, length=num_steps)
    return is_solved
