"""Bodies of one world while it is stepped: velocity, and position as a delta from the start of the step, so that
nothing is lost far from the origin.

Constraints act on pairs of bodies. A `Pair` picks its two bodies by masks instead of indices: picking is a masked sum
and pushing a masked add, which stay deterministic, fuse, and batch over worlds without gathers or scatters.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Scene, State
from jax2d.solver_numbers import Scalar
from jax2d.xla import angles, vec2


class Velocities(NamedTuple):
    """Velocities of all bodies, which impulses change."""

    velocity: jax.Array  # [n, 2] m/s
    omega: jax.Array  # [n] rad/s


class Bodies(NamedTuple):
    position: jax.Array  # [n, 2] m, at the start of the step
    angle: jax.Array  # [n] rad, at the start of the step
    velocities: Velocities
    delta: jax.Array  # [n, 2] m, moved since the start of the step
    turn: jax.Array  # [n] rad, turned since the start of the step
    inverse_mass: jax.Array  # [n] 1/kg
    inverse_inertia: jax.Array  # [n] 1/(kg m^2)
    is_kinematic: jax.Array  # [n] bool, moves at its own velocity whatever touches it
    limited: jax.Array  # [] int32, bodies on which a speed limit acted, each once a step
    slowed: jax.Array  # [n] bool, one has acted on it in this step
    wraps: jax.Array  # [n] bool, angles that stay within half a turn

    @property
    def is_dynamic(self) -> jax.Array:
        """[n] bool, something can push it."""
        return (self.inverse_mass > 0) | (self.inverse_inertia > 0)

    @property
    def moves(self) -> jax.Array:
        return self.is_dynamic | self.is_kinematic


def load(scene: Scene, state: State) -> Bodies:
    moves = scene.shapes.kinematic | (scene.shapes.inverse_mass > 0) | (scene.shapes.inverse_inertia > 0)
    return Bodies(
        position=state.position,
        angle=state.angle,
        velocities=Velocities(
            jnp.where(moves[:, None], state.velocity, 0), jnp.where(moves, state.angular_velocity, 0)
        ),
        delta=jnp.zeros_like(state.position),
        turn=jnp.zeros_like(state.angle),
        inverse_mass=scene.shapes.inverse_mass,
        inverse_inertia=scene.shapes.inverse_inertia,
        is_kinematic=scene.shapes.kinematic & (scene.shapes.inverse_mass == 0) & (scene.shapes.inverse_inertia == 0),
        limited=jnp.zeros((), jnp.int32),
        slowed=jnp.zeros(state.angle.shape, bool),
        wraps=~angles.counts_turns(scene.joints, state.angle.shape[0]),
    )


def end_step(bodies: Bodies, which: jax.Array | None = None) -> Bodies:
    """Bodies of `which` [n] bool, or all."""
    if which is None:
        which = jnp.ones(bodies.angle.shape, bool)
    angle = bodies.angle + bodies.turn
    angle = jnp.where(bodies.wraps & bodies.is_dynamic, angles.near(angle, 0), angle)
    return bodies._replace(
        position=jnp.where(which[:, None], bodies.position + bodies.delta, bodies.position),
        angle=jnp.where(which, angle, bodies.angle),
        delta=jnp.where(which[:, None], 0, bodies.delta),
        turn=jnp.where(which, 0, bodies.turn),
    )


def apply_gravity(bodies: Bodies, gravity: jax.Array, dt: Scalar) -> Bodies:
    """Semi-implicit Euler: velocity from gravity."""
    velocity, omega = bodies.velocities
    falls = (bodies.inverse_mass > 0)[:, None]
    return bodies._replace(velocities=Velocities(jnp.where(falls, velocity + gravity * dt, velocity), omega))


def apply_damping(bodies: Bodies, scene: Scene, h: Scalar) -> Bodies:
    """Implicit Euler: v / (1 + h d), which no rate makes unstable."""
    if scene.shapes.linear_damping.shape[0] == 0:
        return bodies
    velocity, omega = bodies.velocities
    slower, turns_slower = (1 / (1 + h * d) for d in (scene.shapes.linear_damping, scene.shapes.angular_damping))
    velocity = jnp.where((bodies.inverse_mass > 0)[:, None], velocity * slower[:, None], velocity)
    return bodies._replace(
        velocities=Velocities(velocity, jnp.where(bodies.inverse_inertia > 0, omega * turns_slower, omega))
    )


def kinetic_energy(bodies: Bodies, velocities: Velocities, drift: jax.Array) -> jax.Array:
    """[n] J, with these velocities, seen from what moves at `drift` [n, 2] m/s."""
    velocity, omega = velocities.velocity - drift, velocities.omega
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    return 0.5 * (mass * vec2.dot(velocity, velocity) + inertia * omega * omega)


def limit_speeds(
    bodies: Bodies, max_speed: Scalar, max_omega: Scalar, which: jax.Array | None = None
) -> tuple[Bodies, jax.Array]:
    """Speed limits of the bodies of `which` [n] bool, or all. Also where one acts, [n] bool."""
    velocity, omega = bodies.velocities
    moves = bodies.moves if which is None else bodies.moves & which
    speed_squared = vec2.dot(velocity, velocity)
    too_fast = moves & (speed_squared > max_speed * max_speed)
    slowed = max_speed / jnp.sqrt(jnp.where(too_fast, speed_squared, 1))
    velocity = jnp.where(too_fast[:, None], velocity * slowed[:, None], velocity)
    spins_too_fast = moves & (jnp.abs(omega) > max_omega)
    omega = jnp.where(spins_too_fast, jnp.sign(omega) * max_omega, omega)
    acts = too_fast | spins_too_fast
    limited = bodies.limited + jnp.sum(acts & ~bodies.slowed, dtype=jnp.int32)
    slower = bodies._replace(velocities=Velocities(velocity, omega), limited=limited, slowed=bodies.slowed | acts)
    return slower, acts


def is_slowed(bodies: Bodies, pair: Pair) -> jax.Array:
    """[...] bool, a speed limit has acted on one of the two in this step. Joints would request again
    and again what it has taken back: impulses that grow without end."""
    return jnp.any((pair.is_a | pair.is_b) & bodies.slowed, axis=-1)


def move(bodies: Bodies, dt: Scalar, max_speed: Scalar, max_omega: Scalar, which: jax.Array | None = None) -> Bodies:
    """Semi-implicit Euler: position from the velocity just solved, within the speed limits. Of the bodies of `which`
    [n] bool, or all."""
    bodies, _ = limit_speeds(bodies, max_speed, max_omega, which)
    moves = bodies.moves if which is None else bodies.moves & which
    return bodies._replace(
        delta=bodies.delta + jnp.where(moves[:, None], bodies.velocities.velocity * dt, 0),
        turn=bodies.turn + jnp.where(moves, bodies.velocities.omega * dt, 0),
    )


class Pair(NamedTuple):
    """Bodies a and b of each of any number of constraints: leading axes `...` are the constraints'."""

    is_a: jax.Array  # [..., n] bool, one True at most
    is_b: jax.Array  # [..., n] bool
    mass_a: jax.Array  # [...] 1/kg, inverse
    mass_b: jax.Array
    inertia_a: jax.Array  # [...] 1/(kg m^2), inverse
    inertia_b: jax.Array


