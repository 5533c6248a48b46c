"""One world, any number of physics steps. Read this file first."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Capacity, Controls, Scene, State, Touching, touch_bits
from jax2d.xla import bodies as bodies_of
from jax2d.xla import contacts as contacts_of
from jax2d.xla import forces, manifolds, paper
from jax2d.xla import joints as joints_of
from jax2d.xla.bodies import Bodies
from jax2d.xla.contacts import Contacts
from jax2d.xla.joints import Joints
from jax2d.xla.parameters import Parameters, Rules


def run(
    scene: Scene,
    state: State,
    controls: Controls,
    params: Parameters,
    *,
    rules: Rules,
    capacity: Capacity,
    num_steps: int,
) -> tuple[State, Touching]:
    """Steps one world. `scene.can_touch` holds each pair that may touch once, at [lower, higher]; shapes that are not
    active have no mass."""
    one_step = soft_step if rules.solver == "soft_step" else paper_step

    def body(state: State, _: None) -> tuple[State, tuple[jax.Array, jax.Array, jax.Array]]:
        bodies, joints, contacts = one_step(scene, state, controls, params, rules, capacity)
        bodies = bodies_of.end_step(bodies)
        after = State(
            position=bodies.position,
            angle=bodies.angle,
            velocity=bodies.motion.velocity,
            angular_velocity=bodies.motion.omega,
            joint_impulse=joints_of.store(joints, state),
            contact_key=contacts.key,
            contact_impulse=jnp.stack([contacts.impulse_normal, contacts.impulse_tangent], -1),
        )
        return after, (touching(contacts), contacts.overflow, bodies.limited)

    state, (touch, overflow, limited) = jax.lax.scan(body, state, length=num_steps)
    return state, Touching(
        at_end=touch_bits(touch[-1]),
        during=touch_bits(jnp.any(touch, axis=0)),
        overflow=jnp.sum(overflow, dtype=jnp.int32),
        limited=jnp.sum(limited, dtype=jnp.int32),
    )


def soft_step(
    scene: Scene, state: State, controls: Controls, params: Parameters, rules: Rules, capacity: Capacity
) -> tuple[Bodies, Joints, Contacts]:
    """Soft-step sub-stepping (Box2D v3): contacts found once, then solved in sub-steps of h."""
    h = params.h
    bodies = bodies_of.load(scene, state)
    geometry = manifolds.build(scene, bodies)
    reach = params.speculative_distance
    contacts = contacts_of.find(bodies, geometry, scene, state, params, rules, capacity, reach, ahead=True)
    joints = joints_of.prepare(bodies, scene, state, controls, params)
    thrusters = forces.load(bodies, scene, controls, params)

    def substep(carry: tuple[Bodies, Joints, Contacts], _: None) -> tuple[tuple[Bodies, Joints, Contacts], None]:
        bodies, joints, contacts = carry
        bodies = bodies_of.apply_gravity(bodies, scene.gravity, h)
        bodies = forces.apply(bodies, thrusters, h)
        bodies = joints_of.warm_start(bodies, joints)
        bodies = contacts_of.warm_start(bodies, contacts)
        # Joints first, so that contacts have the last word: a heavy body must not push through a jointed light one.
        bodies, joints = joints_of.solve_soft(bodies, joints, params, use_bias=True)
        bodies, contacts = contacts_of.solve_soft(bodies, contacts, params, use_bias=True)
        bodies = bodies_of.move(bodies, h, params.max_speed, params.max_angular_speed)
        bodies, joints = joints_of.solve_soft(bodies, joints, params, use_bias=False)
        bodies, contacts = contacts_of.solve_soft(bodies, contacts, params, use_bias=False)
        return (bodies, joints, contacts), None

    (bodies, joints, contacts), _ = jax.lax.scan(substep, (bodies, joints, contacts), length=rules.substeps)
    bodies, contacts = contacts_of.apply_restitution(bodies, contacts, scene.gravity, params)
    return bodies, joints, contacts


def paper_step(
    scene: Scene, state: State, controls: Controls, params: Parameters, rules: Rules, capacity: Capacity
) -> tuple[Bodies, Joints, Contacts]:
    """The main loop of the paper's appendix (algorithm 1)."""
    bodies = bodies_of.apply_gravity(bodies_of.load(scene, state), scene.gravity, params.dt)
    geometry = manifolds.build(scene, bodies)
    contacts = contacts_of.find(bodies, geometry, scene, state, params, rules, capacity, 0.0, ahead=False)
    joints = joints_of.prepare(bodies, scene, state, controls, params)
    bodies = paper.apply_motors(bodies, joints, params)
    bodies = forces.apply(bodies, forces.load(bodies, scene, controls, params), params.dt)
    bodies = contacts_of.warm_start(bodies, contacts)
    bodies, joints = paper.warm_start(bodies, joints)

    def iteration(carry: tuple[Bodies, Joints, Contacts], _: None) -> tuple[tuple[Bodies, Joints, Contacts], None]:
        bodies, joints, contacts = carry
        bodies, joints = paper.solve(bodies, joints, params)
        bodies, contacts = contacts_of.solve_hard(bodies, contacts, params, batch_size=rules.solver_batch_size)
        return (bodies, joints, contacts), None

    (bodies, joints, contacts), _ = jax.lax.scan(iteration, (bodies, joints, contacts), length=rules.substeps)
    return bodies_of.move(bodies, params.dt, params.max_speed, params.max_angular_speed), joints, contacts


def touching(contacts: Contacts) -> jax.Array:
    """[n, n] bool: shapes touch when their contact carried an impulse in the step or they overlap."""
    touches = (contacts.most_impulse > 0) | (contacts.separation <= 0)
    pair = contacts.pair
    one_way = jnp.any(touches[:, None, None] & pair.is_a[:, :, None] & pair.is_b[:, None, :], axis=0)
    return one_way | one_way.T
