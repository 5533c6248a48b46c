"""Rows of Jacobians: what two bodies are held or pulled by, and the effective masses along them."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Pair, PairVelocities, pair_velocities, pick


class Jacobian(NamedTuple):
    """One row of each joint: speed = direction . (v_b - v_a) + lever_b omega_b - lever_a omega_a."""

    direction: jax.Array  # [..., 2], zero for an angle
    lever_a: jax.Array  # [...] m, 1 for an angle
    lever_b: jax.Array


def speed_along(row: Jacobian, of: PairVelocities) -> jax.Array:
    angular = row.lever_b * of.omega_b - row.lever_a * of.omega_a
    return vec2.dot(row.direction, of.velocity_b - of.velocity_a) + angular


def push(of: PairVelocities, pair: Pair, row: Jacobian, impulse: jax.Array) -> PairVelocities:
    """Velocities after an impulse [...] on b, and its opposite on a."""
    linear = row.direction * impulse[..., None]
    return PairVelocities(
        velocity_a=of.velocity_a - linear * pair.mass_a[..., None],
        velocity_b=of.velocity_b + linear * pair.mass_b[..., None],
        omega_a=of.omega_a - pair.inertia_a * row.lever_a * impulse,
        omega_b=of.omega_b + pair.inertia_b * row.lever_b * impulse,
    )


def inverse_mass(pair: Pair, row: Jacobian, other: Jacobian) -> jax.Array:
    """Change of speed along one row per unit of impulse along another."""
    linear = vec2.dot(row.direction, other.direction) * (pair.mass_a + pair.mass_b)
    return linear + pair.inertia_a * row.lever_a * other.lever_a + pair.inertia_b * row.lever_b * other.lever_b


class Anchored(Protocol):
    """Anchors that two bodies are held or pulled by, [k] of them."""

    @property
    def pair(self) -> Pair: ...
    @property
    def local_a(self) -> jax.Array: ...  # [k, 2] m, anchors in the bodies' frames
    @property
    def local_b(self) -> jax.Array: ...
    @property
    def angle_a(self) -> jax.Array: ...  # [k] rad, of the bodies at the start of the step
    @property
    def angle_b(self) -> jax.Array: ...
    @property
    def centre_gap(self) -> jax.Array: ...  # [k, 2] m, centre of b from centre of a at the start of the step


def arms(bodies: Bodies, of: Anchored) -> tuple[jax.Array, jax.Array]:
    """Arms from the centres of mass to the anchors as the bodies stand now, [k, 2] m."""
    arm_a = vec2.rotated(vec2.rotated(of.local_a, of.angle_a), pick(of.pair.is_a, bodies.turn))
    arm_b = vec2.rotated(vec2.rotated(of.local_b, of.angle_b), pick(of.pair.is_b, bodies.turn))
    return arm_a, arm_b


def current_gap(bodies: Bodies, of: Anchored, arm_a: jax.Array, arm_b: jax.Array) -> jax.Array:
    """Anchor of b from anchor of a, [k, 2] m."""
    moved = pick(of.pair.is_b, bodies.delta) - pick(of.pair.is_a, bodies.delta)
    return of.centre_gap + moved + (arm_b - arm_a)


def work_of_kinematic(
    bodies: Bodies, pair: Pair, on_b: jax.Array, angular_a: jax.Array, angular_b: jax.Array
) -> jax.Array:
    """[k] J, what kinematic bodies have done with impulses `on_b` [k, 2] N s, their opposite on a, and what these are
    about both centres of mass, [k] N m s."""
    of = pair_velocities(pair, bodies.velocities)
    by_a = vec2.dot(on_b, of.velocity_a) + angular_a * of.omega_a
    by_b = vec2.dot(on_b, of.velocity_b) + angular_b * of.omega_b
    is_a, is_b = (pick(body, bodies.is_kinematic.astype(on_b.dtype)) > 0 for body in (pair.is_a, pair.is_b))
    return jnp.where(is_a, by_a, 0) - jnp.where(is_b, by_b, 0)


class Constraints(NamedTuple):
    """Rows of all joints, [J], as the bodies stand now."""

    axial: Jacobian  # what motors drive and limits bound
    first: Jacobian  # what is held
    second: Jacobian
    position: jax.Array  # [J] rad or m, along the axial row
    error: jax.Array  # [J, 2], of the two that are held
