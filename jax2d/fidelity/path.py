"""One world's motion as numpy arrays, and what is read off it: energy, momenta, gaps, turning points."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from jax2d.scene import Scene


@dataclasses.dataclass(frozen=True, kw_only=True)
class Path:
    """States k = 0 .. num_steps of one world, at the times k dt. float64."""

    scene: Scene  # of one world, numpy
    dt: float  # s
    position: np.ndarray  # [num_steps + 1, n, 2] m
    angle: np.ndarray  # [num_steps + 1, n] rad
    velocity: np.ndarray  # [num_steps + 1, n, 2] m/s
    angular_velocity: np.ndarray  # [num_steps + 1, n] rad/s
    joint_force: np.ndarray | None = None  # [num_steps + 1, J, 2] N, in the last sub-step; None: engine does not tell

    @property
    def num_steps(self) -> int:
        return len(self.position) - 1

    @property
    def times(self) -> np.ndarray:
        return self.dt * np.arange(self.num_steps + 1)

    def until(self, seconds: float) -> Path:
        """The first `seconds` of the motion, to the nearest step."""
        end = min(round(seconds / self.dt), self.num_steps) + 1
        arrays = {
            field.name: value[:end]
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        return dataclasses.replace(self, **arrays)

    def masses(self) -> tuple[np.ndarray, np.ndarray]:
        """(mass [n] kg, inertia [n] kg m^2), zero for fixed and inactive shapes."""
        active = np.asarray(self.scene.shapes.active)

        def inverse(x: np.ndarray) -> np.ndarray:
            movable = active & (np.asarray(x) > 0)
            return np.where(movable, 1.0 / np.where(movable, x, 1.0), 0.0)

        return inverse(self.scene.shapes.inverse_mass), inverse(self.scene.shapes.inverse_inertia)

    def energy(self) -> np.ndarray:
        """Kinetic and potential, [num_steps + 1] J; zero of height is the origin."""
        mass, inertia = self.masses()
        moving = 0.5 * np.sum(mass * np.sum(self.velocity**2, -1) + inertia * self.angular_velocity**2, -1)
        return moving - np.sum(mass * (self.position @ np.asarray(self.scene.gravity, float)), -1)

    def momentum(self) -> np.ndarray:
        """[num_steps + 1, 2] kg m/s."""
        return np.einsum("n,tnd->td", self.masses()[0], self.velocity)

    def angular_momentum(self) -> np.ndarray:
        """About the world origin, [num_steps + 1] kg m^2/s."""
        mass, inertia = self.masses()
        x, v = self.position, self.velocity
        orbital = mass * (x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0])
        return np.sum(orbital + inertia * self.angular_velocity, -1)

    def joint_gaps(self) -> np.ndarray:
        """Distance between the anchors of each joint, [num_steps + 1, J] m; zero for inactive joints."""

        def anchors(body: np.ndarray, local: np.ndarray) -> np.ndarray:
            cos, sin = np.cos(self.angle[:, body]), np.sin(self.angle[:, body])
            x, y = np.asarray(local, float).T
            return self.position[:, body] + np.stack([cos * x - sin * y, sin * x + cos * y], -1)

        scene = self.scene
        gap = anchors(scene.joints.b, scene.joints.anchor_b) - anchors(scene.joints.a, scene.joints.anchor_a)
        return np.where(scene.joints.active, np.linalg.norm(gap, axis=-1), 0.0)


def crossings(values: np.ndarray, dt: float) -> np.ndarray:
    """Times at which a sampled quantity changes sign, interpolated; a value of zero counts with what follows."""
    signs = np.sign(values)
    for k in range(len(signs) - 2, -1, -1):
        signs[k] = signs[k] or signs[k + 1]
    at = np.flatnonzero(signs[1:] * signs[:-1] < 0)
    before, after = values[at], values[at + 1]
    return dt * (at + before / (before - after))


def vertex(values: np.ndarray, k: int) -> float:
    """Extreme of the parabola through samples k - 1, k, k + 1: what lies between two steps is no error of an engine."""
    if k in (0, len(values) - 1):
        return float(values[k])
    before, here, after = values[k - 1 : k + 2]
    bend = after - 2 * here + before
    return float(here if bend == 0 else here - (after - before) ** 2 / (8 * bend))


def bounce_heights(height: np.ndarray, upward_speed: np.ndarray) -> list[float]:
    """Highest point after each bounce (falling turns into rising); of the last flight only if it came down again."""
    rising = upward_speed > 0
    bounces = [*np.flatnonzero(~rising[:-1] & rising[1:]), len(height) - 1]
    heights = []
    for start, end in itertools.pairwise(bounces):
        top = start + int(np.argmax(height[start : end + 1]))
        if top < len(height) - 1:
            heights.append(vertex(height, top))
    return heights
