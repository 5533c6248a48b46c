"""Levels on an engine: the effects that they need, their state at the start, and levels that solve themselves.

A level that is solved without actions teaches nothing. Solved means the environment's rule: green touches blue, and not
red in the same step or before. Levels know no environment, so they are played on an engine; `env/noop.py` applies the
same rule with the environment's engines.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import Capacity, Effects
from jax2d.engine import Engine
from jax2d.scene import Array, Controls, State, Touching, touch_matrix
from jax2d.settings import Settings, preset
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import Level, Role

NOOP_STEPS = 64  # environment steps looked ahead, about two seconds; the published generator looks as far
FRAME_SKIP = 2  # physics steps in one


def noop_solved(levels: Level, *, settings: Settings = preset("standard"), num_steps: int = NOOP_STEPS) -> Array:
    """[W] bool: levels of a batch that are solved although no motor (but automatic ones) and no thruster is used."""
    return _noop_solved(jax.tree.map(jnp.asarray, levels), settings, num_steps)


def is_solved_without_actions(
    levels: Level,
    pack: Callable[[Level], tuple[Any, Any]],
    step: Callable[[Any, Any, Controls], tuple[Any, Touching]],
    num_steps: int,
) -> Array:
    """[W] bool, within `num_steps` environment steps. Pure.

    pack(levels) -> (packed scene, packed state); step(packed scene, packed state, controls) -> (packed state, touches),
    one environment step.
    """
    scene = levels.scene
    packed_scene, packed_state = pack(levels)
    controls = Controls(
        motor=levels.motor_auto.astype(jnp.float32), thruster=jnp.zeros_like(scene.thrusters.angle, jnp.float32)
    )
    is_green, is_blue, is_red = (scene.shapes.active & (levels.shape_role == role) for role in list(Role)[1:])

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        state, is_solved, is_over = carry
        state, touching = step(packed_scene, state, controls)
        touches = touch_matrix(touching.during, scene.shapes.active.shape[1]) & is_green[:, :, None]
        touched_blue = (touches & is_blue[:, None, :]).any(axis=(1, 2))
        touched_red = (touches & is_red[:, None, :]).any(axis=(1, 2))
        is_solved = is_solved | (touched_blue & ~touched_red & ~is_over)
        return (state, is_solved, is_over | touched_blue | touched_red), None

    none = jnp.zeros(np.shape(levels.shape_role)[0], bool)
    (_, is_solved, _), _ = jax.lax.scan(advance, (packed_state, none, none), None, length=num_steps)
    return is_solved


@functools.partial(jax.jit, static_argnames=("settings", "num_steps"))
def _noop_solved(levels: Level, settings: Settings, num_steps: int) -> Array:
    capacity = capacity_of(levels)
    engine = Engine(capacity, settings=settings, effects=level_effects(capacity, settings))

    def pack(levels: Level) -> tuple[Any, Any]:
        state = engine.initial_state(
            levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity
        )
        return engine.pack_scene(levels.scene), engine.pack_state(state)

    def step(scene: Any, state: Any, controls: Controls) -> tuple[Any, Touching]:
        return engine.step_packed(scene, state, controls, num_steps=FRAME_SKIP)

    return is_solved_without_actions(levels, pack, step, num_steps)


BEYOND_LEVELS = ("kinematic_bodies", "brakes_and_servos", "springs")  # no level format has them


def level_effects(capacity: Capacity, settings: Settings) -> Effects:
    """Effects that levels can call for. Engines made for them have none of the code of the rest."""
    return Effects.full(capacity).without(*BEYOND_LEVELS).known_to(settings.solver)


def start_state(level: Level) -> State:
    """The state of one level before its first step (numpy, without warm-start impulses): to draw or to measure."""
    num_joints = np.shape(level.scene.joints.active)[0]
    return State(
        position=level.position,
        angle=level.angle,
        velocity=level.velocity,
        angular_velocity=level.angular_velocity,
        joint_impulse=np.zeros((num_joints, 5), np.float32),
        spring_impulse=np.zeros((0, 3), np.float32),
        contact_key=np.zeros(0, np.int32),
        contact_impulse=np.zeros((0, 2), np.float32),
        rolling_impulse=np.zeros(0, np.float32),
    )