class PairVelocities(NamedTuple):
    """Velocities of the two bodies of each pair."""

    velocity_a: jax.Array  # [..., 2]
    velocity_b: jax.Array
    omega_a: jax.Array  # [...]
    omega_b: jax.Array


def pick(mask: jax.Array, x: jax.Array) -> jax.Array:
    """The row of x ([n] or [n, 2]) that the mask [..., n] marks; zero where it marks none."""
    if x.ndim == 2:
        return jnp.sum(jnp.where(mask[..., None], x, 0), -2)
    return jnp.sum(jnp.where(mask, x, 0), -1)


def pair_up(bodies: Bodies, a: jax.Array, b: jax.Array, exists: jax.Array) -> Pair:
    """Pairs of the bodies with indices a and b; pairs that do not exist pick and push nothing."""
    index = jnp.arange(bodies.angle.shape[0])
    is_a = (a[..., None] == index) & exists[..., None]
    is_b = (b[..., None] == index) & exists[..., None]
    return Pair(
        is_a=is_a,
        is_b=is_b,
        mass_a=pick(is_a, bodies.inverse_mass),
        mass_b=pick(is_b, bodies.inverse_mass),
        inertia_a=pick(is_a, bodies.inverse_inertia),
        inertia_b=pick(is_b, bodies.inverse_inertia),
    )


