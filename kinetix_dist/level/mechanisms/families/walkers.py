"""Mechanisms that move on legs, and snakes."""

from __future__ import annotations

import math

import jax.numpy as jnp

from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS, Role
from kinetix_dist.level.mechanisms.links import Body, Link, add_link
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import Draws, Joint, Mechanism, Part, Task, given

MAX_LEGS = 3  # of a walker
MAX_SNAKE_LINKS = 6


@family("walker", polygons=2, circles=1, joints=1)
def build_walker(draws: Draws, capacity: Capacity) -> Mechanism:
    """A torso on legs of one or two links: as many as there is room for, 2 at least where there is."""
    room = min(capacity.polygons - NUM_WALLS - 1, capacity.joints)
    max_legs = min(room, MAX_LEGS)
    has_shins = room >= 2 * max_legs
    torso_half = jnp.stack([draws.between(0.2, 0.5), draws.between(0.08, 0.16)])
    body = Body(parts=[Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)])
    num_legs, with_shins = draws.number(min(2, max_legs), max_legs), draws.chance(0.6)
    thigh, shin = (jnp.stack([draws.between(0.04, 0.08), draws.between(0.14, 0.28)]) for _ in range(2))
    for leg in range(max_legs):
        # Hips are spread evenly under the torso, whatever the number of legs.
        share = (leg + 0.5) / jnp.maximum(num_legs, 1) * 2.0 - 1.0
        hip = jnp.stack([0.85 * share * torso_half[0], -0.7 * torso_half[1]])
        active = leg < num_legs
        knee = add_link(draws, body, Link(half=thigh, active=active), of=0, at=hip)
        if has_shins:
            add_link(draws, body, Link(half=shin, active=active & with_shins), of=body.last, at=knee)
    return Mechanism(parts=body.parts, joints=body.joints)


@family("runner", polygons=4, circles=1, joints=3)
def build_runner(draws: Draws, capacity: Capacity) -> Mechanism:
    """A torso on one leg or two legs of thigh, shin and foot, as hoppers and cheetahs have: knees and feet one way.

    Feet may be of one piece with the shins, and the motors of colours of their own; where the goal is at any distance,
    it has to run for seconds.
    """
    legs = 2 if min(capacity.polygons - NUM_WALLS - 1, capacity.joints) >= 6 else 1
    has_two = draws.chance(0.6) & (legs == 2)
    along, across = draws.between(0.35, 0.7), draws.between(0.07, 0.13)
    # One leg carries an upright torso, two a level one.
    upright = jnp.stack([draws.between(0.1, 0.15), draws.between(0.22, 0.36)])
    torso_half = jnp.where(has_two, jnp.stack([along, across]), upright)
    body = Body(parts=[Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)])
    bend = draws.between(0.0, 0.5)
    thigh, shin = (jnp.stack([draws.between(0.05, 0.075), draws.between(0.17, 0.27)]) for _ in range(2))
    foot = jnp.stack([draws.between(0.12, 0.22), draws.between(0.04, 0.055)])
    is_stiff, goal_is_anywhere, colours_in_turn = draws.chance(0.4), draws.chance(0.5), draws.chance(0.5)
    for leg in range(legs):
        active = has_two if leg else jnp.array(True)
        hip = jnp.stack([jnp.where(has_two, (0.8 if leg else -0.8) * torso_half[0], 0.0), -0.7 * torso_half[1]])
        knee = add_link(draws, body, Link(half=thigh, active=active, lean=bend), of=0, at=hip)
        ankle = add_link(draws, body, Link(half=shin, active=active, lean=-bend), of=body.last, at=knee)
        body.parts.append(Part(position=ankle + jnp.stack([0.4 * foot[0], 0.0]), half=foot, active=active))
        limit, of = draws.between(0.4, 0.9), body.last - 1
        body.joints.append(Joint(a=of, b=of + 1, at=ankle, limit=given(limit), is_weld=is_stiff, active=active))
    return Mechanism(
        parts=body.parts,
        joints=body.joints,
        task=Task(
            is_handed=True, drawn_nearness=given(jnp.where(goal_is_anywhere, 1, 2)), colours_in_turn=colours_in_turn
        ),
    )


