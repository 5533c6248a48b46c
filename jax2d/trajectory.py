"""Trajectories: how worlds move over time, and what is measured of them. `recorder.record` makes them.

    trajectory, state = record(engine, scene, state, num_samples=300, every=2)    # 600 steps, every second one
    gained = trajectory.energy() - trajectory.energy()[0]                         # [301] J
    trajectory.save("run.npz")
    trajectory.draw("run.gif")

Trajectories are numpy float64, so that what is measured of them adds no rounding of its own.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import trajectory_files
from jax2d.contact_report import ContactReport
from jax2d.draw import draw as draw_world
from jax2d.images import write_gif, write_png
from jax2d.measure import overlaps
from jax2d.rasteriser import Box, check_view
from jax2d.scene import JointKind, Joints, Scene, Springs, index_worlds

MARGIN = 0.1  # of the view, around what moves
WIDTH_PX = 640
FRAMES_PER_SECOND = 25.0


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
    motor: np.ndarray | None = None  # [T, J] control since the sample before, 0 at the start; None: not recorded
    thruster: np.ndarray | None = None  # [T, number of thrusters]
    joint_force: np.ndarray | None = None  # [T, J, 2] N, in the last sub-step, 0 at the start; None: not recorded
    overflow: np.ndarray | None = None  # [T] contacts without a slot since the sample before; None: not recorded
    limited: np.ndarray | None = None  # [T] times a speed limit acted since the sample before; None: not recorded
    invalid_controls: np.ndarray | None = None  # [T] controls of a policy out of range since the sample before; ...
    contacts: ContactReport | None = None  # [T, K] of the step before each sample, empty at the start; None: ...

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
        """One world of a batch. Raises ValueError for a trajectory of one world."""
        if self.position.ndim == 3:
            raise ValueError("the trajectory is of one world, not of a batch; use it as it is")
        return self._with_arrays(lambda x: x[:, index], scene=index_worlds(self.scene, index))

    def until(self, seconds: float) -> Trajectory:
        """The first `seconds`, to the nearest sample. Raises ValueError for a time before the start."""
        if not seconds >= 0:
            raise ValueError(f"seconds is {seconds}; give 0 or more, counted from the first sample")
        end = round(min(seconds / self.interval, self.num_intervals)) + 1
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
        """Anchors of each joint on its body a and on its body b, [T, J, 2] m each, world frame."""
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

    # Files

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes everything to one compressed .npz file, which holds plain arrays only. Raises ValueError for another
        ending and OSError where it cannot be written."""
        trajectory_files.save(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Reads what `save` wrote, to the last bit. Raises ValueError for a file of another kind."""
        return trajectory_files.load(cls, path)

    def draw(
        self,
        path: str | os.PathLike[str],
        *,
        view: Box | None = None,
        width: int = WIDTH_PX,
        roles: Any = None,
        frames_per_second: float = FRAMES_PER_SECOND,
        speed: float = 1.0,
    ) -> None:
        """Draws one world, by the ending of the path: .png, how it ends, with the ways of what moved; or .gif, a film.

        view: (lowest x, lowest y, highest x, highest y) m; by default what moves is in it all the time. width: pixels.
        roles: as for `jax2d.draw.draw`. speed: of films, 2 is twice as fast as it was. Raises ValueError for a batch
        and other endings."""
        path = trajectory_files.with_ending(path, (".png", ".gif"))
        if self.position.ndim != 3:
            raise ValueError(f"{self.position.shape[1]} worlds; draw one of them: trajectory.world(0).draw(...)")
        for name, value in (("width", width), ("frames_per_second", frames_per_second), ("speed", speed)):
            if not value > 0:
                raise ValueError(f"{name} is {value}; give more than 0")
        if view is not None:
            check_view(view)
        box = view if view is not None else self._view()

        def picture(sample: int, trails: Any = ()) -> np.ndarray:
            state = SimpleNamespace(position=self.position[sample], angle=self.angle[sample])
            thrust = None if self.thruster is None else self.thruster[sample]
            scale = width / (box[2] - box[0])
            return draw_world(self.scene, state, roles, thrust=thrust, view=box, pixels_per_metre=scale, trails=trails)

        if path.suffix == ".png":
            write_png(path, picture(-1, list(np.moveaxis(self.position[:, self.is_movable], 1, 0))))
            return
        seconds = self.time[-1] / speed
        frames = max(1, round(seconds * frames_per_second))
        samples = np.minimum(np.arange(frames) * speed / frames_per_second / self.interval, self.num_intervals)
        write_gif(path, [picture(round(k)) for k in samples], seconds=[1 / frames_per_second] * frames)

    # Inside

    def _view(self) -> Box:
        """Bounds of all movement, with a margin; of a world where nothing can move, of its shapes."""
        shapes = self.scene.shapes
        shown = self.is_movable if self.is_movable.any() else np.asarray(shapes.active)
        reach = np.concatenate([np.linalg.norm(shapes.vertices, axis=-1).max(-1, initial=0), np.asarray(shapes.radius)])
        positions, reach = self.position[:, shown], reach[shown, None]
        fine = np.where(np.isfinite(positions), positions, np.nanmin(positions))
        low, high = (fine - reach).min((0, 1)), (fine + reach).max((0, 1))
        margin = MARGIN * (high - low).max()
        (left, bottom), (right, top) = (low - margin).tolist(), (high + margin).tolist()
        return left, bottom, right, top

    def _with_arrays(self, change: Callable[[np.ndarray], np.ndarray], **others: Any) -> Trajectory:
        """The trajectory with every array over time changed."""
        arrays = {
            field.name: jax.tree.map(change, value)
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), (np.ndarray, ContactReport))
        }
        return dataclasses.replace(self, **(arrays | others))

    def _arms(self, ends: Joints | Springs) -> list[tuple[np.ndarray, np.ndarray]]:
        """Returns for a and b of each (centre of mass [T, k, 2], from there to the anchor [T, k, 2]) m, world frame."""
        found = []
        for body, local in ((ends.a, ends.anchor_a), (ends.b, ends.anchor_b)):
            body = np.asarray(body)[None]
            angle = np.take_along_axis(self.angle, body, axis=-1)
            cos, sin = np.cos(angle), np.sin(angle)
            x, y = np.moveaxis(np.asarray(local, np.float64), -1, 0)
            centre = np.take_along_axis(self.position, body[..., None], axis=-2)
            found.append((centre, np.stack([cos * x - sin * y, sin * x + cos * y], -1)))
        return found
