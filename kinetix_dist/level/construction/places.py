"""Where a shape that was described can go: cells of a grid, and joints to shapes that are there."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.construction.records import ANCHORS, BOXES, GRID, Construction, is_one_of
from kinetix_dist.level.draft import Draft, Shapes, read_slot
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.walls import FLOOR_TOP_M

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
    holds = can_hold(building.draft, capacity, is_one_of(building.what, BOXES))
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
    """[n] bool: whom a joint can hold a new shape to: no walls, boxes twice, circles once and to a box alone."""
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
