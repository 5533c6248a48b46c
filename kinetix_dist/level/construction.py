"""Building a level action by action: what a teacher that designs levels does (PAIRED, Dennis et al. 2020).

    steps 2k, 2k + 1    shape k is described (what, size, angle), then placed, or held by a joint to one that is there
    the last T steps    a thruster each, or none

Shape 0 is green and shape 1 blue; what follows is plain, or red once. An action is one choice of each head of HEADS;
`allowed` says which choices a step has: all others are masked, so that every sequence of allowed actions ends in a
valid level: what is placed overlaps nothing that it may collide with, joints hold shapes that exist, green and blue
are one each and not both fixed, and there is a motor or a thruster. A head without a meaning in a step has choice 0
alone. What does not fit anywhere is left out. Places and joints are those of a grid, as the mask has to know them; a
choice of size, angle, speed or power stands for a range, within which a uniform number decides.

Everything is for one level; `jax.vmap` gives a batch. Random numbers are handed in.
"""

from __future__ import annotations

import dataclasses
import enum
import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity, JointDrive, JointKind, Joints, Thrusters
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import (
    Draft,
    DrivenJoints,
    DrivenThrusters,
    Shapes,
    draft_to_level,
    empty_draft,
    first_free,
    read_slot,
    write_slot,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, WORLD_SIZE_M, Level
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.permute import num_permutation_draws, permute_slots
from kinetix_dist.level.proposals import box_or_triangle, shape_mass
from kinetix_dist.level.roles import Role
from kinetix_dist.level.walls import FLOOR_TOP_M

GRID = 8  # cells along each side of the box, for centres of free shapes
ANCHORS = 3  # along each side of a shape, for joints and thrusters
NUM_SIZES, NUM_ANGLES, NUM_STRENGTHS, NUM_SPEEDS = 5, 16, 4, 4
LIMITS_RAD = (0.0, math.pi / 4, math.pi / 2)  # of a hinge between boxes, to both sides; 0: none
NUM_DRAWS = 8  # uniform numbers of a step
_CENTRE = ANCHORS * ANCHORS // 2  # the anchor in the middle


class What(enum.IntEnum):
    """What a step adds."""

    NOTHING = 0
    BOX = 1
    CIRCLE = 2
    JOINED_BOX = 3
    JOINED_CIRCLE = 4
    RED_BOX = 5
    RED_CIRCLE = 6
    THRUSTER = 7


BOXES = (What.BOX, What.JOINED_BOX, What.RED_BOX)
JOINED = (What.JOINED_BOX, What.JOINED_CIRCLE)
RED = (What.RED_BOX, What.RED_CIRCLE)


class Motor(enum.IntEnum):
    """How a joint holds."""

    FREE = 0  # a hinge that turns freely
    DRIVEN = 1  # a hinge with a motor
    WELD = 2


HEADS = (
    "what",  # of `What`
    "width",  # of a box; of a circle the radius
    "height",  # of a box
    "angle",  # of a shape, or in which direction a thruster pushes
    "own_anchor",  # where the joint is on a new box; on a circle it is at the centre
    "place",  # cell of the grid
    "attach",  # shape and anchor on it, of a joint or a thruster
    "is_fixed",
    "motor",  # of `Motor`
    "limits",  # of LIMITS_RAD
    "strength",  # of a motor or a thruster
    "speed",  # of a motor
    "colour",
)
_AT = {name: number for number, name in enumerate(HEADS)}


def head_sizes(capacity: Capacity) -> tuple[int, ...]:
    """Choices of each head."""
    sizes = {
        "what": len(What),
        "width": NUM_SIZES,
        "height": NUM_SIZES,
        "angle": NUM_ANGLES,
        "own_anchor": ANCHORS**2,
        "place": GRID**2,
        "attach": (capacity.shapes - NUM_WALLS) * ANCHORS**2,
        "is_fixed": 2,
        "motor": len(Motor),
        "limits": len(LIMITS_RAD),
        "strength": NUM_STRENGTHS,
        "speed": NUM_SPEEDS,
        "colour": max(NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS),
    }
    return tuple(sizes[name] for name in HEADS)


def num_steps(capacity: Capacity) -> int:
    """Actions from the empty box to a level."""
    return 2 * (capacity.shapes - NUM_WALLS) + capacity.thrusters


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Construction:
    """A level that is being built."""

    draft: Draft
    what: Array  # int32, of `What`: the shape that was described and is to be placed
    shape: Shapes  # that shape without the leading axis, at the origin
    own_anchor: Array  # [2] m, in its frame


def check_construction(capacity: Capacity, config: GeneratorConfig) -> None:
    """Raises ValueError where green and blue would not surely find room."""
    if capacity.joints < 1 or capacity.thrusters < 1 or capacity.shapes - NUM_WALLS < 2:
        raise ValueError(
            f"building levels needs room for 2 shapes besides the walls, 1 joint and 1 thruster; capacity has "
            f"{capacity.shapes - NUM_WALLS} shapes, {capacity.joints} joints and {capacity.thrusters} thrusters"
        )
    farthest = _largest_reach(config)
    # Of the cells in which a shape of this reach is clear of the walls, those in opposite corners: a green shape
    # anywhere is farther than two reaches from one of them.
    heights = WORLD_SIZE_M - FLOOR_TOP_M
    spans = [_clear_span(size, farthest) for size in (WORLD_SIZE_M, heights)]
    if min(spans) < 0 or math.hypot(*spans) < 4.0 * farthest:
        raise ValueError(
            f"shapes of the generator reach {farthest:.3g} m from their centre: a green and a blue one do not surely "
            "find room beside each other; lower max_shape_size or large_rectangle_scale"
        )


def _largest_reach(config: GeneratorConfig) -> float:
    box = config.max_shape_size / 2.0 / math.sqrt(2.0)
    return max(math.hypot(box * config.large_rectangle_scale, box), _largest_radius(config))


def _largest_radius(config: GeneratorConfig) -> float:
    return config.max_shape_size / 2.0 * config.circle_size_factor


def _clear_span(length: float, reach: float) -> float:
    """Between the first and the last centre of cells at least `reach` from both ends of a side; negative: none."""
    cell = length / GRID
    first = math.ceil(reach / cell - 0.5)
    return (GRID - 1 - 2 * first) * cell


def begin(capacity: Capacity) -> Construction:
    """The empty box."""
    draft = empty_draft(capacity)
    nothing = jax.tree.map(lambda column: jnp.zeros_like(column[0]), draft.shapes)
    return Construction(draft=draft, what=jnp.int32(What.NOTHING), shape=nothing, own_anchor=jnp.zeros(2))


# Which step it is


def _num_shape_steps(capacity: Capacity) -> int:
    return 2 * (capacity.shapes - NUM_WALLS)


def _is_describing(step: Array, capacity: Capacity) -> Array:
    return (step < _num_shape_steps(capacity)) & (step % 2 == 0)


def _is_placing(step: Array, capacity: Capacity) -> Array:
    return (step < _num_shape_steps(capacity)) & (step % 2 == 1)


def _is_one_of(what: Array, kinds: tuple[What, ...]) -> Array:
    return (what[..., None] == jnp.array(kinds)).any(-1)


# What is allowed


def allowed(building: Construction, step: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Array, ...]:
    """[choices] bool of each head; at least one choice of each is allowed.

    step: int32, number of the action to come. The same for a whole batch (`jax.vmap` with `in_axes` None), it saves
    the search for places in steps that place nothing.
    """
    describes, places = _is_describing(step, capacity), _is_placing(step, capacity)
    pushes = ~describes & ~places
    joins = places & _is_one_of(building.what, JOINED)
    stands_free = places & ~joins & (building.what != What.NOTHING)
    nowhere = jnp.zeros(GRID**2, bool), jnp.zeros((capacity.shapes - NUM_WALLS) * ANCHORS**2, bool)
    place, attach = jax.lax.cond(
        places, lambda: (_free_places(building, capacity), _free_joints(building, capacity)), lambda: nowhere
    )
    is_placed, is_joined = stands_free & place.any(), joins & attach.any()

    def if_(condition: Array, choices: Array) -> Array:
        """These choices where the head has a meaning, else choice 0 alone."""
        return jnp.where(condition, choices, jnp.arange(choices.shape[0]) == 0)

    everything = {name: jnp.ones(size, bool) for name, size in zip(HEADS, head_sizes(capacity), strict=True)}
    colours = jnp.arange(everything["colour"].shape[0])
    on_thruster = jnp.repeat(_can_carry(building.draft)[NUM_WALLS:], ANCHORS**2)
    masks = {
        "what": jnp.where(
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
    """[len(What)] bool: what the next shape can be."""
    draft, polygons = building.draft, capacity.polygons
    shapes = draft.shapes
    is_first = step < 4  # green, then blue
    room_box, room_circle = ~shapes.active[:polygons].all(), ~shapes.active[polygons:].all()
    holds_box, holds_circle = (_can_hold(draft, capacity, is_box).any() for is_box in (True, False))
    may_join, may_be_red = ~is_first & ~draft.joints.active.all(), ~is_first & ~(shapes.role == Role.RED).any()
    can = {
        What.NOTHING: ~is_first,
        What.BOX: room_box,
        What.CIRCLE: room_circle,
        What.JOINED_BOX: room_box & holds_box & may_join,
        What.JOINED_CIRCLE: room_circle & holds_circle & may_join,
        What.RED_BOX: room_box & may_be_red,
        What.RED_CIRCLE: room_circle & may_be_red,
        What.THRUSTER: jnp.array(False),
    }
    return jnp.stack([can[what] for what in What])


def _thruster_or_none(building: Construction, step: Array, capacity: Capacity) -> Array:
    """[len(What)] bool. The last step has to add a thruster where there is no other control."""
    joints, thrusters = building.draft.joints, building.draft.thrusters
    has_control = (joints.active & joints.motor_on).any() | thrusters.active.any()
    is_last = step == num_steps(capacity) - 1
    what = jnp.arange(len(What))
    return (what == What.THRUSTER) | ((what == What.NOTHING) & (has_control | ~is_last))


def _can_hold(draft: Draft, capacity: Capacity, is_box: Array | bool) -> Array:
    """[n] bool: whom a joint can hold a new shape to: no walls, boxes twice, circles once and to a box alone."""
    shapes, slots = draft.shapes, jnp.arange(capacity.shapes)
    is_polygon = slots < capacity.polygons
    has_end = jnp.where(is_polygon, shapes.num_joints < 2, (shapes.num_joints < 1) & is_box)
    return shapes.active & (slots >= NUM_WALLS) & has_end


def _can_carry(draft: Draft) -> Array:
    """[n] bool: shapes that a thruster can push."""
    return draft.shapes.active & ~draft.shapes.is_fixed


def _may_be_fixed(building: Construction, step: Array, capacity: Capacity, config: GeneratorConfig) -> Array:
    """As the generator has it: by size where it is left open, and green and blue not both."""
    is_small = capacity.shapes - NUM_WALLS <= 3
    allow = not is_small if config.allow_fixed is None else config.allow_fixed
    shapes = building.draft.shapes
    green_is_fixed = ((shapes.role == Role.GREEN) & shapes.is_fixed).any()
    return jnp.array(allow) & ~((step == 3) & green_is_fixed)


def _free_places(building: Construction, capacity: Capacity) -> Array:
    """[GRID^2] bool: cells in whose centre the described shape overlaps nothing."""
    return jax.vmap(lambda cell: _is_free_place(building, cell))(jnp.arange(GRID**2))


def _is_free_place(building: Construction, cell: Array) -> Array:
    return ~_overlaps(building, _in_cell(cell, jnp.full(2, 0.5)))


def _free_joints(building: Construction, capacity: Capacity) -> Array:
    """[shapes x ANCHORS^2] bool: joints by which the described shape overlaps no other body."""
    choices = jnp.arange((capacity.shapes - NUM_WALLS) * ANCHORS**2)
    return jax.vmap(lambda choice: _is_free_joint(building, choice, capacity))(choices)


def _is_free_joint(building: Construction, choice: Array, capacity: Capacity) -> Array:
    shapes = building.draft.shapes
    holds = _can_hold(building.draft, capacity, _is_one_of(building.what, BOXES))
    target, anchor = _attachment(choice)
    partner = read_slot(shapes, target)
    is_circle = target >= capacity.polygons  # held at its centre
    held = _held_at(building, partner, _anchor_point(partner, anchor))
    is_free = ~_overlaps(building, held, shapes.body == partner.body)
    return holds[target] & (~is_circle | (anchor == _CENTRE)) & is_free


def _overlaps(building: Construction, position: Array, ignored: Array | bool = False) -> Array:
    """bool: the described shape there overlaps an active shape that is not ignored ([n] bool)."""
    shapes, new = building.draft.shapes, building.shape
    corners = world_corners(shapes.position, shapes.angle, shapes.vertices)
    new_corners = world_corners(position, new.angle, new.vertices)
    gap = jax.vmap(separation, in_axes=(None, None, 0, 0))(new_corners, new.radius, corners, shapes.radius)
    return ((gap < 0.0) & shapes.active & jnp.logical_not(ignored)).any()


# Choices as quantities


def _within(choice: Array, draw: Array, num_choices: int, low: Array | float, high: Array | float) -> Array:
    """The quantity of a choice: `draw` of its part of the range."""
    return low + (choice + draw) / num_choices * (high - low)


def _in_cell(cell: Array, draw: Array) -> Array:
    """[2] m: a point of a cell of the box."""
    x = (cell % GRID + draw[0]) / GRID * WORLD_SIZE_M
    return jnp.stack([x, FLOOR_TOP_M + (cell // GRID + draw[1]) / GRID * (WORLD_SIZE_M - FLOOR_TOP_M)])


def _attachment(choice: Array) -> tuple[Array, Array]:
    """(slot of the shape, number of the anchor on it)"""
    return NUM_WALLS + choice // ANCHORS**2, choice % ANCHORS**2


def _anchor_point(shape: Shapes, anchor: Array, draw: Array | float = 0.5) -> Array:
    """[2] m, frame of the shape: in a cell of the box that it is; of a circle, of the square within it."""
    half = jnp.maximum(jnp.abs(shape.vertices).max(0), shape.radius / math.sqrt(2.0))
    cell = jnp.stack([anchor % ANCHORS, anchor // ANCHORS])
    return ((cell + draw) / ANCHORS * 2.0 - 1.0) * half


def _held_at(building: Construction, partner: Shapes, anchor: Array) -> Array:
    """[2] m: the centre of the described shape when a joint holds it to this anchor of a partner."""
    joined_at = world_corners(partner.position, partner.angle, anchor[None])[0]
    return joined_at - world_corners(jnp.zeros(2), building.shape.angle, building.own_anchor[None])[0]


# What an action does


def apply_action(
    building: Construction, step: Array, action: Array, draws: Array, capacity: Capacity, config: GeneratorConfig
) -> Construction:
    """The construction after one action.

    step: int32, its number; action [heads] int: a choice of each head, all of them allowed; draws [NUM_DRAWS] in
    [0, 1). A shape that is put where it does not fit is left out; other choices that are masked are not looked for,
    and may build what is no level.
    """
    choice = {name: action[_AT[name]].astype(jnp.int32) for name in HEADS}
    describes, places = _is_describing(step, capacity), _is_placing(step, capacity)
    shape, own_anchor = _described(building, step, choice, draws, config)
    draft = _with_shape(building, choice, draws, places, capacity, config)
    draft = _with_thruster(draft, choice, draws, ~describes & ~places, config)
    return Construction(
        draft=draft,
        what=jnp.where(describes, choice["what"], building.what),
        shape=jax.tree.map(lambda new, old: jnp.where(describes, new, old), shape, building.shape),
        own_anchor=jnp.where(describes, own_anchor, building.own_anchor),
    )


def _described(
    building: Construction, step: Array, choice: dict[str, Array], draws: Array, config: GeneratorConfig
) -> tuple[Shapes, Array]:
    """The shape, at the origin, and where a joint would be on it."""
    is_box = _is_one_of(choice["what"], BOXES)
    limit = config.max_shape_size / 2.0 / math.sqrt(2.0)
    longest = limit * max(1.0, config.large_rectangle_scale)
    width = _within(choice["width"], draws[0], NUM_SIZES, config.min_half_extent, longest)
    height = _within(choice["height"], draws[1], NUM_SIZES, config.min_half_extent, limit)
    radius = _within(choice["width"], draws[0], NUM_SIZES, config.min_radius, _largest_radius(config))
    corners, num_corners = box_or_triangle(
        jnp.stack([width, height]), jnp.array(False), building.shape.vertices.shape[0]
    )
    number = step // 2
    plain_or_red = jnp.where(_is_one_of(choice["what"], RED), Role.RED, Role.NONE)
    role = jnp.where(number == 0, Role.GREEN, jnp.where(number == 1, Role.BLUE, plain_or_red))
    shape = Shapes(
        active=jnp.array(True),
        position=jnp.zeros(2),
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
    own_anchor = jnp.where(is_box, _anchor_point(shape, choice["own_anchor"], draws[3:5]), 0.0)
    return shape, own_anchor


def _with_shape(
    building: Construction,
    choice: dict[str, Array],
    draws: Array,
    do: Array,
    capacity: Capacity,
    config: GeneratorConfig,
) -> Draft:
    """The draft with the described shape, and its joint; without it where it fits nowhere."""
    draft, polygons = building.draft, capacity.polygons
    shapes = draft.shapes
    is_box, is_joined = _is_one_of(building.what, BOXES), _is_one_of(building.what, JOINED)
    fits = jnp.where(
        is_joined,
        _is_free_joint(building, choice["attach"], capacity),
        _is_free_place(building, choice["place"]),
    )
    do = do & (building.what != What.NOTHING) & fits
    free_box, free_circle = first_free(shapes.active[:polygons]), polygons + first_free(shapes.active[polygons:])
    slot = jnp.where(is_box, free_box, free_circle).astype(jnp.int32)

    # Anywhere in its cell where that is free, else in the middle.
    somewhere, middle = _in_cell(choice["place"], draws[0:2]), _in_cell(choice["place"], jnp.full(2, 0.5))
    stands = jnp.where(_overlaps(building, somewhere), middle, somewhere)
    target, anchor = _attachment(choice["attach"])
    partner = read_slot(shapes, target)
    anchor_partner = _anchor_point(partner, anchor)
    shape = dataclasses.replace(
        building.shape,
        position=jnp.where(is_joined, _held_at(building, partner, anchor_partner), stands),
        is_fixed=~is_joined & (choice["is_fixed"] == 1),
        body=jnp.where(is_joined, partner.body, slot),
        num_joints=is_joined.astype(jnp.int32),
    )
    after = write_slot(shapes, slot, shape, do)
    holds = (jnp.arange(capacity.shapes) == target) & do & is_joined
    after = dataclasses.replace(after, num_joints=after.num_joints + holds)
    both_boxes = is_box & (target < polygons)
    joint = _joint(building, choice, draws, slot, target, partner, anchor_partner, both_boxes, config)
    joints = write_slot(draft.driven_joints, first_free(draft.joints.active), joint, do & is_joined)
    return dataclasses.replace(draft, shapes=after, driven_joints=joints)


def _joint(
    building: Construction,
    choice: dict[str, Array],
    draws: Array,
    slot: Array,
    target: Array,
    partner: Shapes,
    anchor_partner: Array,
    both_boxes: Array,
    config: GeneratorConfig,
) -> DrivenJoints:
    """From the partner to the new shape; `derive` puts the ends into their order."""
    is_weld, is_driven = choice["motor"] == Motor.WELD, choice["motor"] == Motor.DRIVEN
    limit = jnp.where(both_boxes & ~is_weld, jnp.array(LIMITS_RAD)[choice["limits"]], 0.0)
    strongest = jnp.where(both_boxes, config.motor_power_max, config.wheel_power_max)
    weakest = jnp.minimum(config.motor_power_min, strongest)
    speed = _within(choice["speed"], draws[5], NUM_SPEEDS, config.motor_speed_min, config.motor_speed_max)
    power = _within(choice["strength"], draws[6], NUM_STRENGTHS, weakest, strongest)
    joint = Joints(
        active=jnp.array(True),
        kind=jnp.where(is_weld, JointKind.FIXED, JointKind.REVOLUTE),
        a=target,
        b=slot,
        anchor_a=anchor_partner,
        anchor_b=building.own_anchor,
        rest_angle=building.shape.angle - partner.angle,
        axis_angle=jnp.zeros(()),
        motor_on=is_driven,
        drive=jnp.array(JointDrive.VELOCITY),
        motor_speed=jnp.where(is_weld, 0.0, speed),
        motor_power=jnp.where(is_weld, 0.0, power),
        has_limits=limit > 0,
        lower_limit=-limit,
        upper_limit=limit,
    )
    return DrivenJoints(joints=joint, colour=choice["colour"])


def _with_thruster(draft: Draft, choice: dict[str, Array], draws: Array, do: Array, config: GeneratorConfig) -> Draft:
    body, anchor = _attachment(choice["attach"])
    shape = read_slot(draft.shapes, body)
    factor = _within(choice["strength"], draws[6], NUM_STRENGTHS, 0.5, 2.0)
    thruster = Thrusters(
        active=jnp.array(True),
        body=body,
        position=_anchor_point(shape, anchor),
        angle=_within(choice["angle"], draws[2], NUM_ANGLES, 0.0, 2.0 * math.pi),
        power=shape_mass(shape) * config.thruster_power_factor * factor,
    )
    row = DrivenThrusters(thrusters=thruster, colour=choice["colour"])
    slot = first_free(draft.thrusters.active)
    after = write_slot(draft.driven_thrusters, slot, row, do & (choice["what"] == What.THRUSTER))
    return dataclasses.replace(draft, driven_thrusters=after)


# The level


def num_order_draws(capacity: Capacity) -> int:
    """How many uniform numbers `finish` wants."""
    return num_permutation_draws(empty_draft(capacity))


def finish(building: Construction, order_draws: Array, capacity: Capacity) -> Level:
    """The level that was built, its slots in random order. order_draws [num_order_draws] in [0, 1)."""
    return derive(*draft_to_level(permute_slots(order_draws, building.draft, capacity.polygons), capacity))
