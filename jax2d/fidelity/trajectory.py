"""Worlds of a builder as trajectories, for scenes of studies and of tests."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jax2d.builder import BuiltWorld
from jax2d.engine import Engine
from jax2d.recorder import record, trajectory_of
from jax2d.scene import Scene, State, stack_worlds
from jax2d.trajectory import Trajectory

__all__ = ["Trajectory", "record", "record_worlds", "start_of", "trajectory_of"]


def record_worlds(
    engine: Engine, worlds: Sequence[BuiltWorld], *, seconds: float, every: int = 1, control: float = 1.0
) -> list[Trajectory]:
    """A trajectory for each world of a builder, all stepped as one batch with every motor and thruster at `control`."""
    scene, state = start_of(engine, worlds)
    controls = jax.tree.map(lambda x: jnp.full_like(x, control), engine.no_controls(len(worlds)))
    num_samples = round(seconds / (engine.settings.dt * every))
    trajectory, _ = record(engine, scene, state, controls, num_samples=num_samples, every=every)
    return [trajectory.world(i) for i in range(len(worlds))]


def start_of(engine: Engine, worlds: Sequence[BuiltWorld]) -> tuple[Scene, State]:
    """Worlds of a builder as a batch, as they start."""
    scene = stack_worlds([world.scene for world in worlds])
    return scene, stack_worlds([engine.initial_state(*world) for world in worlds])
