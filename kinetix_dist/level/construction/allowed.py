"""Masks of the choices that a step allows, and the cells and anchors where a described shape fits."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.construction.records import (
    ANCHORS,
    BOXES,
    GRID,
    HEADS,
    JOINED,
    Addition,
    Construction,
    head_sizes,
    is_describing,
    is_one_of,
    is_placing,
    num_steps,
)
from kinetix_dist.level.draft import Draft, Shapes, read_slot
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, WORLD_SIZE_M, Role
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.walls import FLOOR_TOP_M


def allowed(building: Construction, step: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Array, ...]:
    """[choices] bool of each head; at least one choice of each is allowed.

    step: int32, number of the action to come. The same for a whole batch (`jax.vmap` with `in_axes` None), it saves
    the search for places in steps that place nothing.
    """
    describes, places = is_describing(step, capacity), is_placing(step, capacity)
    pushes = ~describes & ~places
    joins = places & is_one_of(building.addition, JOINED)
    stands_free = places & ~joins & (building.addition != Addition.NOTHING)
    nowhere = jnp.zeros(GRID**2, bool), jnp.zeros((capacity.shapes - NUM_WALLS) * ANCHORS**2, bool)
    place, attach = jax.lax.cond(
        places, lambda: (free_places(building, capacity), free_joints(building, capacity)), lambda: nowhere
    )
    is_placed, is_joined = stands_free & place.any(), joins & attach.any()

    def if_(condition: Array, choices: Array) -> Array:
        """The choices where the head has a meaning, else choice 0 alone."""
        return jnp.where(condition, choices, jnp.arange(choices.shape[0]) == 0)

    everything = {name: jnp.ones(size, bool) for name, size in zip(HEADS, head_sizes(capacity), strict=True)}
    colours = jnp.arange(everything["colour"].shape[0])
    on_thruster = jnp.repeat(_can_carry(building.draft)[NUM_WALLS:], ANCHORS**2)
    masks = {
        "addition": jnp.where(
            describes, _describable(building, step, capacity), if_(pushes, _thruster_or_none(building, step, capacity))
        ),
        "width": if_(describes, everything["width"]),
        "height": if_(describes, everything["height"]),
        "angle": if_(describes | pushes, everything["angle"]),
        "own_anchor": if_(describes, everything["own_anchor"]),
        "place": if_(is_placed, place),
        "attach": jnp.where(pushes, on_thruster, if_(is_joined, attach)),
        "is_fixed": if_(is_placed & _may_be_fixed(building, step, capacity, config), everything["is_fixed"]),
        "motor": if_(is_joined, everything["motor"]),
        "limits": if_(is_joined, everything["limits"]),
        "strength": if_(is_joined | pushes, everything["strength"]),
        "speed": if_(is_joined, everything["speed"]),
        "colour": jnp.where(pushes, colours < NUM_THRUSTER_COLOURS, if_(is_joined, colours < NUM_MOTOR_COLOURS)),
    }
    return tuple(masks[name] for name in HEADS)


def _describable(building: Construction, step: Array, capacity: Capacity) -> Array:
    """[len(Addition)] bool: kinds that the next shape can be of."""
    draft, polygons = building.draft, capacity.polygons
    shapes = draft.shapes
    is_first = step < 4  # green, then blue
    room_box, room_circle = ~shapes.active[:polygons].all(), ~shapes.active[polygons:].all()
    holds_box, holds_circle = (can_hold(draft, capacity, is_box).any() for is_box in (True, False))
    may_join, may_be_red = ~is_first & ~draft.joints.active.all(), ~is_first & ~(shapes.role == Role.RED).any()
    can = {
        Addition.NOTHING: ~is_first,
        Addition.BOX: room_box,
        Addition.CIRCLE: room_circle,
        Addition.JOINED_BOX: room_box & holds_box & may_join,
        Addition.JOINED_CIRCLE: room_circle & holds_circle & may_join,
        Addition.RED_BOX: room_box & may_be_red,
        Addition.RED_CIRCLE: room_circle & may_be_red,
        Addition.THRUSTER: jnp.array(False),
    }
    return jnp.stack([can[addition] for addition in Addition])


def _thruster_or_none(building: Construction, step: Array, capacity: Capacity) -> Array:
    """[len(Addition)] bool. The last step has to add a thruster where there is no other control."""
    joints, thrusters = building.draft.joints, building.draft.thrusters
    has_control = (joints.active & joints.motor_on).any() | thrusters.active.any()
    is_last = step == num_steps(capacity) - 1
    addition = jnp.arange(len(Addition))
    return (addition == Addition.THRUSTER) | ((addition == Addition.NOTHING) & (has_control | ~is_last))


def _can_carry(draft: Draft) -> Array:
    """[n] bool: shapes that a thruster can push."""
    return draft.shapes.active & ~draft.shapes.is_fixed


def _may_be_fixed(building: Construction, step: Array, capacity: Capacity, config: GeneratorConfig) -> Array:
    """bool: the generator's rule, by size where the config leaves it open; green and blue are not both fixed."""
    is_small = capacity.shapes - NUM_WALLS <= 3
    allow = not is_small if config.allow_fixed is None else config.allow_fixed
    shapes = building.draft.shapes
    green_is_fixed = ((shapes.role == Role.GREEN) & shapes.is_fixed).any()
    return jnp.array(allow) & ~((step == 3) & green_is_fixed)


