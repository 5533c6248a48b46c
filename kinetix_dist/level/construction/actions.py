"""Effect of an action on a level that is being built."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist.level.construction.allowed import (
    anchor_point,
    attachment,
    held_at,
    in_cell,
    is_free_joint,
    is_free_place,
    overlaps,
)
from kinetix_dist.level.construction.records import (
    BOXES,
    HEADS,
    JOINED,
    LIMITS_RAD,
    NUM_ANGLES,
    NUM_SIZES,
    NUM_SPEEDS,
    NUM_STRENGTHS,
    RED,
    Addition,
    Construction,
    Motor,
    is_describing,
    is_one_of,
    is_placing,
    largest_radius,
)
from kinetix_dist.level.draft import (
    Draft,
    DrivenJoints,
    DrivenThrusters,
    Ends,
    MotorAndLimits,
    Shapes,
    first_free,
    joint_row,
    read_slot,
    write_slot,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Role
from kinetix_dist.level.proposals import box_or_triangle, shape_mass

_AT = {name: number for number, name in enumerate(HEADS)}


def apply_action(
    building: Construction, step: Array, action: Array, draws: Array, capacity: Capacity, config: GeneratorConfig
) -> Construction:
    """The construction after one action.

    step: int32, its number; action [heads] int: a choice of each head, all of them allowed; draws [NUM_DRAWS] in
    [0, 1). A shape that is put where it does not fit is left out; other choices that are masked are not looked for,
    and may build no valid level.
    """
    choice = {name: action[_AT[name]].astype(jnp.int32) for name in HEADS}
    describes, places = is_describing(step, capacity), is_placing(step, capacity)
    shape, own_anchor = _described(building, step, choice, draws, config)
    draft = _with_shape(building, choice, draws, places, capacity, config)
    draft = _with_thruster(draft, choice, draws, ~describes & ~places, config)
    return Construction(
        draft=draft,
        addition=jnp.where(describes, choice["addition"], building.addition),
        shape=jax.tree.map(lambda new, old: jnp.where(describes, new, old), shape, building.shape),
        own_anchor=jnp.where(describes, own_anchor, building.own_anchor),
    )


def _described(
    building: Construction, step: Array, choice: dict[str, Array], draws: Array, config: GeneratorConfig
) -> tuple[Shapes, Array]:
    """The described shape, at the origin, and the point of a joint on it."""
    is_box = is_one_of(choice["addition"], BOXES)
    limit = config.max_shape_size / 2.0 / math.sqrt(2.0)
    longest = limit * max(1.0, config.large_rectangle_scale)
    width = _within(choice["width"], draws[0], NUM_SIZES, config.min_half_extent, longest)
    height = _within(choice["height"], draws[1], NUM_SIZES, config.min_half_extent, limit)
    radius = _within(choice["width"], draws[0], NUM_SIZES, config.min_radius, largest_radius(config))
    corners, num_corners = box_or_triangle(
        jnp.stack([width, height]), jnp.array(False), building.shape.vertices.shape[0]
    )
    number = step // 2
    plain_or_red = jnp.where(is_one_of(choice["addition"], RED), Role.RED, Role.NONE)
    role = jnp.where(number == 0, Role.GREEN, jnp.where(number == 1, Role.BLUE, plain_or_red))
    shape = Shapes(
        active=jnp.array(True),
        position=jnp.zeros(2, jnp.float32),
        angle=_within(choice["angle"], draws[2], NUM_ANGLES, 0.0, 2.0 * math.pi),
        vertices=jnp.where(is_box, corners, 0.0),
        num_vertices=jnp.where(is_box, num_corners, 0),
        radius=jnp.where(is_box, 0.0, radius),
        role=role.astype(jnp.int32),
        is_fixed=jnp.array(False),
        body=jnp.int32(0),
        num_joints=jnp.int32(0),
        added_at=number.astype(jnp.int32),
    )
    own_anchor = jnp.where(is_box, anchor_point(shape, choice["own_anchor"], draws[3:5]), 0.0)
    return shape, own_anchor


def _with_shape(
    building: Construction,
    choice: dict[str, Array],
    draws: Array,
    do: Array,
    capacity: Capacity,
    config: GeneratorConfig,
) -> Draft:
    """The draft with the described shape and its joint, unless it fits nowhere."""
    draft, polygons = building.draft, capacity.polygons
    shapes = draft.shapes
    is_box, is_joined = is_one_of(building.addition, BOXES), is_one_of(building.addition, JOINED)
    fits = jnp.where(
        is_joined,
        is_free_joint(building, choice["attach"], capacity),
        is_free_place(building, choice["place"]),
    )
    do = do & (building.addition != Addition.NOTHING) & fits
    free_box, free_circle = first_free(shapes.active[:polygons]), polygons + first_free(shapes.active[polygons:])
    slot = jnp.where(is_box, free_box, free_circle).astype(jnp.int32)

    # Anywhere in its cell where that is free, else in the middle.
    somewhere, middle = in_cell(choice["place"], draws[0:2]), in_cell(choice["place"], jnp.full(2, 0.5, jnp.float32))
    stands = jnp.where(overlaps(building, somewhere), middle, somewhere)
    target, anchor = attachment(choice["attach"])
    partner = read_slot(shapes, target)
    anchor_partner = anchor_point(partner, anchor)
    shape = dataclasses.replace(
        building.shape,
        position=jnp.where(is_joined, held_at(building, partner, anchor_partner), stands),
        is_fixed=~is_joined & (choice["is_fixed"] == 1),
        body=jnp.where(is_joined, partner.body, slot),
        num_joints=is_joined.astype(jnp.int32),
    )
    after = write_slot(shapes, slot, shape, do)
    holds = (jnp.arange(capacity.shapes) == target) & do & is_joined
    after = dataclasses.replace(after, num_joints=after.num_joints + holds)
    both_boxes = is_box & (target < polygons)
    ends = Ends(a=target, b=slot, anchor_a=anchor_partner, anchor_b=building.own_anchor)
    joint = _joint(ends, building.shape.angle - partner.angle, choice, draws, both_boxes, config)
    joints = write_slot(draft.driven_joints, first_free(draft.joints.active), joint, do & is_joined)
    return dataclasses.replace(draft, shapes=after, driven_joints=joints)


def _joint(
    ends: Ends,
    rest_angle: Array,
    choice: dict[str, Array],
    draws: Array,
    both_boxes: Array,
    config: GeneratorConfig,
) -> DrivenJoints:
    """A joint from the partner to the new shape; `derive` puts the ends into their order."""
    is_weld, is_driven = choice["motor"] == Motor.WELD, choice["motor"] == Motor.DRIVEN
    limit = jnp.where(both_boxes, jnp.array(LIMITS_RAD, jnp.float32)[choice["limits"]], 0.0)
    strongest = jnp.where(both_boxes, config.motor_power_max, config.wheel_power_max)
    weakest = jnp.minimum(config.motor_power_min, strongest)
    speed = _within(choice["speed"], draws[5], NUM_SPEEDS, config.motor_speed_min, config.motor_speed_max)
    power = _within(choice["strength"], draws[6], NUM_STRENGTHS, weakest, strongest)
    hinge = MotorAndLimits(
        motor_on=is_driven,
        speed=speed,
        power=power,
        has_limits=limit > 0,
        lower_limit=-limit,
        upper_limit=limit,
        colour=choice["colour"],
    )
    return joint_row(ends, is_weld, rest_angle, hinge)


def _with_thruster(draft: Draft, choice: dict[str, Array], draws: Array, do: Array, config: GeneratorConfig) -> Draft:
    body, anchor = attachment(choice["attach"])
    shape = read_slot(draft.shapes, body)
    factor = _within(choice["strength"], draws[6], NUM_STRENGTHS, 0.5, 2.0)
    thruster = Thrusters(
        active=jnp.array(True),
        body=body,
        position=anchor_point(shape, anchor),
        angle=_within(choice["angle"], draws[2], NUM_ANGLES, 0.0, 2.0 * math.pi),
        power=shape_mass(shape) * config.thruster_power_factor * factor,
    )
    row = DrivenThrusters(thrusters=thruster, colour=choice["colour"])
    slot = first_free(draft.thrusters.active)
    after = write_slot(draft.driven_thrusters, slot, row, do & (choice["addition"] == Addition.THRUSTER))
    return dataclasses.replace(draft, driven_thrusters=after)


def _within(choice: Array, draw: Array, num_choices: int, low: Array | float, high: Array | float) -> Array:
    """The quantity of a choice: `draw` of its part of the range."""
    return low + (choice + draw) / num_choices * (high - low)
