"""One proposal of the random level generator: a shape, free or joined to one that exists.

Both kinds are one computation that differs in selects, from one vector of uniform numbers: small to compile, cheap to
draw eight of. A proposal carries a cost (overlaps, plus a fine when one of two joined shapes could never be seen).
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.fields import Array, replace
from jax2d.scene import JointKind
from kinetix_dist.level import published_generator as published
from kinetix_dist.level.draft import (
    Draft,
    DrivenJoints,
    Ends,
    MotorAndLimits,
    Shapes,
    first_free,
    joint_row,
    read_slot,
    write_slot,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_WALLS, WORLD_SIZE_M, Role
from kinetix_dist.level.overlap import inset, reach, separation, world_corners
from kinetix_dist.level.walls import FLOOR_TOP_M

NUM_DRAWS = 28  # uniform numbers that one proposal uses


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Request:
    """Addition requested of one step of the generator (scalars)."""

    is_joined: Array  # bool: joined to an existing shape, else free
    force_motor: Array  # bool: the joint turns and has a motor that is on
    may_be_fixed: Array  # bool
    step: Array  # int32, number of the addition


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Proposal:
    """One shape, where it goes, and the joint that holds it (if it is joined)."""

    shape: Shapes  # without the leading axis
    slot: Array  # int32
    joint: DrivenJoints  # without the leading axis
    target: Array  # int32, shape it is joined to
    is_possible: Array  # bool, False where there is no room or nothing to join
    cost: Array  # overlaps, plus the fine for hidden shapes


class Partner(NamedTuple):
    """The shape that a new one would be joined to."""

    slot: Array  # int32
    shape: Shapes  # without the leading axis
    is_polygon: Array  # bool
    exists: Array  # bool, False where nothing can be joined


def pick(weights: Array, draw: Array) -> Array:
    """Index chosen with the given weights by one uniform number; 0 where all weights are 0."""
    total = jnp.cumsum(jnp.asarray(weights, jnp.float32))
    return jnp.argmax(total > draw * total[-1]).astype(jnp.int32)


def sample_size(draw: Array, config: GeneratorConfig) -> tuple[Array, Array, Array]:
    """Half extents [2] of a box (m), whether one was lengthened, and radius of a circle (m), from 5 uniform numbers."""
    box_limit = config.max_shape_size / 2.0 / math.sqrt(2.0)
    circle_limit = config.max_shape_size / 2.0 * config.circle_size_factor
    half = config.min_half_extent + draw[0:2] * (box_limit - config.min_half_extent)
    is_long = draw[2] < config.large_rectangle_chance
    long_side = jnp.arange(2) == (draw[3] < 0.5)
    half = half * jnp.where(is_long & long_side, config.large_rectangle_scale, 1.0)
    return half, is_long, config.min_radius + draw[4] * (circle_limit - config.min_radius)


def box_or_triangle(half: Array, is_triangle: Array, num_corners: int) -> tuple[Array, Array]:
    """`[V, 2]` corners about the centroid, counter-clockwise, and how many of them count."""
    signs = jnp.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], jnp.float32)
    index = jnp.minimum(jnp.arange(num_corners), jnp.where(is_triangle, 2, 3))  # padding repeats the last corner
    centroid = jnp.where(is_triangle, jnp.array([1.0 / 3.0, -1.0 / 3.0], jnp.float32), 0.0)
    return (signs[index] - centroid) * half, jnp.where(is_triangle, 3, 4).astype(jnp.int32)


def point_inside(shape: Shapes, draw: Array) -> Array:
    """A uniform point of a box or triangle from 2 uniform numbers; for a circle, uniform in radius and direction."""
    first, second, last = shape.vertices[0], shape.vertices[1], shape.vertices[shape.num_vertices - 1]
    is_triangle = shape.num_vertices == 3
    u, v = draw[0], draw[1]
    fold = is_triangle & (u + v > 1.0)
    u, v = jnp.where(fold, 1.0 - u, u), jnp.where(fold, 1.0 - v, v)
    in_polygon = first + u * (second - first) + v * (last - first)
    turn = 2.0 * math.pi * draw[0]
    in_circle = shape.radius * draw[1] * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    return jnp.where(shape.num_vertices > 0, in_polygon, in_circle)


def shape_mass(shape: Shapes) -> Array:
    """kg, of one shape at density 1."""
    corners = shape.vertices
    following = jnp.roll(corners, -1, axis=0)
    area = 0.5 * jnp.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0])
    return area + math.pi * shape.radius**2


def propose(draft: Draft, request: Request, draw: Array, num_polygons: int, config: GeneratorConfig) -> Proposal:
    """One proposal from `draw` [NUM_DRAWS] uniform numbers."""
    shapes = draft.shapes
    room_polygon, room_circle = ~shapes.active[:num_polygons].all(), ~shapes.active[num_polygons:].all()
    partner = _choose_partner(shapes, draw[0], draw[2], num_polygons, config)
    is_polygon = room_polygon & (~room_circle | (draw[1] < 0.5) | (request.is_joined & ~partner.is_polygon))
    slots = jnp.stack(
        [num_polygons + first_free(shapes.active[num_polygons:]), first_free(shapes.active[:num_polygons])]
    )
    slot = slots[is_polygon.astype(int)].astype(jnp.int32)
    shape = _draw_free(shapes, request, partner, is_polygon, draw, config)
    shape = dataclasses.replace(shape, body=jnp.where(request.is_joined, partner.shape.body, slot))

    # A joined shape: its anchor lies where the anchor of its partner is. Circles are held at their centre.
    anchor_new = jnp.where(is_polygon, point_inside(shape, draw[16:18]), 0.0)
    anchor_partner = jnp.where(partner.is_polygon, point_inside(partner.shape, draw[18:20]), 0.0)
    joined_at = world_corners(partner.shape.position, partner.shape.angle, anchor_partner[None])[0]
    held = joined_at - world_corners(jnp.zeros(2, jnp.float32), shape.angle, anchor_new[None])[0]
    shape = dataclasses.replace(shape, position=jnp.where(request.is_joined, held, shape.position))
    # End a is the lower slot, so that of a wheel it is the polygon: motors run the same way whichever came first.
    is_first = slot < partner.slot
    a, b, anchor_a, anchor_b, angle_a, angle_b = (
        jnp.where(is_first, new, old)
        for new, old in (
            (slot, partner.slot),
            (partner.slot, slot),
            (anchor_new, anchor_partner),
            (anchor_partner, anchor_new),
            (shape.angle, partner.shape.angle),
            (partner.shape.angle, shape.angle),
        )
    )
    num_hinges = jnp.sum(draft.joints.active & draft.joints.is_kind(JointKind.REVOLUTE))
    both_polygons = is_polygon & partner.is_polygon
    joint = _sample_joint(request, draw[20:28], angle_b - angle_a, both_polygons, num_hinges, config)
    joint = replace(joint, joints={"a": a, "b": b, "anchor_a": anchor_a, "anchor_b": anchor_b})

    is_visible = _both_visible(shape, partner, anchor_new, anchor_partner, config)
    fine = jnp.where(request.is_joined & ~is_visible, config.hidden_fine, 0.0)
    count = published.count_contact_points if "contact_points" in config.published_details else _count_overlaps
    return Proposal(
        shape=shape,
        slot=slot,
        joint=joint,
        target=partner.slot,
        is_possible=(room_polygon | room_circle) & (~request.is_joined | (partner.exists & ~draft.joints.active.all())),
        cost=count(shapes, shape) + fine,
    )


def _choose_partner(
    shapes: Shapes, kind_draw: Array, slot_draw: Array, num_polygons: int, config: GeneratorConfig
) -> Partner:
    """Shape to join: walls never, fixed shapes rarely, polygons twice at most, circles once and only to a polygon."""
    slots = jnp.arange(shapes.active.shape[0])
    is_polygon_slot = slots < num_polygons
    room_polygon = ~shapes.active[:num_polygons].all()
    may_hold = shapes.active & (slots >= NUM_WALLS)
    room_share = jnp.maximum(2 - shapes.num_joints, 0).astype(jnp.float32) / 2.0
    wish = jnp.where(is_polygon_slot, room_share, shapes.num_joints == 0)
    wish = may_hold * wish * jnp.where(shapes.is_fixed, config.connect_to_fixed_factor, 1.0)
    wish_polygon, wish_circle = wish * is_polygon_slot, wish * ~is_polygon_slot * room_polygon
    any_polygon, any_circle = wish_polygon.sum() > 0, wish_circle.sum() > 0
    wish_polygon, any_polygon = published.with_walls_to_join(wish_polygon, any_polygon, shapes, num_polygons, config)
    is_polygon = any_polygon & (~any_circle | (kind_draw < 0.5))
    slot = pick(jnp.where(is_polygon, wish_polygon, wish_circle), slot_draw)
    return Partner(slot=slot, shape=read_slot(shapes, slot), is_polygon=is_polygon, exists=any_polygon | any_circle)


def _draw_free(
    shapes: Shapes, request: Request, partner: Partner, is_polygon: Array, draw: Array, config: GeneratorConfig
) -> Shapes:
    """A shape anywhere in the box, its body left open; a joined one is moved afterwards."""
    # Kind, size and role.
    half, is_long, radius = sample_size(draw[3:8], config)
    is_triangle = (draw[8] < config.triangle_chance) & is_polygon
    corners, num_vertices = box_or_triangle(half, is_triangle, shapes.vertices.shape[1])
    half_width = jnp.where(is_polygon, jnp.max(half) * math.sqrt(2.0), radius)
    half_width = published.with_wide_margin(half_width, is_polygon, is_long, config)
    area = jnp.where(is_polygon, 4.0 * half[0] * half[1] * jnp.where(is_triangle, 0.5, 1.0), math.pi * radius**2)
    role = _sample_role(shapes, partner.shape.role, request.is_joined, draw[9])
    # Position: green often on the left and blue on the right (swapped at the end or not).
    low, high = half_width, WORLD_SIZE_M - half_width
    is_apart = draw[10] < config.opposite_side_chance
    left = jnp.where(is_apart & (role == Role.BLUE), low + WORLD_SIZE_M / 2, low)
    right = jnp.where(is_apart & (role == Role.GREEN), high - WORLD_SIZE_M / 2, high)
    free_x = left + draw[11] * (right - left)
    free_y = low + FLOOR_TOP_M + draw[12] * (high - low - FLOOR_TOP_M)
    is_fixed = draw[14] < jnp.minimum(config.fixed_chance + config.fixed_chance_per_mass * area, 1.0)
    is_fixed = is_fixed & request.may_be_fixed & ~request.is_joined
    is_low = is_fixed & (role != Role.NONE) & (draw[15] < config.fixed_low_bias)
    free_y = jnp.where(is_low & (free_y >= WORLD_SIZE_M / 2), free_y - WORLD_SIZE_M / 2, free_y)
    return Shapes(
        active=jnp.array(True),
        position=jnp.stack([free_x, free_y]),
        angle=2.0 * math.pi * draw[13],
        vertices=jnp.where(is_polygon, corners, 0.0),
        num_vertices=jnp.where(is_polygon, num_vertices, 0),
        radius=jnp.where(is_polygon, 0.0, radius),
        role=role,
        is_fixed=is_fixed,
        body=jnp.int32(0),
        num_joints=request.is_joined.astype(jnp.int32),
        added_at=request.step,
    )


def _both_visible(
    shape: Shapes, partner: Partner, anchor_new: Array, anchor_partner: Array, config: GeneratorConfig
) -> Array:
    """bool: each of two joined shapes sticks out of the other."""
    is_polygon = shape.num_vertices > 0, partner.is_polygon
    seen_at_new, seen_at_partner = published.with_exchanged_anchors(
        (anchor_new, anchor_partner), is_polygon, partner.slot, config
    )
    other = partner.shape
    return (
        reach(seen_at_new, shape.vertices, shape.radius)
        > inset(seen_at_partner, other.vertices, other.radius) + config.min_visibility
    ) & (
        reach(seen_at_partner, other.vertices, other.radius)
        > inset(seen_at_new, shape.vertices, shape.radius) + config.min_visibility
    )


def add_best(draft: Draft, proposals: Proposal, is_joined: Array, do: Array) -> Draft:
    """Adds the cheapest of a batch of proposals (the first of equals); nothing where `do` is False."""
    cost = jnp.where(proposals.is_possible, proposals.cost, jnp.inf)
    best = read_slot(proposals, jnp.argmin(cost))
    do = do & best.is_possible
    shapes = write_slot(draft.shapes, best.slot, best.shape, do)
    holds = (jnp.arange(shapes.active.shape[0]) == best.target) & do & is_joined
    shapes = dataclasses.replace(shapes, num_joints=shapes.num_joints + holds)
    joints = write_slot(draft.driven_joints, first_free(draft.joints.active), best.joint, do & is_joined)
    return dataclasses.replace(draft, shapes=shapes, driven_joints=joints)


def _count_overlaps(shapes: Shapes, new: Shapes) -> Array:
    """Number of active shapes of other bodies that the new one overlaps."""
    corners = world_corners(shapes.position, shapes.angle, shapes.vertices)
    new_corners = world_corners(new.position, new.angle, new.vertices)
    gap = jax.vmap(separation, in_axes=(None, None, 0, 0))(new_corners, new.radius, corners, shapes.radius)
    return jnp.sum((gap < 0.0) & shapes.active & (shapes.body != new.body)).astype(jnp.float32)


def _sample_role(shapes: Shapes, target_role: Array, is_joined: Array, draw: Array) -> Array:
    """Green and blue come first, then plain shapes and at most one red; green, blue and red share no body."""
    present = jnp.stack([(shapes.active & (shapes.role == role)).any() for role in Role])
    is_set = present[Role.GREEN] & present[Role.BLUE]
    weights = jnp.stack(
        [is_set * 1.0, ~present[Role.GREEN] * 1.0, ~present[Role.BLUE] * 1.0, is_set * ~present[Role.RED] / 3.0]
    )
    is_plain = jnp.arange(len(Role)) == Role.NONE
    allowed = is_plain | (jnp.arange(len(Role)) == target_role) | (target_role == Role.NONE)
    return pick(weights * (allowed | ~is_joined), draw)


def _sample_joint(
    request: Request,
    draw: Array,
    angle_between: Array,
    both_polygons: Array,
    num_hinges: Array,
    config: GeneratorConfig,
) -> DrivenJoints:
    """Kind, motor and limits of a joint; ends and anchors are filled in by the caller.

    angle_between: of b minus that of a at the start, rad. num_hinges: that the level has so far.
    """
    may_be_fixed = ~request.force_motor & (num_hinges >= config.min_revolute_joints)
    is_fixed = (draw[0] < config.fixed_joint_chance) & may_be_fixed
    motor_on_chance = jnp.where(request.force_motor, config.forced_motor_on_chance, config.motor_on_chance)
    speed = config.motor_speed_min + draw[2] * (config.motor_speed_max - config.motor_speed_min)
    strongest = jnp.where(both_polygons, config.motor_power_max, config.wheel_power_max)
    power = config.motor_power_min + draw[3] * (strongest - config.motor_power_min)
    hinge = MotorAndLimits(
        motor_on=draw[1] < motor_on_chance,
        speed=speed,
        power=power,
        has_limits=(draw[4] < config.limits_chance) & both_polygons,
        lower_limit=-config.limit_max * draw[5],
        upper_limit=config.limit_max * draw[6],
        colour=jnp.floor(draw[7] * NUM_MOTOR_COLOURS).astype(jnp.int32),
    )
    return joint_row(Ends(), is_fixed, published.rest_angle_of(angle_between, is_fixed, config), hinge)
