"""What a state amounts to: energy, momentum, joint error. Functions of one world; vmap for batches."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Scene, State


def _masses(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """(mass [n] kg, inertia [n] kg m^2) of movable shapes, zero for fixed and inactive ones."""
    inverse_mass = jnp.where(scene.shape_active, scene.inverse_mass, 0.0)
    inverse_inertia = jnp.where(scene.shape_active, scene.inverse_inertia, 0.0)
    mass = jnp.where(inverse_mass > 0, 1.0 / jnp.where(inverse_mass > 0, inverse_mass, 1.0), 0.0)
    inertia = jnp.where(inverse_inertia > 0, 1.0 / jnp.where(inverse_inertia > 0, inverse_inertia, 1.0), 0.0)
    return mass, inertia


def kinetic_energy(scene: Scene, state: State) -> jax.Array:
    """Joules, [] of one world."""
    mass, inertia = _masses(scene)
    speed_squared = jnp.sum(jnp.square(state.velocity), -1)
    return 0.5 * jnp.sum(mass * speed_squared + inertia * jnp.square(state.angular_velocity))


def potential_energy(scene: Scene, state: State) -> jax.Array:
    """Joules above the origin along gravity, [] of one world."""
    mass, _ = _masses(scene)
    return -jnp.sum(mass * (state.position @ jnp.asarray(scene.gravity)))


def energy(scene: Scene, state: State) -> jax.Array:
    return kinetic_energy(scene, state) + potential_energy(scene, state)


def momentum(scene: Scene, state: State) -> jax.Array:
    """kg m/s, [2]."""
    mass, _ = _masses(scene)
    return jnp.sum(mass[:, None] * state.velocity, axis=0)


def angular_momentum(scene: Scene, state: State) -> jax.Array:
    """kg m^2/s about the world origin, []."""
    mass, inertia = _masses(scene)
    x, v = state.position, state.velocity
    orbital = mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])
    return jnp.sum(orbital + inertia * state.angular_velocity)


def joint_gaps(scene: Scene, state: State) -> jax.Array:
    """Distance between the two anchors of each joint, [J] m; zero for inactive joints."""

    def anchor(body: Array, local: Array) -> jax.Array:
        c, s = jnp.cos(state.angle[body]), jnp.sin(state.angle[body])
        turned = jnp.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]], -1)
        return state.position[body] + turned

    gap = anchor(scene.joint_b, scene.joint_anchor_b) - anchor(scene.joint_a, scene.joint_anchor_a)
    return jnp.where(scene.joint_active, jnp.linalg.norm(gap, axis=-1), 0.0)
