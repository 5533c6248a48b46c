"""Levels as vectors of numbers, for models that learn from levels, and back: any finite numbers make a valid level.

    to_vector    slots in a meaningful order (green, blue, red, plain; from left to right), a row each
    from_vector  repairs: one green and one blue shape, not both fixed; sizes, places and anchors within the ranges of
                 the generator; joints that close no loop, after which bodies are moved until their anchors meet;
                 thrusters on moving shapes; a motor or a thruster. `overlaps_at_start` reports overlaps.

Vectors hold the generator's levels: boxes and circles, hinges and welds, thrusters, roles, those of the
floor included. `check_describable` refuses anything else. Everything but that is for one level and traceable.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, JointKind, Thrusters
from kinetix_dist.level.canonical import in_order
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import (
    Draft,
    DrivenThrusters,
    Ends,
    MotorAndLimits,
    Shapes,
    draft_to_level,
    empty_draft,
    joint_row,
    num_permutation_draws,
    permute_slots,
    read_slot,
    write_slot,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, WORLD_SIZE_M, Level, Role
from kinetix_dist.level.mutators import begin, draft_of
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.proposals import box_or_triangle, shape_mass
from kinetix_dist.level.walls import FLOOR_TOP_M, GRAVITY_M_S2

_MAX_POWER_FACTOR = 2.0  # of thrusters, times mass and `thruster_power_factor`: the generator's maximum
_ORDER = (3.0, 0.0, 1.0, 2.0)  # of roles none, green, blue, red among slots


def check_describable(levels: Level) -> None:
    """Raises ValueError where a vector cannot hold a level of a batch (numpy)."""
    shapes, joints = levels.scene.shapes, levels.scene.joints
    num_polygons = np.shape(shapes.num_vertices)[1]
    is_polygon = np.asarray(shapes.active)[:, NUM_WALLS:num_polygons]
    corners = np.asarray(shapes.vertices)[:, NUM_WALLS:]
    half = np.abs(corners).max(2)[:, :, None]
    is_box = (np.asarray(shapes.num_vertices)[:, NUM_WALLS:] == 4) & (np.abs(np.abs(corners) - half) < 1e-5).all((2, 3))
    active_joints = np.asarray(joints.active)
    found = {
        "polygons that are no boxes": (is_polygon & ~is_box).any(1),
        "sliders": (active_joints & np.asarray(joints.is_kind(JointKind.PRISMATIC))).any(1),
        "motors that run by themselves": (active_joints & np.asarray(levels.motor_auto)).any(1),
        "joints to walls": (active_joints & (np.minimum(joints.a, joints.b) < NUM_WALLS)).any(1),
        "speed at the start": (np.abs(levels.velocity).max((1, 2)) > 0) | (np.abs(levels.angular_velocity).max(1) > 0),
        "another gravity": np.abs(np.asarray(levels.scene.gravity) - np.array(GRAVITY_M_S2)).max(1) > 1e-6,
    }
    if unknown := {name: int(has.sum()) for name, has in found.items() if has.any()}:
        name, count = next(iter(unknown.items()))
        raise ValueError(
            f"{count} of {len(is_polygon)} levels have {name}; vectors hold levels of the generator: leave these out"
        )


# To a vector


def to_vector(level: Level, capacity: Capacity, config: GeneratorConfig) -> Array:
    """[vector_size] float32, most of it from -1 to 1."""
    draft = draft_of(begin(level), capacity)
    draft = permute_slots(_order(draft, capacity), draft, capacity.polygons)
    shapes, joints, thrusters = draft.shapes, in_order(draft.joints), draft.thrusters
    body = jax.tree.map(lambda column: column[NUM_WALLS:], shapes)
    size = _longest(config)
    half = jnp.maximum(jnp.abs(body.vertices).max(1), body.radius[:, None])
    by_shape = [
        body.is_fixed[:, None],
        2.0 * body.position / WORLD_SIZE_M - 1.0,
        _direction(body.angle),
        half / size,
        _one_hot(body.role, len(Role)),
    ]
    by_joint = [
        _one_hot(joints.a - NUM_WALLS, _num_free(capacity)),
        _one_hot(joints.b - NUM_WALLS, _num_free(capacity)),
        joints.anchor_a / size,
        joints.anchor_b / size,
        jnp.stack(
            [
                joints.is_kind(JointKind.FIXED),
                joints.motor_on,
                joints.motor_speed / config.motor_speed_max,
                joints.motor_power / config.motor_power_max,
                joints.has_limits,
                joints.lower_limit / config.limit_max,
                joints.upper_limit / config.limit_max,
            ],
            -1,
        ),
        _one_hot(draft.driven_joints.colour, NUM_MOTOR_COLOURS),
    ]
    mass = jax.vmap(shape_mass)(jax.tree.map(lambda column: column[thrusters.body], shapes))
    most = jnp.where(thrusters.active, mass, 1.0) * config.thruster_power_factor * _MAX_POWER_FACTOR
    by_thruster = [
        _one_hot(thrusters.body - NUM_WALLS, _num_free(capacity)),
        thrusters.position / size,
        _direction(thrusters.angle),
        (thrusters.power / most)[:, None],
        _one_hot(draft.driven_thrusters.colour, NUM_THRUSTER_COLOURS),
    ]
    floor = _one_hot(shapes.role[0], len(Role))
    tables = ((body.active, by_shape), (joints.active, by_joint), (thrusters.active, by_thruster))
    rows = [_rows(active, columns).reshape(-1) for active, columns in tables]
    return jnp.concatenate([floor, *rows])


def vector_size(capacity: Capacity) -> int:
    return len(Role) + sum(count * width for count, width in _tables(capacity))


def _tables(capacity: Capacity) -> tuple[tuple[int, int], ...]:
    """(slots, numbers of a slot) of shapes, joints and thrusters."""
    free = _num_free(capacity)
    return (
        (free, 1 + 1 + 2 + 2 + 2 + len(Role)),
        (capacity.joints, 1 + 2 * free + 4 + 7 + NUM_MOTOR_COLOURS),
        (capacity.thrusters, 1 + free + 2 + 2 + 1 + NUM_THRUSTER_COLOURS),
    )


def _num_free(capacity: Capacity) -> int:
    return capacity.shapes - NUM_WALLS


def _longest(config: GeneratorConfig) -> float:
    """m, half of the longest box."""
    return config.max_shape_size / 2.0 / math.sqrt(2.0) * max(1.0, config.large_rectangle_scale)


def _rows(active: Array, columns: list[Array]) -> Array:
    """[slots, 1 + numbers]: zeros where nothing is."""
    return jnp.concatenate([active[:, None], *columns], axis=-1) * active[:, None].astype(jnp.float32)


def _order(draft: Draft, capacity: Capacity) -> Array:
    """Sort keys for `permute_slots`."""
    shapes, joints, thrusters = draft.shapes, draft.joints, draft.thrusters
    key = jnp.array(_ORDER, jnp.float32)[shapes.role] + shapes.position[:, 0] / (2.0 * WORLD_SIZE_M)
    key = jnp.where(shapes.active, key, 9.0)
    ends = jnp.stack([key[joints.a], key[joints.b]])
    by_joint = jnp.where(joints.active, ends.min(0) + 0.1 * ends.max(0), 9.0)
    by_thruster = jnp.where(thrusters.active, key[thrusters.body] + 0.01 * thrusters.position[:, 0], 9.0)
    return jnp.concatenate([key[NUM_WALLS:], by_joint, by_thruster])


def _one_hot(index: Array, size: int) -> Array:
    return (index[..., None] == jnp.arange(size)) * 1.0


def _direction(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


# And back


def from_vector(vector: Array, order_draws: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """A valid level, whatever the numbers. order_draws [num_order_draws] in [0, 1): for the order of its slots."""
    counts, widths = zip(*_tables(capacity), strict=True)
    ends = np.cumsum([len(Role), *(count * width for count, width in zip(counts, widths, strict=True))])
    floor, *parts = jnp.split(vector, ends[:-1])
    rows = [part.reshape(count, width) for part, count, width in zip(parts, counts, widths, strict=True)]
    draft = empty_draft(capacity)
    draft = dataclasses.replace(draft, shapes=_shapes(rows[0], floor, draft.shapes, capacity, config))
    joints = jnp.arange(capacity.joints), rows[1]
    draft, _ = jax.lax.scan(lambda draft, at: (_with_joint(draft, *at, capacity, config), None), draft, joints)
    draft = _with_thrusters(draft, rows[2], config)
    return derive(*draft_to_level(permute_slots(order_draws, draft, capacity.polygons), capacity))


def num_order_draws(capacity: Capacity) -> int:
    return num_permutation_draws(empty_draft(capacity))


def _is_on(number: Array) -> Array:
    return number > 0.5


def _angle(direction: Array) -> Array:
    return jnp.arctan2(direction[..., 1], direction[..., 0])


def _shapes(rows: Array, floor: Array, walls: Shapes, capacity: Capacity, config: GeneratorConfig) -> Shapes:
    free, slots = _num_free(capacity), jnp.arange(rows.shape[0])
    is_polygon = slots + NUM_WALLS < capacity.polygons
    score = rows[:, -len(Role) :]
    floor_is_blue, floor_is_red = (jnp.argmax(floor) == role for role in (Role.BLUE, Role.RED))
    green = jnp.argmax(score[:, Role.GREEN])
    blue = jnp.argmax(jnp.where(slots == green, -jnp.inf, score[:, Role.BLUE]))
    is_green, is_blue = slots == green, (slots == blue) & ~floor_is_blue
    wants_red = (jnp.argmax(score, 1) == Role.RED) & ~is_green & ~is_blue & _is_on(rows[:, 0]) & ~floor_is_red
    is_red = wants_red & (slots == jnp.argmax(jnp.where(wants_red, score[:, Role.RED], -jnp.inf)))
    role = is_green * Role.GREEN + is_blue * Role.BLUE + is_red * Role.RED
    is_small = free <= 3  # as in the generator
    allow_fixed = not is_small if config.allow_fixed is None else config.allow_fixed
    is_fixed = _is_on(rows[:, 1]) & allow_fixed
    # Green moves where blue does not: blue is the floor or fixed.
    is_fixed = is_fixed & ~(is_green & (floor_is_blue | is_fixed[blue]))
    size = _longest(config)
    half = jnp.clip(rows[:, 6:8] * size, config.min_half_extent, size)
    largest = config.max_shape_size / 2.0 * config.circle_size_factor
    radius = jnp.clip(rows[:, 6:8].mean(1) * size, config.min_radius, largest)
    corners, num_corners = jax.vmap(lambda one: box_or_triangle(one, jnp.array(False), capacity.vertices))(half)
    reach = jnp.where(is_polygon, 0.0, radius)[:, None]
    low, high = jnp.array([0.0, FLOOR_TOP_M], jnp.float32) + reach, WORLD_SIZE_M - reach
    new = Shapes(
        active=_is_on(rows[:, 0]) | is_green | is_blue,
        position=jnp.clip(0.5 * (rows[:, 2:4] + 1.0) * WORLD_SIZE_M, low, high),
        angle=_angle(rows[:, 4:6]),
        vertices=jnp.where(is_polygon[:, None, None], corners, 0.0),
        num_vertices=jnp.where(is_polygon, num_corners, 0),
        radius=jnp.where(is_polygon, 0.0, radius),
        role=role.astype(jnp.int32),
        is_fixed=is_fixed,
        body=slots + NUM_WALLS,
        num_joints=jnp.zeros(free, jnp.int32),
        added_at=jnp.zeros(free, jnp.int32),
    )
    floor_role = jnp.where(floor_is_blue, Role.BLUE, jnp.where(floor_is_red, Role.RED, Role.NONE))
    walls = dataclasses.replace(walls, role=walls.role.at[0].set(floor_role))
    return jax.tree.map(lambda wall, one: jnp.concatenate([wall[:NUM_WALLS], one.astype(wall.dtype)]), walls, new)


def _with_joint(draft: Draft, slot: Array, row: Array, capacity: Capacity, config: GeneratorConfig) -> Draft:
    """A joint between the two shapes that the row names most, unless that closes a loop or joins green to blue."""
    shapes, free = draft.shapes, _num_free(capacity)
    active = shapes.active[NUM_WALLS:]
    score_a, score_b = row[1 : 1 + free], row[1 + free : 1 + 2 * free]
    first = jnp.argmax(jnp.where(active, score_a, -jnp.inf))
    second = jnp.argmax(jnp.where(active & (jnp.arange(free) != first), score_b, -jnp.inf))
    a, b = NUM_WALLS + first, NUM_WALLS + second
    one, other = read_slot(shapes, a), read_slot(shapes, b)
    anchors, rest = row[1 + 2 * free : 5 + 2 * free].reshape(2, 2), row[5 + 2 * free :]
    anchor_a, anchor_b = (_anchor(shape, anchor, config) for shape, anchor in zip((one, other), anchors, strict=True))
    # Green and blue are in bodies of their own, or they would never touch.
    is_either = (shapes.role == Role.GREEN) | (shapes.role == Role.BLUE)
    has_either = [((shapes.body == body) & is_either).any() for body in (one.body, other.body)]
    both_fixed = _is_held(shapes, one.body) & _is_held(shapes, other.body)
    both_round = (one.radius > 0) & (other.radius > 0)
    is_loop = (a == b) | (one.body == other.body) | ~active[second]
    do = _is_on(row[0]) & ~is_loop & ~both_fixed & ~both_round & ~(has_either[0] & has_either[1])
    # The body that moves is put where its anchor meets that of the other.
    at_a = world_corners(one.position, one.angle, anchor_a[None])[0]
    at_b = world_corners(other.position, other.angle, anchor_b[None])[0]
    moves_b = ~_is_held(shapes, other.body)
    moved = do & (shapes.body == jnp.where(moves_b, other.body, one.body))
    by = jnp.where(moves_b, at_a - at_b, at_b - at_a)
    shapes = dataclasses.replace(
        shapes,
        position=jnp.where(moved[:, None], shapes.position + by, shapes.position),
        body=jnp.where(do & (shapes.body == other.body), one.body, shapes.body),
        num_joints=shapes.num_joints + (do & ((jnp.arange(capacity.shapes) == a) | (jnp.arange(capacity.shapes) == b))),
    )
    is_weld, both_boxes = _is_on(rest[0]), (one.radius == 0) & (other.radius == 0)
    strongest = jnp.where(both_boxes, config.motor_power_max, config.wheel_power_max)
    speed = jnp.clip(jnp.abs(rest[2]) * config.motor_speed_max, config.motor_speed_min, config.motor_speed_max)
    power = jnp.clip(rest[3] * config.motor_power_max, jnp.minimum(config.motor_power_min, strongest), strongest)
    hinge = MotorAndLimits(
        motor_on=_is_on(rest[1]),
        speed=jnp.where(rest[2] < 0, -speed, speed),
        power=power,
        has_limits=_is_on(rest[4]) & both_boxes,
        lower_limit=config.limit_max * jnp.clip(rest[5], -1.0, 0.0),
        upper_limit=config.limit_max * jnp.clip(rest[6], 0.0, 1.0),
        colour=jnp.argmax(rest[7:]),
    )
    ends = Ends(a=a, b=b, anchor_a=anchor_a, anchor_b=anchor_b)
    driven = joint_row(ends, is_weld, other.angle - one.angle, hinge)
    return dataclasses.replace(draft, shapes=shapes, driven_joints=write_slot(draft.driven_joints, slot, driven, do))


def _is_held(shapes: Shapes, body: Array) -> Array:
    """bool: a fixed shape is part of that body."""
    return ((shapes.body == body) & shapes.is_fixed & shapes.active).any()


def _anchor(shape: Shapes, anchor: Array, config: GeneratorConfig) -> Array:
    """[2] m, inside a box, in the middle of a circle."""
    half = jnp.abs(shape.vertices).max(0)
    return jnp.clip(anchor * _longest(config), -half, half)


def _with_thrusters(draft: Draft, rows: Array, config: GeneratorConfig) -> Draft:
    shapes, joints = draft.shapes, draft.joints
    may_carry = (shapes.active & ~shapes.is_fixed)[NUM_WALLS:]
    free = may_carry.shape[0]
    body = NUM_WALLS + jnp.argmax(jnp.where(may_carry, rows[:, 1 : 1 + free], -jnp.inf), axis=1)
    carriers = jax.tree.map(lambda column: column[body], shapes)
    half = jnp.maximum(jnp.abs(carriers.vertices).max(1), carriers.radius[:, None])
    rest = rows[:, 1 + free :]
    position = jnp.clip(rest[:, 0:2] * _longest(config), -half, half)
    farthest = jnp.where(carriers.radius > 0, carriers.radius, jnp.inf)
    position = position * jnp.minimum(1.0, farthest / jnp.maximum(jnp.linalg.norm(position, axis=1), 1e-6))[:, None]
    wanted = _is_on(rows[:, 0])
    has_control = (joints.active & joints.motor_on).any() | wanted.any()
    share = jnp.clip(rest[:, 4], 0.5 / _MAX_POWER_FACTOR, 1.0)
    thrusters = Thrusters(
        active=wanted | (~has_control & (jnp.arange(rows.shape[0]) == 0)),
        body=body,
        position=position,
        angle=_angle(rest[:, 2:4]),
        power=jax.vmap(shape_mass)(carriers) * config.thruster_power_factor * _MAX_POWER_FACTOR * share,
    )
    rows_now: Any = DrivenThrusters(thrusters=thrusters, colour=jnp.argmax(rest[:, 5:], axis=1))
    is_there = thrusters.active
    old = draft.driven_thrusters

    def put(new: Array, before: Array) -> Array:
        return jnp.where(is_there.reshape(-1, *[1] * (before.ndim - 1)), new, before).astype(before.dtype)

    return dataclasses.replace(draft, driven_thrusters=jax.tree.map(put, rows_now, old))


def overlaps_at_start(level: Level, capacity: Capacity) -> Array:
    """bool: two shapes that may collide overlap."""
    shapes = level.scene.shapes
    vertices = jnp.concatenate([shapes.vertices, jnp.zeros((capacity.circles, capacity.vertices, 2), jnp.float32)])
    radius = jnp.concatenate([jnp.zeros(capacity.polygons, jnp.float32), shapes.radius])
    corners = world_corners(level.position, level.angle, vertices)
    gap = jax.vmap(jax.vmap(separation, (None, None, 0, 0)), (0, 0, None, None))(corners, radius, corners, radius)
    return ((gap < 0.0) & shapes.can_touch).any()