@family("sprinter", polygons=8, circles=1, joints=6)
def build_sprinter(draws: Draws, capacity: Capacity) -> Mechanism:
    """A hopper, a walker whose two legs have one hip, a cheetah or a swimmer on the floor, as in MuJoCo's tasks, with
    motors at their limits, weak ones or any. Knees bend to both sides or mostly to one; of hoppers and
    walkers a fifth have stiff ones, and a few have no feet. The goal is at any distance, near in a third of the levels
    and at the far wall in another, and often a tall box."""
    form = draws.number(0, 6)  # 0 and 1: a hopper
    is_walker, is_cheetah, is_swimmer = (form == 2) | (form == 3), (form == 4) | (form == 5), form == 6
    width = draws.between(0.045, 0.075)
    upright = jnp.stack([width * draws.between(1.0, 2.2), draws.between(0.14, 0.32)])
    level = jnp.stack([draws.between(0.35, 0.7), draws.between(0.05, 0.1)])
    thigh, shin = (jnp.stack([width, draws.between(0.13, 0.28)]) for _ in range(2))
    torso_half = jnp.where(is_cheetah, level, jnp.where(is_swimmer, thigh[::-1], upright))
    body = Body(parts=[Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)])
    foot = jnp.stack([draws.between(0.08, 0.2), draws.between(0.045, 0.075)])
    is_stiff, legs_are_spread = draws.chance(0.4) | is_cheetah, draws.chance(0.5)
    has_two = is_walker | is_cheetah | (is_swimmer & draws.chance(0.4))
    has_feet, has_knees = ~is_swimmer & draws.chance(0.85), is_swimmer | is_cheetah | draws.chance(0.8)
    bends_one_way, way = draws.chance(0.4) & ~is_swimmer, jnp.where(draws.chance(0.5), 0.75, -0.75)
    knee_bend = jnp.where(bends_one_way, way, 0.0)
    for leg, side in enumerate((1.0, -1.0)):
        active = has_two if leg else jnp.array(True)
        # Of a cheetah each knee is before or behind its hip, of the others hardly.
        bend = draws.between(0.3, 0.85) * jnp.where(draws.chance(0.5), 1.0, -1.0)
        spread = draws.between(0.0, 0.3) * jnp.where(is_walker, side * legs_are_spread, 1.0)
        lean = jnp.where(is_cheetah, bend, spread)
        along = 0.85 * side * torso_half[0] * (is_cheetah | is_swimmer)
        hip = jnp.stack([along, jnp.where(is_swimmer, 0.0, -0.7 * torso_half[1])])
        # A swimmer's links lie in a row.
        leans = [jnp.where(is_swimmer, 0.5 * math.pi * side, lean), jnp.where(is_swimmer, 0.5 * math.pi * side, -lean)]
        knee = add_link(draws, body, Link(half=thigh, active=active, lean=leans[0]), of=0, at=hip)
        lower = Link(half=shin, active=active, lean=leans[1], bend=knee_bend, is_stiff=~has_knees)
        ankle = add_link(draws, body, lower, of=body.last, at=knee)
        body.parts.append(Part(position=ankle + jnp.stack([0.4 * foot[0], 0.0]), half=foot, active=active & has_feet))
        limit, of = draws.between(0.4, 0.9), body.last - 1
        body.joints.append(
            Joint(a=of, b=of + 1, at=ankle, limit=given(limit), is_weld=is_stiff, active=active & has_feet)
        )
    strength, distance = draws.between(0.0, 1.0), draws.between(0.0, 1.0)
    return Mechanism(
        parts=body.parts,
        joints=body.joints,
        task=Task(
            is_handed=True,
            slab=given(jnp.stack([draws.between(0.12, 0.25), draws.between(0.25, 0.8)])),
            goal_is_slab=draws.chance(0.6),
            drawn_nearness=given(jnp.where(distance < 0.3, 0, jnp.where(distance < 0.65, 1, 3))),
            has_bump=False,
            has_full_motors=strength < 0.45,
            has_weak_motors=strength > 0.7,
            colours_in_turn=draws.chance(0.8),
            floor_is_red=given(draws.chance(0.45) & ~is_swimmer),
        ),
    )


@family("snake", polygons=2, circles=1, joints=1)
def build_snake(draws: Draws, capacity: Capacity) -> Mechanism:
    """Links in a row on the floor, one of them green."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints + 1, MAX_SNAKE_LINKS)
    count = draws.number(min(3, num_links), num_links)
    half = jnp.stack([draws.between(0.75, 1.1) / (count + 1.0), draws.between(0.05, 0.09)])
    green = draws.number(0, num_links - 1) % count
    step, limit = 1.7 * half[0], draws.between(0.7, 1.4)
    parts = [
        Part(
            position=jnp.stack([link * step, jnp.zeros((), jnp.float32)]),
            half=half,
            role=jnp.where(green == link, Role.GREEN, Role.NONE),
            active=link < count,
        )
        for link in range(num_links)
    ]
    joints = [
        Joint(
            a=link,
            b=link + 1,
            at=jnp.stack([(link + 0.5) * step, jnp.zeros((), jnp.float32)]),
            limit=given(limit),
            active=link + 1 < count,
        )
        for link in range(num_links - 1)
    ]
    return Mechanism(parts=parts, joints=joints, task=Task(goal_nearness=3, floor_is_red=given(jnp.array(False))))
