"""Heads and choices of an action, and the level under construction with its beginning and end."""

from __future__ import annotations

import dataclasses
import enum
import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import Draft, Shapes, draft_to_level, empty_draft, num_permutation_draws, permute_slots
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, NUM_WALLS, WORLD_SIZE_M, Level
from kinetix_dist.level.walls import FLOOR_TOP_M

GRID = 8  # cells along each side of the box, for centres of free shapes
ANCHORS = 3  # along each side of a shape, for joints and thrusters
NUM_SIZES, NUM_ANGLES, NUM_STRENGTHS, NUM_SPEEDS = 5, 16, 4, 4
LIMITS_RAD = (0.0, math.pi / 4, math.pi / 2)  # of a hinge between boxes, to both sides; 0: none
NUM_DRAWS = 8  # uniform numbers of a step


class Addition(enum.IntEnum):
    """Shape or thruster that a step adds."""

    NOTHING = 0
    BOX = 1
    CIRCLE = 2
    JOINED_BOX = 3
    JOINED_CIRCLE = 4
    RED_BOX = 5
    RED_CIRCLE = 6
    THRUSTER = 7


BOXES = (Addition.BOX, Addition.JOINED_BOX, Addition.RED_BOX)
JOINED = (Addition.JOINED_BOX, Addition.JOINED_CIRCLE)
RED = (Addition.RED_BOX, Addition.RED_CIRCLE)


class Motor(enum.IntEnum):
    """Motion that a joint allows."""

    FREE = 0  # a hinge that turns freely
    DRIVEN = 1  # a hinge with a motor
    WELD = 2


HEADS = (
    "addition",  # of `Addition`
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


def head_sizes(capacity: Capacity) -> tuple[int, ...]:
    """Choices of each head."""
    sizes = {
        "addition": len(Addition),
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
    addition: Array  # int32, of `Addition`: the shape that was described and is to be placed
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
    return max(math.hypot(box * config.large_rectangle_scale, box), largest_radius(config))


def largest_radius(config: GeneratorConfig) -> float:
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
    return Construction(
        draft=draft, addition=jnp.int32(Addition.NOTHING), shape=nothing, own_anchor=jnp.zeros(2, jnp.float32)
    )


def num_order_draws(capacity: Capacity) -> int:
    """Number of uniform numbers that `finish` uses."""
    return num_permutation_draws(empty_draft(capacity))


def finish(building: Construction, order_draws: Array, capacity: Capacity) -> Level:
    """The level that was built, its slots in random order. order_draws [num_order_draws] in [0, 1)."""
    return derive(*draft_to_level(permute_slots(order_draws, building.draft, capacity.polygons), capacity))


# Kinds of steps


def num_shape_steps(capacity: Capacity) -> int:
    return 2 * (capacity.shapes - NUM_WALLS)


def is_describing(step: Array, capacity: Capacity) -> Array:
    return (step < num_shape_steps(capacity)) & (step % 2 == 0)


def is_placing(step: Array, capacity: Capacity) -> Array:
    return (step < num_shape_steps(capacity)) & (step % 2 == 1)


def is_one_of(addition: Array, kinds: tuple[Addition, ...]) -> Array:
    return (addition[..., None] == jnp.array(kinds, jnp.int32)).any(-1)
