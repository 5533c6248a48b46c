"""Poles, beams and pendulums: mechanisms that are balanced or swung up."""

from __future__ import annotations

import math

import jax.numpy as jnp

from jax2d.scene import Capacity
from jax2d.settings import Settings
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    GRAVITY_M_S2,
    NEWTON,
    WALL_MARGIN_M,
    Draws,
    Joint,
    Mechanism,
    Part,
    Task,
    Thruster,
    given,
)
from kinetix_dist.level.walls import FLOOR_TOP_M

MAX_PENDULUM_LINKS = 3
MOTOR_RAD_S2 = Settings.base_motor_power  # that a motor of power 1 gives to its two bodies alone


@family("cartpole", polygons=2, circles=1, joints=1, thrusters=2)
def build_cartpole(draws: Draws, capacity: Capacity) -> Mechanism:
    """A green pole that stands on a cart, held by nothing but a hinge. Wheels with motors, or thrusters to both sides.

    Where there is room, two fifths have a disc at the tip of the pole, and the disc is green instead."""
    may_roll = capacity.circles >= 3 and capacity.joints >= 3
    may_have_tip = capacity.circles >= 4 and capacity.joints >= 4
    may_fly = capacity.thrusters >= 2
    has_wheels = draws.chance(0.6) & may_roll if may_fly else jnp.array(True)
    cart_half = jnp.stack([draws.between(0.25, 0.45), draws.between(0.08, 0.14)])
    pole_half = jnp.stack([draws.between(0.04, 0.07), draws.between(0.35, 0.75)])
    tilt = draws.between(-0.06, 0.06)
    radius = draws.between(0.12, 0.2)
    hinge_at = jnp.stack([jnp.zeros((), jnp.float32), 0.6 * cart_half[1]])
    up = jnp.stack([-jnp.sin(tilt), jnp.cos(tilt)])
    cart = Part(position=jnp.zeros(2, jnp.float32), half=cart_half)
    has_tip = draws.chance(0.4) if may_have_tip else jnp.array(False)
    pole_role = jnp.where(has_tip, Role.NONE, Role.GREEN)
    pole = Part(position=hinge_at + 0.95 * pole_half[1] * up, angle=tilt, half=pole_half, role=pole_role)
    parts, joints = [cart, pole], [Joint(a=0, b=1, at=hinge_at, has_motor=False)]
    if may_roll:
        for side in (-1.0, 1.0):
            axle = jnp.stack([side * 0.8 * cart_half[0], -0.7 * cart_half[1]])
            parts.append(Part(position=axle, radius=radius, active=has_wheels))
            joints.append(Joint(a=0, b=len(parts) - 1, at=axle, active=has_wheels))
    mass = 4.0 * (cart_half[0] * cart_half[1] + pole_half[0] * pole_half[1])
    if may_have_tip:
        tip, tip_radius = hinge_at + 1.9 * pole_half[1] * up, draws.between(0.09, 0.19)
        parts.append(Part(position=tip, radius=tip_radius, role=Role.GREEN, active=has_tip))
        joints.append(Joint(a=1, b=len(parts) - 1, at=tip, is_weld=True, active=has_tip))
        mass = mass + jnp.where(has_tip, math.pi * tip_radius**2, 0.0)
    thrusters = []
    if may_fly:
        power = draws.between(1.2, 2.5) * mass * GRAVITY_M_S2 * NEWTON
        for colour, side in enumerate((-1.0, 1.0)):
            at = jnp.stack([side * 0.8 * cart_half[0], jnp.zeros((), jnp.float32)])
            angle = jnp.asarray(0.0 if side < 0.0 else math.pi)
            thrusters.append(Thruster(part=0, at=at, angle=angle, power=power, colour=colour, active=~has_wheels))
    # The goal is as high as the upper half of the pole: one that fell hardly reaches it.
    return Mechanism(
        parts=parts,
        joints=joints,
        thrusters=thrusters,
        task=Task(
            goal_rise_low=0.55,
            goal_rise_span=0.4,
            drawn_nearness=given(jnp.where(draws.chance(0.3), 1, 3)),
            has_bump=False,
            floor_is_red=given(draws.chance(0.8)),
        ),
    )


