"""Runs batches of worlds and keeps every step: what the hard scenes and their tests are judged by.

    motions = record(worlds, engine, seconds=10.0)
    motions[0].speed()[-1].max()

Measures are taken in numpy float64, relative to where a scene stands, so that they add no error of their own.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.builder import BuiltWorld
from jax2d.engine import Engine
from jax2d.measure import overlaps
from jax2d.scene import Controls, Scene, State, index_worlds, stack_worlds


@dataclasses.dataclass(frozen=True)
class Motion:
    """One world over `T` recorded moments; moment 0 is the start."""

    scene: Scene
    time: np.ndarray  # [T] s
    position: np.ndarray  # [T, n, 2] m
    angle: np.ndarray  # [T, n] rad
    velocity: np.ndarray  # [T, n, 2] m/s
    angular_velocity: np.ndarray  # [T, n] rad/s
    overflow: int  # contacts that found no slot
    limited: int  # times a speed limit acted

    @property
    def movable(self) -> np.ndarray:
        """[n] bool: bodies that are there and not fixed."""
        return np.asarray(self.scene.shapes.active) & (np.asarray(self.scene.shapes.inverse_mass) > 0)

    def after(self, seconds: float) -> int:
        """Index of the first moment at or after the given time."""
        return int(np.searchsorted(self.time, seconds - 1e-6))

    def speed(self) -> np.ndarray:
        """[T] m/s, of the fastest body."""
        return np.linalg.norm(self.velocity[:, self.movable], axis=-1).max(-1)

    def drift(self) -> float:
        """m, how far any body ends from where it started."""
        return float(np.linalg.norm((self.position[-1] - self.position[0])[self.movable], axis=-1).max())

    def kinetic_energy(self) -> np.ndarray:
        """[T] J."""
        mass, inertia = self._masses()
        square = np.square(self.velocity).sum(-1)
        return 0.5 * (mass * square + inertia * np.square(self.angular_velocity)).sum(-1)

    def energy(self) -> np.ndarray:
        """[T] J, potential energy counted from the start."""
        mass, _ = self._masses()
        risen = (self.position - self.position[0]) @ np.asarray(self.scene.gravity, np.float64)
        return self.kinetic_energy() - (mass * risen).sum(-1)

    def gaps(self) -> np.ndarray:
        """[T, J] m between the two anchors of each joint."""
        scene = self.scene

        def anchor(body: np.ndarray, local: np.ndarray) -> np.ndarray:
            c, s = np.cos(self.angle[:, body]), np.sin(self.angle[:, body])
            x, y = np.asarray(local, np.float64).T
            return np.stack([c * x - s * y, s * x + c * y], -1)

        a, b = np.asarray(scene.joints.a), np.asarray(scene.joints.b)
        arms = anchor(b, scene.joints.anchor_b) - anchor(a, scene.joints.anchor_a)
        gap = np.linalg.norm(self.position[:, b] - self.position[:, a] + arms, axis=-1)
        return np.where(np.asarray(scene.joints.active), gap, 0.0)

    def depth(self, moment: int = -1) -> float:
        """m, deepest overlap of two shapes that may touch, at one moment."""
        return float(np.max(overlaps(self.scene, jnp.asarray(self._centred(moment)), jnp.asarray(self.angle[moment]))))

    def _centred(self, moment: int) -> np.ndarray:
        middle = self.position[moment][self.movable].mean(0) if self.movable.any() else 0.0
        return self.position[moment] - middle

    def _masses(self) -> tuple[np.ndarray, np.ndarray]:
        inverse = np.where(self.movable, self.scene.shapes.inverse_mass, 1.0).astype(np.float64)
        inverse_inertia = np.where(self.movable, self.scene.shapes.inverse_inertia, 1.0).astype(np.float64)
        return self.movable / inverse, self.movable / inverse_inertia


def record(
    worlds: Sequence[BuiltWorld],
    engine: Engine,
    *,
    seconds: float,
    every: int = 1,
    motor: float = 1.0,
    thruster: float = 0.0,
    state: State | None = None,
) -> tuple[list[Motion], State]:
    """Steps all worlds in one batch with constant controls; keeps one moment in `every` steps. Starts from `state`
    (batched) where one is given. Returns the motions and the last state (batched), to go on from."""
    scene = stack_worlds([w.scene for w in worlds])
    if state is None:
        state = stack_worlds([engine.initial_state(*w) for w in worlds])
    num_moments = round(seconds / (engine.settings.dt * every))
    bodies, overflow, limited, last = _trajectory(engine, num_moments, every)(
        scene, state, np.float32(motor), np.float32(thruster)
    )
    parts = [
        np.concatenate([np.asarray(x, np.float64)[None], np.asarray(y, np.float64)])
        for x, y in zip((state.position, state.angle, state.velocity, state.angular_velocity), bodies)
    ]
    time = np.arange(num_moments + 1) * engine.settings.dt * every
    return [
        Motion(index_worlds(scene, i), time, *(x[:, i] for x in parts), int(overflow[i]), int(limited[i]))
        for i in range(len(worlds))
    ], last


@functools.cache
def _trajectory(engine: Engine, num_moments: int, every: int) -> Callable:
    @jax.jit
    def simulate(scene: Scene, state: State, motor: jax.Array, thruster: jax.Array):
        worlds = state.position.shape[0]
        controls = Controls(
            motor=jnp.full((worlds, engine.capacity.joints), motor),
            thruster=jnp.full((worlds, engine.capacity.thrusters), thruster),
        )
        packed_scene = engine.pack_scene(scene)

        def body(packed, _):
            packed, touching = engine.step_packed(packed_scene, packed, controls, every)
            return packed, (engine.bodies(packed), touching.overflow, touching.limited)

        last, (bodies, overflow, limited) = jax.lax.scan(body, engine.pack_state(state), length=num_moments)
        return bodies, overflow.sum(0), limited.sum(0), engine.unpack_state(last)

    return simulate
