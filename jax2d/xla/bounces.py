"""Restitution: what hit in a step leaves with its share of the speed of the impact. What is jointed to it or touches it
has a part in that.

Once the sub-steps are solved, rounds of passes over joints and contacts go on until every bounce has its speed. They
change velocities only: impulses remembered for the next step are those of before, since a bounce does not last. Bounces
give a world no more energy than the step began with, and motors and thrusters have added since.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.xla import contacts as contacts_of
from jax2d.xla import joints as joints_of
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Motion
from jax2d.xla.branching import in_any_world
from jax2d.xla.contacts import Contacts, Leaving
from jax2d.xla.joints import Joints
from jax2d.xla.parameters import Parameters, Rules, Scalar

JOINT_PASSES = 2  # a round: along a chain a bounce goes joint by joint
ROUNDING = 1e-5  # share of the energy that sums in float32 may be wrong by


class Round(NamedTuple):
    bodies: Bodies
    joints: Joints
    contacts: Contacts
    leaving: Leaving
    settled: jax.Array  # [] bool, everything leaves with its speed, as far as any push can make it
    rubbed: jax.Array  # [] bool, friction has acted
    done: jax.Array  # [] bool


def bounce(
    bodies: Bodies,
    joints: Joints,
    contacts: Contacts,
    leaving_speed: jax.Array,
    most_energy: jax.Array,
    gravity: jax.Array,
    params: Parameters,
    rules: Rules,
) -> Bodies:
    """Bodies after the bounces of one world; `leaving_speed` [K] m/s is zero where a contact does not bounce."""

    def rounds() -> Motion:
        def one_round(now: Round, index: jax.Array) -> tuple[Round, None]:
            bodies, joints, contacts = now.bodies, now.joints, now.contacts
            for _ in range(JOINT_PASSES):
                bodies, joints = joints_of.solve_soft(bodies, joints, params, use_bias=False, motors=False)
            rub = ~now.rubbed & (now.settled | (index == rules.bounce_rounds - 1))
            bodies, contacts, leaving, settled = contacts_of.solve_bounces(
                bodies, contacts, now.leaving, index == 0, rub, params
            )
            after = Round(bodies, joints, contacts, leaving, settled, now.rubbed | rub, now.rubbed & settled)
            return jax.tree.map(lambda x, y: jnp.where(now.done, x, y), now, after), None

        leaving = Leaving(leaving_speed, contacts.mass_normal, contacts.approach)
        no, none_bounces = jnp.array(False), ~jnp.any(leaving_speed > 0)
        start = Round(bodies, joints, contacts, leaving, settled=no, rubbed=no, done=none_bounces)
        end, _ = jax.lax.scan(one_round, start, jnp.arange(rules.bounce_rounds))
        return limit(bodies, end.bodies, most_energy, gravity, params.h)

    # Worlds are stepped together, and mostly nothing bounces in any of them.
    motion = jax.lax.cond(in_any_world(jnp.any(leaving_speed > 0)), rounds, lambda: bodies.motion)
    return bodies._replace(motion=motion)


def energy(bodies: Bodies, motion: Motion, gravity: jax.Array, h: Scalar) -> jax.Array:
    """J, that of semi-implicit Euler, which keeps m |v + g h / 2|^2 / 2 - m g.x in free flight to the last digit; zero
    of height is where each body was when contacts were found."""
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    midway = motion.velocity + 0.5 * h * gravity
    kinetic = 0.5 * (mass * vec2.dot(midway, midway) + inertia * motion.omega * motion.omega)
    return jnp.sum(kinetic - mass * vec2.dot(bodies.delta, gravity))


def limit(before: Bodies, after: Bodies, most: jax.Array, gravity: jax.Array, h: Scalar) -> Motion:
    """Where several bodies, joints or friction share in an impact, restitution contact by contact may ask for more than
    there is. Then everything gets the same share of its change of velocity: joints and contacts stay solved."""
    mass, inertia = vec2.inverse_or_zero(before.inverse_mass), vec2.inverse_or_zero(before.inverse_inertia)
    change = jax.tree.map(jnp.subtract, after.motion, before.motion)
    midway = before.motion.velocity + 0.5 * h * gravity
    linear = jnp.sum(mass * vec2.dot(midway, change.velocity) + inertia * before.motion.omega * change.omega)
    quadratic = 0.5 * jnp.sum(mass * vec2.dot(change.velocity, change.velocity) + inertia * change.omega**2)
    was = energy(before, before.motion, gravity, h)
    too_much = (was + linear + quadratic > most * (1 + ROUNDING)) & (quadratic > 0)
    root = vec2.sqrt_or_zero(linear * linear + 4 * quadratic * jnp.maximum(most - was, 0))
    share = jnp.clip((root - linear) / (2 * jnp.where(too_much, quadratic, 1)), 0, 1)
    return jax.tree.map(lambda x, dx, y: jnp.where(too_much, x + share * dx, y), before.motion, change, after.motion)
