"""Trajectories: how worlds move over time, the recorder, and what is measured of them.

    trajectory, state = record(engine, scene, state, num_samples=300, every=2)    # 600 steps, every second one
    gained = trajectory.energy() - trajectory.energy()[0]                         # [301] J

Trajectories are numpy float64, so that what is measured of them adds no rounding of its own.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.builder import BuiltWorld
from jax2d.checks import check_batches
from jax2d.engine import Engine
from jax2d.fidelity.engine_argument import FixedEngine
from jax2d.fidelity.sampling import Run, Samples, Sampling, take_samples
from jax2d.measure import overlaps
from jax2d.scene import Controls, JointKind, Joints, Scene, Springs, State, index_worlds, stack_worlds
from jax2d.settings import Settings
from jax2d.whole_numbers import whole_number

MAX_SAMPLES_PER_CALL = 256  # more save next to nothing
MAX_BYTES_PER_CALL = 2**28  # samples that the device holds at a time, before they come to the host


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Samples k = 0 .. T - 1 of one world, or of a batch of W worlds, at the times k x interval.

    Shapes are those of one world; a batch has the world axis after that of time: position [T, W, n, 2]. Measures of a
    batch have it too: energy [T, W].
    """

    scene: Scene  # numpy, [W, ...] on every field for a batch; its precision is that of `masses`
    interval: float  # s between samples
    position: np.ndarray  # [T, n, 2] m, world frame, centre of mass
    angle: np.ndarray  # [T, n] rad, turns counted from the first sample on
    velocity: np.ndarray  # [T, n, 2] m/s
    angular_velocity: np.ndarray  # [T, n] rad/s
    joint_force: np.ndarray | None = None  # [T, J, 2] N, in the last sub-step, 0 at the start; None: not recorded
    overflow: np.ndarray | None = None  # [T] contacts without a slot since the sample before; None: not recorded
    limited: np.ndarray | None = None  # [T] times a speed limit acted since the sample before; None: not recorded

    @property
    def num_intervals(self) -> int:
        """Intervals between samples, T - 1."""
        return len(self.position) - 1

    @property
    def time(self) -> np.ndarray:
        """[T] s."""
        return self.interval * np.arange(len(self.position))

    @property
    def is_movable(self) -> np.ndarray:
        """[n] bool, active bodies that are not fixed."""
        return np.asarray(self.scene.shapes.active) & (np.asarray(self.scene.shapes.inverse_mass) > 0)

    # Parts

    def world(self, index: int) -> Trajectory:
        """One world of a batch."""
        return self._with_arrays(lambda x: x[:, index], scene=index_worlds(self.scene, index))

    def until(self, seconds: float) -> Trajectory:
        """The first `seconds`, to the nearest sample."""
        end = min(round(seconds / self.interval), self.num_intervals) + 1
        return self._with_arrays(lambda x: x[:end])

    def index_at(self, seconds: float) -> int:
        """Index of the first sample at or after a time."""
        return int(np.searchsorted(self.time, seconds - 1e-6))

    # Measures

    def masses(self) -> tuple[np.ndarray, np.ndarray]:
        """(mass [n] kg, inertia [n] kg m^2) in the precision of `scene`, zero for fixed and inactive shapes."""
        active = np.asarray(self.scene.shapes.active)

        def inverse(x: np.ndarray) -> np.ndarray:
            movable = active & (np.asarray(x) > 0)
            return np.where(movable, 1.0 / np.where(movable, x, 1.0), 0.0)

        return inverse(self.scene.shapes.inverse_mass), inverse(self.scene.shapes.inverse_inertia)

    def speed(self) -> np.ndarray:
        """[T] m/s, of the fastest body."""
        return np.where(self.is_movable, np.linalg.norm(self.velocity, axis=-1), 0.0).max(-1)

    def drift(self) -> np.ndarray:
        """[] m, how far any body ends from where it started."""
        moved = np.linalg.norm(self.position[-1] - self.position[0], axis=-1)
        return np.where(self.is_movable, moved, 0.0).max(-1)

    def kinetic_energy(self) -> np.ndarray:
        """[T] J."""
        mass, inertia = self.masses()
        return 0.5 * np.sum(mass * np.sum(self.velocity**2, -1) + inertia * self.angular_velocity**2, -1)

    def energy(self, *, zero_at: np.ndarray | float = 0.0) -> np.ndarray:
        """Kinetic, potential and elastic, [T] J. `zero_at`: where bodies have no potential energy, [n, 2] m (for
        example `position[0]`, which keeps digits of scenes far away), the origin by default."""
        mass, _ = self.masses()
        gravity = np.asarray(self.scene.gravity, np.float64)[..., None, :]
        moving = self.kinetic_energy() - np.sum(mass * np.sum((self.position - zero_at) * gravity, -1), -1)
        return moving + self.elastic_energy() if self.scene.springs.active.shape[-1] else moving

    def elastic_energy(self) -> np.ndarray:
        """[T] J, in springs."""
        springs = self.scene.springs
        energy = 0.5 * springs.stiffness * (self.spring_lengths() - springs.rest_length) ** 2
        return np.where(springs.active, energy, 0.0).sum(-1)

    def spring_lengths(self) -> np.ndarray:
        """[T, S] m between the two anchors of each spring."""
        (centre_a, arm_a), (centre_b, arm_b) = self._arms(self.scene.springs)
        return np.linalg.norm(centre_b - centre_a + (arm_b - arm_a), axis=-1)

    def momentum(self) -> np.ndarray:
        """[T, 2] kg m/s."""
        return np.einsum("...n,t...nd->t...d", self.masses()[0], self.velocity)

    def angular_momentum(self) -> np.ndarray:
        """[T] kg m^2/s about the world origin."""
        mass, inertia = self.masses()
        x, v = self.position, self.velocity
        orbital = mass * (x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0])
        return np.sum(orbital + inertia * self.angular_velocity, -1)

    def anchors(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each joint is on its body a and on its body b, [T, J, 2] m each, world frame."""
        (centre_a, arm_a), (centre_b, arm_b) = self._arms(self.scene.joints)
        return centre_a + arm_a, centre_b + arm_b

    def joint_gaps(self) -> np.ndarray:
        """[T, J] m between the two anchors of each joint, of a slider across its axis; zero for inactive joints. From
        centre to centre, so that scenes far from the origin lose no digits."""
        (centre_a, arm_a), (centre_b, arm_b) = self._arms(self.scene.joints)
        gap = centre_b - centre_a + (arm_b - arm_a)
        joints = self.scene.joints
        axis_angle = np.asarray(joints.axis_angle) + np.take_along_axis(self.angle, np.asarray(joints.a)[None], axis=-1)
        across = np.abs(np.cos(axis_angle) * gap[..., 1] - np.sin(axis_angle) * gap[..., 0])
        slides = np.asarray(joints.is_kind(JointKind.PRISMATIC))
        return np.where(np.asarray(joints.active), np.where(slides, across, np.linalg.norm(gap, axis=-1)), 0.0)

    def depth(self, sample: int = -1) -> np.ndarray:
        """[] m, deepest overlap at one sample of two shapes that may touch."""
        if self.position.ndim == 4:
            return np.array([self.world(i).depth(sample) for i in range(self.position.shape[1])])
        # Relative to the middle of what moves: float32 has digits to lose far from the origin.
        middle = self.position[sample][self.is_movable].mean(0) if self.is_movable.any() else 0.0
        centred = jnp.asarray(self.position[sample] - middle)
        return np.asarray(overlaps(self.scene, centred, jnp.asarray(self.angle[sample])).max(), np.float64)

    # Inside

    def _with_arrays(self, change: Callable[[np.ndarray], np.ndarray], **others: Any) -> Trajectory:
        """The trajectory with every array over time changed."""
        arrays = {
            field.name: change(value)
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        return dataclasses.replace(self, **(arrays | others))

    def _arms(self, ends: Joints | Springs) -> list[tuple[np.ndarray, np.ndarray]]:
        """For a and b of each: (centre of mass [T, k, 2], from there to the anchor [T, k, 2]) m, world frame."""
        found = []
        for body, local in ((ends.a, ends.anchor_a), (ends.b, ends.anchor_b)):
            body = np.asarray(body)[None]
            angle = np.take_along_axis(self.angle, body, axis=-1)
            cos, sin = np.cos(angle), np.sin(angle)
            x, y = np.moveaxis(np.asarray(local, np.float64), -1, 0)
            centre = np.take_along_axis(self.position, body[..., None], axis=-2)
            found.append((centre, np.stack([cos * x - sin * y, sin * x + cos * y], -1)))
        return found


def record(
    engine: Engine,
    scene: Scene,
    state: State,
    controls: Controls | None = None,
    *,
    num_samples: int,
    every: int = 1,
    joint_force: bool = False,
) -> tuple[Trajectory, State]:
    """The trajectory of a world, or of a batch of worlds, under constant controls, and the state that it ends in.

    `scene`, `state` and `controls` are what `engine.step` takes: of one world, or with a leading world axis on every
    field; without controls motors and thrusters do nothing. The trajectory has T = num_samples + 1 samples. The first
    is `state`, each following one is `every` physics steps of `engine.settings.dt` later. `joint_force` records what
    joints exert, too. Recording again from the returned state goes on where the trajectory ends.

    Raises ValueError for counts below 1, and what `engine.step` raises.
    """
    for name, count in (("num_samples", num_samples), ("every", every)):
        if whole_number(name, count) < 1:
            raise ValueError(f"{name} is {count}; give 1 or more")
    check_batches(scene, state)
    batch = np.shape(state.angle)[:-1]
    if controls is None:
        controls = engine.no_controls(*batch)
    if not batch:
        scene, state, controls = jax.tree.map(lambda x: x[None], (scene, state, controls))
    run = Run(scene=engine.pack_scene(scene), state=engine.pack_state(state), controls=controls)
    sampling = Sampling(
        num_samples=num_samples,
        every=every,
        per_call=max(1, min(MAX_SAMPLES_PER_CALL, MAX_BYTES_PER_CALL // _bytes_per_sample(engine, batch, joint_force))),
        joint_impulse=joint_force,
    )
    samples, packed = take_samples(FixedEngine(engine), run, sampling)
    trajectory = trajectory_of(samples, jax.tree.map(_in_float64, scene), engine.settings, every)
    last = engine.unpack_state(packed)
    return (trajectory, last) if batch else (trajectory.world(0), index_worlds(last, 0))


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


def trajectory_of(samples: Samples, scene: Scene, settings: Settings, every: int = 1) -> Trajectory:
    """Of a batch. `settings` are those that it was stepped with."""
    impulse = samples.joint_impulse
    return Trajectory(
        scene=scene,
        interval=settings.dt * every,
        position=_in_float64(samples.position),
        angle=_counting_turns(samples, settings, settings.dt * every),
        velocity=_in_float64(samples.velocity),
        angular_velocity=_in_float64(samples.angular_velocity),
        joint_force=None if impulse is None else _in_float64(impulse[..., :2]) / settings.substep_seconds,
        overflow=np.asarray(samples.overflow),
        limited=np.asarray(samples.limited),
    )


def _counting_turns(samples: Samples, settings: Settings, interval: float) -> np.ndarray:
    """[T, ...] rad: of angles within half a turn those nearest to what the speeds at both ends of an interval give."""
    angle, speed = _in_float64(samples.angle), _in_float64(samples.angular_velocity)
    if settings.solver != "soft_step":  # it counts them itself
        return angle
    expected = 0.5 * (speed[1:] + speed[:-1]) * interval
    turns = np.cumsum(np.round((expected - np.diff(angle, axis=0)) / math.tau), axis=0)
    return np.concatenate([angle[:1], angle[1:] + math.tau * turns])


def _bytes_per_sample(engine: Engine, batch: tuple[int, ...], joint_impulse: bool) -> int:
    capacity = engine.capacity
    numbers = 6 * capacity.shapes + (5 * capacity.joints if joint_impulse else 0) + 2  # as in `Samples`
    return engine.dtype.itemsize * numbers * max(1, math.prod(batch))


def _in_float64(x: Any) -> np.ndarray:
    """A copy as numpy; flags and counts keep their type."""
    x = np.array(x)
    return x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x
