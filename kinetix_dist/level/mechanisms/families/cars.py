"""Cars and unicycles, and cars that push or carry a load."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import Role
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import CLEARANCE_M, Draws, Joint, Mechanism, Part, Task, extent, given


@family("unicycle", polygons=1, circles=2, joints=1)
def build_unicycle(draws: Draws, capacity: Capacity) -> Mechanism:
    """A box above a wheel."""
    radius = draws.between(0.14, 0.28)
    # Tall enough that it stands out above the wheel: green must touch blue.
    half = jnp.stack([draws.between(0.1, 0.3), draws.between(0.8 * radius, 0.35)])
    height = half[1] * draws.between(0.75, 0.95)
    wheel = Part(position=jnp.zeros(2, jnp.float32), radius=radius)
    body = Part(position=jnp.stack([jnp.zeros((), jnp.float32), height]), half=half, role=Role.GREEN)
    return Mechanism(parts=[body, wheel], joints=[Joint(a=0, b=1, at=jnp.zeros(2, jnp.float32))])


@family("car", polygons=1, circles=3, joints=2)
def build_car(draws: Draws, capacity: Capacity) -> Mechanism:
    """A chassis on two wheels of different sizes, both on the floor. It is about as long as the wheels reach, so that
    no wheel keeps green from the goal."""
    return scaled_car(draws, jnp.ones((), jnp.float32))


def scaled_car(draws: Draws, scale: Array) -> Mechanism:
    """A car with all its lengths times `scale`."""
    radii = [scale * draws.between(0.14, 0.28) for _ in range(2)]
    along = scale * draws.between(0.3, 0.55)  # half the distance of the axles, level
    axles = [jnp.stack([-along, radii[0]]), jnp.stack([along, radii[1]])]
    slope = jnp.arctan2(radii[1] - radii[0], 2.0 * along)
    wheelbase = jnp.hypot(2.0 * along, radii[1] - radii[0])
    reach = 0.5 * wheelbase + draws.between(0.85, 1.3) * jnp.maximum(*radii)
    half = jnp.stack([reach, scale * draws.between(0.07, 0.16)])
    up = jnp.stack([-jnp.sin(slope), jnp.cos(slope)])
    centre = 0.5 * (axles[0] + axles[1]) + 0.5 * half[1] * up
    chassis = Part(position=centre, angle=slope, half=half, role=Role.GREEN)
    wheels = [Part(position=axle, radius=radius) for axle, radius in zip(axles, radii, strict=True)]
    return Mechanism(parts=[chassis, *wheels], joints=[Joint(a=0, b=1 + k, at=axle) for k, axle in enumerate(axles)])


@family("pusher", polygons=2, circles=3, joints=2)
def build_pusher(draws: Draws, capacity: Capacity) -> Mechanism:
    """A car and, before it, a load to push to the goal: a green box, or a disc where there is room for one more."""
    car = build_car(draws, capacity)
    chassis, *wheels = car.parts
    _, highest = extent(car.parts)
    size = draws.between(0.1, 0.22)
    at = jnp.stack([highest[0] + draws.between(0.05, 0.5) + size, jnp.zeros((), jnp.float32)])
    is_disc = draws.chance(0.5) if capacity.circles >= 4 else jnp.array(False)
    loads = [
        Part(
            position=at + jnp.stack([jnp.zeros((), jnp.float32), size]),
            half=jnp.stack([size, size]),
            role=Role.GREEN,
            active=~is_disc,
        )
    ]
    if capacity.circles >= 4:
        loads.append(
            Part(
                position=at + jnp.stack([jnp.zeros((), jnp.float32), size]),
                radius=size,
                role=Role.GREEN,
                active=is_disc,
            )
        )
    parts = [dataclasses.replace(chassis, role=Role.NONE), *wheels, *loads]
    return Mechanism(
        parts=parts,
        joints=car.joints,
        task=Task(
            is_handed=True, has_bump=False, goal_rise_low=0.0, goal_rise_span=0.1, floor_is_red=given(jnp.array(False))
        ),
    )


@family("carrier", polygons=5, circles=4, joints=4)
def build_carrier(draws: Draws, capacity: Capacity) -> Mechanism:
    """A car with a green box or disc on it that nothing holds, between low walls: it is carried to the goal. Where the
    goal is a slab on the floor there is no wall in front, and the load has to come off there; in two fifths of these it
    falls onto the car first."""
    radius, along = draws.between(0.12, 0.2), draws.between(0.35, 0.6)
    half = jnp.stack([along + draws.between(0.0, 0.2), draws.between(0.04, 0.08)])
    top = 2.0 * radius + CLEARANCE_M  # no wheel stands out above the chassis
    parts = [Part(position=jnp.stack([jnp.zeros((), jnp.float32), top - half[1]]), half=half)]
    joints: list[Joint] = []
    for side in (-1.0, 1.0):
        axle = jnp.stack([side * along, radius])
        joints.append(Joint(a=0, b=len(parts), at=axle))
        parts.append(Part(position=axle, radius=radius))
    goal_is_slab = draws.chance(0.4)
    wall = jnp.stack([jnp.full((), 0.03, jnp.float32), draws.between(0.02, 0.1)])  # a disc rolls over low ones
    for side in (-1.0, 1.0):
        active = ~goal_is_slab if side > 0.0 else jnp.array(True)
        foot = jnp.stack([side * (half[0] - wall[0]), top - half[1]])
        joints.append(Joint(a=0, b=len(parts), at=foot, is_weld=True, active=active))
        parts.append(Part(position=jnp.stack([foot[0], top + wall[1] - 0.5 * half[1]]), half=wall, active=active))
    size = draws.between(0.09, 0.16)
    room = half[0] - 2.0 * wall[0] - size - CLEARANCE_M
    at = jnp.stack([room * draws.between(-1.0, 0.5), top + size + CLEARANCE_M])
    is_disc = draws.chance(0.6)
    falls = goal_is_slab & draws.chance(0.4)
    at = at.at[1].add(jnp.where(falls, draws.between(0.05, 0.3), 0.0))
    parts.append(Part(position=at, half=jnp.stack([size, size]), role=Role.GREEN, active=~is_disc))
    parts.append(Part(position=at, radius=size, role=Role.GREEN, active=is_disc))
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            is_handed=True,
            slab=given(jnp.stack([draws.between(0.3, 0.9), draws.between(0.02, 0.06)])),
            goal_is_slab=goal_is_slab,
            goal_rise_low=0.75,
            goal_rise_span=0.23,
            has_bump=False,
            floor_is_red=given(draws.chance(0.6)),
        ),
    )