@family("beam", polygons=1, circles=3, joints=1)
def build_beam(draws: Draws, capacity: Capacity) -> Mechanism:
    """A beam on a pivot with a motor, and a green disc on one side of it; the goal is above the other end."""
    half = jnp.stack([draws.between(0.9, 1.7), draws.between(0.05, 0.08)])
    ball = draws.between(0.1, 0.22)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    pivot = draws.between(0.1, 0.16)
    start = -side * draws.between(0.1, 0.8) * (half[0] - ball)
    parts = [
        # Below the upper side of the beam: a disc that rolls along it passes.
        Part(position=jnp.stack([jnp.zeros((), jnp.float32), 0.5 * half[1] - pivot]), radius=pivot, is_fixed=True),
        Part(position=jnp.zeros(2, jnp.float32), half=half),
        Part(position=jnp.stack([start, half[1] + ball + CLEARANCE_M]), radius=ball, role=Role.GREEN),
    ]
    joints = [Joint(a=0, b=1, at=jnp.zeros(2, jnp.float32), limit=given(draws.between(0.15, 0.5)))]
    # A disc that rolls below the goal touches it where the beam is held about level.
    goal_radius = draws.between(0.08, 0.15)
    goal_y = half[1] + 2.0 * ball + draws.between(0.1, 0.8) * goal_radius
    goal = jnp.stack([side * draws.between(0.6, 0.95) * half[0], goal_y])
    middle = jnp.stack([draws.between(1.9, WORLD_SIZE_M - 1.9), draws.between(FLOOR_TOP_M + 1.1, 3.2)])
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(middle), goal=goal, goal_radius=given(goal_radius), floor_is_red=given(draws.chance(0.7))
        ),
    )


@family("pendulum", polygons=1, circles=2, joints=1)
def build_pendulum(draws: Draws, capacity: Capacity) -> Mechanism:
    """A chain of up to three links that hangs from a fixed disc, with motors in some of its joints, in four fifths too
    weak to hold it level; the last link is green, or a box at its end. The goal is beside or above: it has to be swung
    up."""
    has_room = capacity.polygons - NUM_WALLS >= 3 and capacity.joints >= 3
    num_links = min(capacity.polygons - NUM_WALLS - has_room, capacity.joints - has_room, MAX_PENDULUM_LINKS)
    count, reach = draws.number(1, num_links), draws.between(0.7, 1.6)
    has_bob = draws.chance(0.4) if has_room else jnp.array(False)
    length, width = reach / count, draws.between(0.04, 0.07)
    driven = draws.number(0, num_links - 1) % count  # one at least
    parts, joints = [Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.08, 0.16), is_fixed=True)], []
    zero = jnp.zeros((), jnp.float32)
    for link in range(num_links):
        role = jnp.where((link == count - 1) & ~has_bob, Role.GREEN, Role.NONE)
        top = jnp.stack([zero, -link * length])
        half = jnp.stack([width, 0.5 * length + width])
        parts.append(Part(position=top - 0.5 * jnp.stack([zero, length]), half=half, role=role, active=link < count))
        has_motor = (driven == link) | draws.chance(0.4)
        joints.append(Joint(a=link, b=link + 1, at=top, has_motor=has_motor, active=link < count))
    size = draws.between(0.09, 0.2)
    if has_room:
        end = jnp.stack([zero, -reach])
        parts.append(Part(position=end, half=jnp.stack([size, size]), role=Role.GREEN, active=has_bob))
        # The last link that there is holds it.
        joints += [
            Joint(a=1 + link, b=len(parts) - 1, at=end, is_weld=True, active=has_bob & (link == count - 1))
            for link in range(num_links)
        ]
    # The power that holds all links level from the disc, with a torque of m g reach / 2: a motor gives MOTOR_RAD_S2
    # times its power times the moment of inertia of the first link, m / count (reach / count)^2 / 12.
    holding = 6.0 * GRAVITY_M_S2 * count**3 / (MOTOR_RAD_S2 * reach)
    # Away from where it hangs, and not so far that the end of it, straight, is short of the goal.
    goal_radius, side = draws.between(0.12, 0.3), jnp.where(draws.chance(0.5), 1.0, -1.0)
    angle = side * draws.between(0.3 * math.pi, math.pi)  # from straight down
    goal = draws.between(0.75, 1.05) * reach * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    room = reach + goal_radius + WALL_MARGIN_M + 0.1
    x = draws.between(jnp.minimum(room, 0.5 * WORLD_SIZE_M), WORLD_SIZE_M - jnp.minimum(room, 0.5 * WORLD_SIZE_M))
    low = FLOOR_TOP_M + reach + 2.0 * size + WALL_MARGIN_M
    y = draws.between(low, jnp.maximum(low, WORLD_SIZE_M - room))
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(jnp.stack([x, y])),
            goal=goal,
            goal_radius=given(goal_radius),
            motor_power=given(jnp.where(draws.chance(0.8), draws.between(0.1, 0.9), 4.0) * holding),
            floor_is_red=given(draws.chance(0.2)),
        ),
    )
