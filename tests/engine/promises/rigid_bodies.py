"""Rigid bodies with joints in float64, sharing no code with the engine: what mechanisms are judged by.

Every body has its three coordinates; joints are equations C(q) = 0, whose multipliers follow from

    M a = F + J^T l,    J a = -dJ/dt v    =>    (J M^-1 J^T) l = -dJ/dt v - J M^-1 F

by least squares, since loops may say the same thing twice (a Roberval balance does). Steps are fourth-order
Runge-Kutta; after each one positions and velocities are projected back onto the joints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from tests.engine.promises.plan import Joint, Plan, Point

STEP_S = 1 / 1000
RANK = 1e-11  # share of the largest singular value below which equations say the same thing twice


class RigidBodies:
    """Mechanics of a plan: hinges, welds, sliders on fixed bodies, and discs that slide on a level floor. Springs,
    motors, limits and other contacts are not in it."""

    def __init__(self, plan: Plan, *, forces: Mapping[int, Point] | None = None, on_floor: Sequence[int] = ()) -> None:
        """`forces`: N at centres of mass, world frame, by body. `on_floor`: bodies whose height stays."""
        if plan.springs or any(joint.limits is not None or joint.speed is not None for joint in plan.joints):
            raise ValueError("springs, limits and motors are not in this oracle")
        self.plan, self.on_floor = plan, tuple(on_floor)
        free = np.array([body.moves_freely for body in plan.bodies])
        inverses = [(1 / body.mass, 1 / body.mass, 1 / body.inertia) for body in plan.bodies]
        self.inverse_mass = np.where(free[:, None], inverses, 0.0)
        gravity = np.array([*plan.gravity, 0.0])
        masses = np.array([body.mass for body in plan.bodies])
        self.force = masses[:, None] * gravity
        for body, force in (forces or {}).items():
            self.force[body, :2] += force
        self.start = np.array([(*body.position, body.angle) for body in plan.bodies], np.float64)
        self.start_velocity = np.array([(*body.velocity, body.spin) for body in plan.bodies], np.float64)
        self._arms = [(self._local(joint.a, joint.at), self._local(joint.b, joint.at)) for joint in plan.joints]

    def acceleration(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[n, 3] m/s^2 and rad/s^2, of bodies at q [n, 3] m and rad that move at v [n, 3]."""
        _, jacobian, bend = self._equations(q, v)
        inverse = self.inverse_mass.ravel()
        free = inverse * self.force.ravel()
        multipliers = _solve((jacobian * inverse) @ jacobian.T, -bend - jacobian @ free)
        return (free + inverse * (jacobian.T @ multipliers)).reshape(q.shape)

    def motion(self, seconds: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities [samples + 1, n, 3] at even times from 0 to `seconds`."""
        steps = math.ceil(seconds / samples / STEP_S)
        h = seconds / samples / steps
        q, v = self.start, self.start_velocity
        found = [(q, v)]
        for _ in range(samples):
            for _ in range(steps):
                q, v = self._projected(*self._stepped(q, v, h))
            found.append((q, v))
        return np.array([q for q, _ in found]), np.array([v for _, v in found])

    def energy(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[...] J, kinetic and of gravity and the forces, of bodies that move freely."""
        free = self.inverse_mass > 0
        mass = np.where(free, 1 / np.where(free, self.inverse_mass, 1), 0)
        return (0.5 * mass * v * v - np.where(free, self.force, 0) * q).sum((-1, -2))

    def balancing_force(self, body: int, direction: Point) -> float:
        """N along a direction, at a centre of mass, with which that does not accelerate along it from rest."""
        along = np.array([*direction, 0.0])
        before = self.force[body].copy()
        still = np.zeros_like(self.start)
        found = []
        for newtons in (0.0, 1.0):
            self.force[body] = before + newtons * along
            found.append(float(self.acceleration(self.start, still)[body] @ along))
        self.force[body] = before
        return found[0] / (found[0] - found[1])

    def _stepped(self, q: np.ndarray, v: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        a1 = self.acceleration(q, v)
        v2 = v + h / 2 * a1
        a2 = self.acceleration(q + h / 2 * v, v2)
        v3 = v + h / 2 * a2
        a3 = self.acceleration(q + h / 2 * v2, v3)
        v4 = v + h * a3
        a4 = self.acceleration(q + h * v3, v4)
        return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def _projected(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inverse = self.inverse_mass.ravel()
        for is_velocity in (False, True):
            wrong, jacobian, _ = self._equations(q, v)
            error = jacobian @ v.ravel() if is_velocity else wrong
            change = inverse * (jacobian.T @ _solve((jacobian * inverse) @ jacobian.T, -error))
            if is_velocity:
                v = v + change.reshape(v.shape)
            else:
                q = q + change.reshape(q.shape)
        return q, v

    def _equations(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(C [m], J [m, 3 n], dJ/dt v [m])."""
        rows: list[tuple[float, dict[int, np.ndarray], float]] = []
        for joint, (arm_a, arm_b) in zip(self.plan.joints, self._arms, strict=True):
            rows += self._of_joint(q, v, joint, arm_a, arm_b)
        for body in self.on_floor:
            rows.append((q[body, 1] - self.start[body, 1], {body: np.array([0.0, 1.0, 0.0])}, 0.0))
        jacobian = np.zeros((len(rows), *q.shape))
        for row, (_, parts, _) in enumerate(rows):
            for body, part in parts.items():
                jacobian[row, body] = part
        return np.array([r[0] for r in rows]), jacobian.reshape(len(rows), -1), np.array([r[2] for r in rows])

    def _of_joint(
        self, q: np.ndarray, v: np.ndarray, joint: Joint, arm_a: np.ndarray, arm_b: np.ndarray
    ) -> list[tuple[float, dict[int, np.ndarray], float]]:
        a, b = joint.a, joint.b
        ra, rb = _turned(arm_a, q[a, 2]), _turned(arm_b, q[b, 2])
        gap = q[b, :2] + rb - q[a, :2] - ra
        bend = v[a, 2] ** 2 * ra - v[b, 2] ** 2 * rb
        across = [(1.0, 0.0), (0.0, 1.0)]
        if joint.kind == "slider":
            if self.plan.bodies[a].moves_freely:
                raise ValueError("the axis of a slider is that of a fixed body a here")
            across = [(-math.sin(joint.axis_angle), math.cos(joint.axis_angle))]
        rows = []
        for n in across:
            parts = {a: np.array([-n[0], -n[1], n[0] * ra[1] - n[1] * ra[0]])}
            parts[b] = np.array([n[0], n[1], n[1] * rb[0] - n[0] * rb[1]])
            rows.append((float(gap @ n), parts, float(bend @ n)))
        if joint.kind != "hinge":
            turn = (q[b, 2] - self.start[b, 2]) - (q[a, 2] - self.start[a, 2])
            rows.append((turn, {a: np.array([0.0, 0.0, -1.0]), b: np.array([0.0, 0.0, 1.0])}, 0.0))
        return rows

    def _local(self, body: int, at: Point) -> np.ndarray:
        return _turned(np.asarray(at) - self.start[body, :2], -self.start[body, 2])


def _turned(v: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(matrix, right, rcond=RANK)[0]