_CENTRE = ANCHORS * ANCHORS // 2  # the anchor in the middle


def free_places(building: Construction, capacity: Capacity) -> Array:
    """[GRID^2] bool: cells in whose centre the described shape overlaps nothing."""
    return jax.vmap(lambda cell: is_free_place(building, cell))(jnp.arange(GRID**2))


def is_free_place(building: Construction, cell: Array) -> Array:
    return ~overlaps(building, in_cell(cell, jnp.full(2, 0.5, jnp.float32)))


def free_joints(building: Construction, capacity: Capacity) -> Array:
    """[shapes x ANCHORS^2] bool: joints by which the described shape overlaps no other body."""
    choices = jnp.arange((capacity.shapes - NUM_WALLS) * ANCHORS**2)
    return jax.vmap(lambda choice: is_free_joint(building, choice, capacity))(choices)


def is_free_joint(building: Construction, choice: Array, capacity: Capacity) -> Array:
    shapes = building.draft.shapes
    holds = can_hold(building.draft, capacity, is_one_of(building.addition, BOXES))
    target, anchor = attachment(choice)
    partner = read_slot(shapes, target)
    is_circle = target >= capacity.polygons  # held at its centre
    held = held_at(building, partner, anchor_point(partner, anchor))
    is_free = ~overlaps(building, held, shapes.body == partner.body)
    return holds[target] & (~is_circle | (anchor == _CENTRE)) & is_free


def overlaps(building: Construction, position: Array, ignored: Array | bool = False) -> Array:
    """bool: the described shape there overlaps an active shape that is not ignored ([n] bool)."""
    shapes, new = building.draft.shapes, building.shape
    corners = world_corners(shapes.position, shapes.angle, shapes.vertices)
    new_corners = world_corners(position, new.angle, new.vertices)
    gap = jax.vmap(separation, in_axes=(None, None, 0, 0))(new_corners, new.radius, corners, shapes.radius)
    return ((gap < 0.0) & shapes.active & jnp.logical_not(ignored)).any()


def can_hold(draft: Draft, capacity: Capacity, is_box: Array | bool) -> Array:
    """[n] bool: shapes that a joint can hold a new shape to: no walls, boxes twice, circles once and to a box alone."""
    shapes, slots = draft.shapes, jnp.arange(capacity.shapes)
    is_polygon = slots < capacity.polygons
    has_end = jnp.where(is_polygon, shapes.num_joints < 2, (shapes.num_joints < 1) & is_box)
    return shapes.active & (slots >= NUM_WALLS) & has_end


def in_cell(cell: Array, draw: Array) -> Array:
    """[2] m: a point of a cell of the box."""
    x = (cell % GRID + draw[0]) / GRID * WORLD_SIZE_M
    return jnp.stack([x, FLOOR_TOP_M + (cell // GRID + draw[1]) / GRID * (WORLD_SIZE_M - FLOOR_TOP_M)])


def attachment(choice: Array) -> tuple[Array, Array]:
    """(slot of the shape, number of the anchor on it)"""
    return NUM_WALLS + choice // ANCHORS**2, choice % ANCHORS**2


def anchor_point(shape: Shapes, anchor: Array, draw: Array | float = 0.5) -> Array:
    """[2] m, frame of the shape: in a cell of the box that it is; of a circle, of the square within it."""
    half = jnp.maximum(jnp.abs(shape.vertices).max(0), shape.radius / math.sqrt(2.0))
    cell = jnp.stack([anchor % ANCHORS, anchor // ANCHORS])
    return ((cell + draw) / ANCHORS * 2.0 - 1.0) * half


def held_at(building: Construction, partner: Shapes, anchor: Array) -> Array:
    """[2] m: the centre of the described shape when a joint holds it to this anchor of a partner."""
    joined_at = world_corners(partner.position, partner.angle, anchor[None])[0]
    return joined_at - world_corners(jnp.zeros(2, jnp.float32), building.shape.angle, building.own_anchor[None])[0]