def pair_velocities(pair: Pair, velocities: Velocities) -> PairVelocities:
    return PairVelocities(
        velocity_a=pick(pair.is_a, velocities.velocity),
        velocity_b=pick(pair.is_b, velocities.velocity),
        omega_a=pick(pair.is_a, velocities.omega),
        omega_b=pick(pair.is_b, velocities.omega),
    )


def relative_velocity(of: PairVelocities, arm_a: jax.Array, arm_b: jax.Array) -> jax.Array:
    """Velocity of b's point over a's, [..., 2]; arms lead from the centres of mass to the points."""
    at_a = of.velocity_a + vec2.left(arm_a) * of.omega_a[..., None]
    at_b = of.velocity_b + vec2.left(arm_b) * of.omega_b[..., None]
    return at_b - at_a


def apply_impulse(
    of: PairVelocities, pair: Pair, arm_a: jax.Array, arm_b: jax.Array, impulse_on_b: jax.Array
) -> PairVelocities:
    return PairVelocities(
        velocity_a=of.velocity_a - impulse_on_b * pair.mass_a[..., None],
        velocity_b=of.velocity_b + impulse_on_b * pair.mass_b[..., None],
        omega_a=of.omega_a - pair.inertia_a * vec2.cross(arm_a, impulse_on_b),
        omega_b=of.omega_b + pair.inertia_b * vec2.cross(arm_b, impulse_on_b),
    )


def apply_angular_impulse(of: PairVelocities, pair: Pair, impulse_on_b: jax.Array) -> PairVelocities:
    return of._replace(
        omega_a=of.omega_a - pair.inertia_a * impulse_on_b, omega_b=of.omega_b + pair.inertia_b * impulse_on_b
    )


def scatter_velocities(velocities: Velocities, pair: Pair, before: PairVelocities, after: PairVelocities) -> Velocities:
    """Writes solved velocities into the world. Changes of pairs that share a body add up."""
    if pair.mass_a.ndim == 0:  # one pair: what was solved is what is stored, with no further rounding
        return Velocities(
            jnp.where(
                pair.is_a[:, None],
                after.velocity_a,
                jnp.where(pair.is_b[:, None], after.velocity_b, velocities.velocity),
            ),
            jnp.where(pair.is_a, after.omega_a, jnp.where(pair.is_b, after.omega_b, velocities.omega)),
        )
    change = jax.tree.map(jnp.subtract, after, before)
    velocity_a = jnp.where(pair.is_a[..., None], change.velocity_a[..., None, :], 0)
    velocity_b = jnp.where(pair.is_b[..., None], change.velocity_b[..., None, :], 0)
    omega_a = jnp.where(pair.is_a, change.omega_a[..., None], 0)
    omega_b = jnp.where(pair.is_b, change.omega_b[..., None], 0)
    return Velocities(
        velocities.velocity + jnp.sum(velocity_a + velocity_b, axis=0),
        velocities.omega + jnp.sum(omega_a + omega_b, axis=0),
    )


def pair_mass(pair: Pair, arm_a: jax.Array, arm_b: jax.Array, direction: jax.Array) -> jax.Array:
    """kg, effective along a direction [..., 2] at the ends of the arms."""
    ra, rb = vec2.cross(arm_a, direction), vec2.cross(arm_b, direction)
    return vec2.inverse_or_zero(pair.mass_a + pair.mass_b + pair.inertia_a * ra * ra + pair.inertia_b * rb * rb)
