"""Worlds of a builder as trajectories, for scenes of studies and of tests."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

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


def zero_crossings(values: np.ndarray, interval: float) -> np.ndarray:
    """Times at which a quantity changes sign, s from its first sample. A value of zero counts with what follows."""
    signs = np.sign(values)
    for k in range(len(signs) - 2, -1, -1):
        signs[k] = signs[k] or signs[k + 1]
    at = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    before, after = values[at], values[at + 1]
    return interval * (at + before / (before - after))


def vertex(values: np.ndarray, k: int) -> float:
    """Extreme of the parabola through samples k - 1, k, k + 1; at an end the sample itself."""
    if k in (0, len(values) - 1):
        return float(values[k])
    before, here, after = values[k - 1 : k + 2]
    bend = after - 2 * here + before
    return float(here if bend == 0 else here - (after - before) ** 2 / (8 * bend))


def peak(values: np.ndarray) -> float:
    """The largest value, between samples."""
    return vertex(values, int(np.argmax(values)))


def bounce_heights(height: np.ndarray, upward_speed: np.ndarray) -> list[float]:
    """Highest point after each bounce (falling turns into rising); of the last flight only if it came down again."""
    rising = upward_speed > 0
    bounces = [*np.flatnonzero(~rising[:-1] & rising[1:]).tolist(), len(height) - 1]
    heights = []
    for start, end in itertools.pairwise(bounces):
        top = start + int(np.argmax(height[start : end + 1]))
        if top < len(height) - 1:
            heights.append(vertex(height, top))
    return heights
