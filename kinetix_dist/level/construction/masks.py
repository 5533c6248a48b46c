"""Which choices a step allows."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.construction.places import can_hold, free_joints, free_places
from kinetix_dist.level.construction.records import (
    ANCHORS,
    GRID,
    HEADS,
    JOINED,
    Construction,
    What,
    head_sizes,
    is_describing,
    is_one_of,
    is_placing,
    num_steps,
)
from kinetix_dist.level.draft import Draft
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS
from kinetix_dist.level.roles import Role


def allowed(building: Construction, step: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Array, ...]:
    """[choices] bool of each head; at least one choice of each is allowed.

    step: int32, number of the action to come. The same for a whole batch (`jax.vmap` with `in_axes` None), it saves
    the search for places in steps that place nothing.
    """
    describes, places = is_describing(step, capacity), is_placing(step, capacity)
    pushes = ~describes & ~places
    joins = places & is_one_of(building.what, JOINED)
    stands_free = places & ~joins & (building.what != What.NOTHING)
    nowhere = jnp.zeros(GRID**2, bool), jnp.zeros((capacity.shapes - NUM_WALLS) * ANCHORS**2, bool)
    place, attach = jax.lax.cond(
        places, lambda: (free_places(building, capacity), free_joints(building, capacity)), lambda: nowhere
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
    holds_box, holds_circle = (can_hold(draft, capacity, is_box).any() for is_box in (True, False))
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
