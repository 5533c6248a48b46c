"""Forces on bodies from outside: of thrusters, and what callers compute themselves."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Controls, Scene
from jax2d.solver_numbers import Scalar, SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Velocities, pick


class Thrusters(NamedTuple):
    is_on: jax.Array  # [T, n] bool, the body a thruster sits on
    position: jax.Array  # [T, 2] m, body frame
    force: jax.Array  # [T, 2] N, body frame


def load(bodies: Bodies, scene: Scene, controls: Controls, params: SolverNumbers) -> Thrusters:
    index = jnp.arange(bodies.angle.shape[0])
    force = controls.thruster * scene.thrusters.power * params.base_thruster_power
    direction = jnp.stack([jnp.cos(scene.thrusters.angle), jnp.sin(scene.thrusters.angle)], -1)
    return Thrusters(
        is_on=(scene.thrusters.body[:, None] == index) & scene.thrusters.active[:, None],
        position=scene.thrusters.position,
        force=force[:, None] * direction,
    )


def apply(bodies: Bodies, thrusters: Thrusters, dt: Scalar) -> Bodies:
    arm, force = _in_world(bodies, thrusters)
    impulse = force * dt
    on_body = thrusters.is_on[..., None]
    push = jnp.sum(jnp.where(on_body, impulse[:, None], 0), axis=0)
    angular_impulse = jnp.sum(jnp.where(thrusters.is_on, vec2.cross(arm, impulse)[:, None], 0), axis=0)
    velocity, omega = bodies.velocities
    return bodies._replace(
        velocities=Velocities(
            velocity + bodies.inverse_mass[:, None] * push, omega + bodies.inverse_inertia * angular_impulse
        )
    )


def work(bodies: Bodies, thrusters: Thrusters, dt: Scalar) -> jax.Array:
    """[n] J, what they have added to the bodies' energy in `dt`."""
    arm, force = _in_world(bodies, thrusters)
    at = (
        pick(thrusters.is_on, bodies.velocities.velocity)
        + vec2.left(arm) * pick(thrusters.is_on, bodies.velocities.omega)[:, None]
    )
    work = jnp.maximum(vec2.dot(force, at) * dt, 0)
    return jnp.sum(jnp.where(thrusters.is_on, work[:, None], 0), axis=0)


def _in_world(bodies: Bodies, thrusters: Thrusters) -> tuple[jax.Array, jax.Array]:
    """([T, 2] m from the centre of mass, [T, 2] N) as the bodies stand now."""
    angle, turn = pick(thrusters.is_on, bodies.angle), pick(thrusters.is_on, bodies.turn)
    arm = vec2.rotated(vec2.rotated(thrusters.position, angle), turn)
    return arm, vec2.rotated(vec2.rotated(thrusters.force, angle), turn)


def apply_external(bodies: Bodies, controls: Controls, dt: Scalar) -> Bodies:
    """Applies external forces at centres of mass, in the world's frame, constant over a call."""
    if controls.torque.shape[0] == 0:
        return bodies
    velocity, omega = bodies.velocities
    return bodies._replace(
        velocities=Velocities(
            velocity + controls.force * (dt * bodies.inverse_mass)[:, None],
            omega + controls.torque * (dt * bodies.inverse_inertia),
        )
    )


def external_work(bodies: Bodies, controls: Controls, dt: Scalar) -> jax.Array | float:
    """[n] J, what they have added to the bodies' energy in `dt`."""
    if controls.torque.shape[0] == 0:
        return 0.0
    velocity, omega = bodies.velocities
    power = vec2.dot(controls.force, velocity) + controls.torque * omega
    return jnp.where(bodies.is_dynamic, jnp.maximum(power * dt, 0), 0)
