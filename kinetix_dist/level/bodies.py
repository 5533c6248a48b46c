"""Bodies of the levels of `locomotion.py`, each built about an origin of its own. docs/level_format.md has pictures."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Literal

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from jax2d.settings import Settings
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M
from kinetix_dist.level.roles import Role
from kinetix_dist.level.things import Draws, Hinge, Jet, Part, Thing, extent, mirrored_jets, moved
from kinetix_dist.level.walls import FLOOR_TOP_M

WALL_MARGIN_M = 0.1  # from a wall to what begins beside it
CLEARANCE_M = 0.01  # above what carries it, so that nothing touches it at the start
MAX_LEGS = 3  # of a walker
MAX_LINKS = 4  # of an arm
MAX_SNAKE_LINKS = 6
MAX_PENDULUM_LINKS = 3
MAX_BLOCKS = 3  # in the way of a flyer
MAX_BARS = 3  # over a climber
ROPE_LINKS = 3  # of what a lander carries
GRAVITY_M_S2 = 9.81
NEWTON = 0.1  # thruster power that gives one
MOTOR_RAD_S2 = Settings.base_motor_power  # that a motor of power 1 gives to its two bodies alone


def build_unicycle(draws: Draws, capacity: Capacity) -> Thing:
    """A box above a wheel."""
    radius = draws.between(0.14, 0.28)
    # Tall enough that it stands out above the wheel: green is what must touch blue.
    half = jnp.stack([draws.between(0.1, 0.3), draws.between(0.8 * radius, 0.35)])
    height = half[1] * draws.between(0.75, 0.95)
    wheel = Part(position=jnp.zeros(2, jnp.float32), radius=radius)
    body = Part(position=jnp.stack([jnp.zeros((), jnp.float32), height]), half=half, role=Role.GREEN)
    return Thing(parts=[body, wheel], hinges=[Hinge(a=0, b=1, at=jnp.zeros(2, jnp.float32))])


def build_car(draws: Draws, capacity: Capacity) -> Thing:
    """A chassis on two wheels of different sizes, both on the floor. It is about as long as the wheels reach, so that
    no wheel keeps green from the goal."""
    return _car(draws, jnp.ones((), jnp.float32))


def _car(draws: Draws, scale: Array) -> Thing:
    """The car with all its lengths times `scale`."""
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
    return Thing(parts=[chassis, *wheels], hinges=[Hinge(a=0, b=1 + k, at=axle) for k, axle in enumerate(axles)])


def build_walker(draws: Draws, capacity: Capacity) -> Thing:
    """A torso on legs of one or two links: as many as there is room for, 2 at least where there is."""
    room = min(capacity.polygons - NUM_WALLS - 1, capacity.joints)
    max_legs = min(room, MAX_LEGS)
    has_shins = room >= 2 * max_legs
    torso_half = jnp.stack([draws.between(0.2, 0.5), draws.between(0.08, 0.16)])
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)]
    hinges: list[Hinge] = []
    num_legs, with_shins = draws.number(min(2, max_legs), max_legs), draws.chance(0.6)
    thigh, shin = (jnp.stack([draws.between(0.04, 0.08), draws.between(0.14, 0.28)]) for _ in range(2))
    for leg in range(max_legs):
        # Hips are spread evenly under the torso, whatever the number of legs.
        share = (leg + 0.5) / jnp.maximum(num_legs, 1) * 2.0 - 1.0
        hip = jnp.stack([0.85 * share * torso_half[0], -0.7 * torso_half[1]])
        active = leg < num_legs
        knee = _add_link(draws, parts, hinges, 0, hip, thigh, active)
        if has_shins:
            _add_link(draws, parts, hinges, len(parts) - 1, knee, shin, active & with_shins)
    return Thing(parts=parts, hinges=hinges)


def _add_link(
    draws: Draws,
    parts: list[Part],
    hinges: list[Hinge],
    of: int,
    at: Array,
    half: Array,
    active: Array,
    lean: Array | None = None,
    motion: Literal["motor", "free", "welded"] = "motor",
    bend: Array | float = 0.0,
    is_stiff: Array | bool = False,
) -> Array:
    """Hangs a box with its upper end at a point of part `of`, at an angle (rad, None: any); where its other end is.
    bend: the middle of what a motor turns it by, from -1 to 1 times half of that. is_stiff: it is welded instead."""
    angle = draws.between(-0.45, 0.45) if lean is None else lean
    down = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    inside = 0.85 * half[1]
    parts.append(Part(position=at + inside * down, angle=angle, half=half, active=active))
    has_motor = motion == "motor"
    limit = draws.between(0.5, 1.2) if has_motor else None
    hinges.append(
        Hinge(
            a=of,
            b=len(parts) - 1,
            at=at,
            limit=limit,
            bend=0.0 if limit is None else bend * limit,
            has_motor=has_motor,
            is_weld=is_stiff if has_motor else motion == "welded",
            active=active,
        )
    )
    return at + 2.0 * inside * down


def build_arm(draws: Draws, capacity: Capacity) -> Thing:
    """Links on a fixed disc, all to one side of it; the goal is to the other side, within reach."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints, MAX_LINKS)
    count = draws.number(min(2, num_links), num_links)
    reach = draws.between(0.8, 1.4)
    towards = -0.5 * math.pi + draws.between(-1.0, 1.0)  # hangs, so that few fall onto their goal
    parts, hinges = _links_on_a_disc(draws, num_links, count, reach, towards)
    behind = _behind_the_links(draws, towards)
    goal = jnp.maximum(0.6, draws.between(0.5, 0.9) * reach) * behind
    middle = jnp.stack([draws.between(1.8, WORLD_SIZE_M - 1.8), draws.between(FLOOR_TOP_M + 1.7, 3.2)])
    return Thing(parts=parts, hinges=hinges, middle=middle, goal=goal)


def build_reacher(draws: Draws, capacity: Capacity) -> Thing:
    """A longer arm, whose goal is half of the time where it must be about straight. In two fifths the last link is blue
    and the goal green, and in half of these the first link is red."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints, MAX_LINKS)
    count = draws.number(2, num_links)
    reach = draws.between(0.8, 1.8)
    towards = -0.5 * math.pi + draws.between(-1.0, 1.0)
    goal_is_green = draws.chance(0.4)
    first_is_red = goal_is_green & draws.chance(0.5)
    parts, hinges = _links_on_a_disc(draws, num_links, count, reach, towards)
    parts[1] = dataclasses.replace(parts[1], role=jnp.where(first_is_red, Role.RED, parts[1].role))
    share = jnp.where(draws.chance(0.5), draws.between(0.85, 1.0), draws.between(0.4, 0.85))
    goal = jnp.maximum(0.6, share * reach) * _behind_the_links(draws, towards)
    room = reach + 0.3  # from the middle to the walls: for the links, and for the goal at its largest
    x = draws.between(room, WORLD_SIZE_M - room)
    y = draws.between(FLOOR_TOP_M + room, jnp.minimum(3.2, WORLD_SIZE_M - room))
    return Thing(parts=parts, hinges=hinges, middle=jnp.stack([x, y]), goal=goal, goal_is_green=goal_is_green)


def _links_on_a_disc(
    draws: Draws, num_links: int, count: Array, reach: Array, towards: Array
) -> tuple[list[Part], list[Hinge]]:
    """The fixed disc and `count` links within 0.6 rad of one direction (rad), the last one green."""
    parts = [Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.1, 0.18), is_fixed=True)]
    hinges, at = [], jnp.zeros(2, jnp.float32)
    length = reach / count
    width = draws.between(0.04, 0.08)
    for link in range(num_links):
        angle = towards + draws.between(-0.6, 0.6)
        along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        active = link < count
        role = jnp.where(link == count - 1, Role.GREEN, Role.NONE)
        half = jnp.stack([0.5 * length + 0.5 * width, width])
        parts.append(Part(position=at + 0.5 * length * along, angle=angle, half=half, role=role, active=active))
        hinges.append(Hinge(a=link, b=link + 1, at=at, active=active))
        at = at + length * along
    return parts, hinges


def _behind_the_links(draws: Draws, towards: Array) -> Array:
    """[2] a direction. Links keep within 0.6 rad of `towards`; what is more than 1.9 rad from it is behind them all."""
    angle = towards + math.pi + draws.between(-1.0, 1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def build_runner(draws: Draws, capacity: Capacity) -> Thing:
    """A torso on one leg or two legs of thigh, shin and foot, as hoppers and cheetahs have: knees and feet one way.

    Feet may be of one piece with the shins, and the motors of colours of their own; where the goal is at any distance,
    it has to run for seconds.
    """
    legs = 2 if min(capacity.polygons - NUM_WALLS - 1, capacity.joints) >= 6 else 1
    has_two = draws.chance(0.6) & (legs == 2)
    along, across = draws.between(0.35, 0.7), draws.between(0.07, 0.13)
    # One leg carries an upright torso, two a level one.
    upright = jnp.stack([draws.between(0.1, 0.15), draws.between(0.22, 0.36)])
    torso_half = jnp.where(has_two, jnp.stack([along, across]), upright)
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)]
    hinges: list[Hinge] = []
    bend = draws.between(0.0, 0.5)
    thigh, shin = (jnp.stack([draws.between(0.05, 0.075), draws.between(0.17, 0.27)]) for _ in range(2))
    foot = jnp.stack([draws.between(0.12, 0.22), draws.between(0.04, 0.055)])
    is_stiff, goal_is_anywhere, colours_in_turn = draws.chance(0.4), draws.chance(0.5), draws.chance(0.5)
    for leg in range(legs):
        active = has_two if leg else jnp.array(True)
        hip = jnp.where(has_two, (0.8 if leg else -0.8) * torso_half[0], 0.0)
        knee = _add_link(draws, parts, hinges, 0, jnp.stack([hip, -0.7 * torso_half[1]]), thigh, active, lean=bend)
        ankle = _add_link(draws, parts, hinges, len(parts) - 1, knee, shin, active, lean=-bend)
        parts.append(Part(position=ankle + jnp.stack([0.4 * foot[0], 0.0]), half=foot, active=active))
        limit, of = draws.between(0.4, 0.9), len(parts) - 2
        hinges.append(Hinge(a=of, b=of + 1, at=ankle, limit=limit, is_weld=is_stiff, active=active))
    return Thing(
        parts=parts,
        hinges=hinges,
        is_handed=True,
        goal_nearness=jnp.where(goal_is_anywhere, 1, 2),
        colours_in_turn=colours_in_turn,
    )


def build_sprinter(draws: Draws, capacity: Capacity) -> Thing:
    """What MuJoCo's tasks run with, with motors at their limits, weak ones or any: a hopper, a walker whose two legs
    have one hip, a cheetah, or a swimmer on the floor. Knees bend to both sides or mostly to one; of hoppers and
    walkers a fifth have stiff ones, and a few have no feet. The goal is at any distance, near in a third of the levels
    and at the far wall in another, and often a tall box."""
    form = draws.number(0, 6)  # 0 and 1: a hopper
    is_walker, is_cheetah, is_swimmer = (form == 2) | (form == 3), (form == 4) | (form == 5), form == 6
    width = draws.between(0.045, 0.075)
    upright = jnp.stack([width * draws.between(1.0, 2.2), draws.between(0.14, 0.32)])
    level = jnp.stack([draws.between(0.35, 0.7), draws.between(0.05, 0.1)])
    thigh, shin = (jnp.stack([width, draws.between(0.13, 0.28)]) for _ in range(2))
    torso_half = jnp.where(is_cheetah, level, jnp.where(is_swimmer, thigh[::-1], upright))
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=torso_half, role=Role.GREEN)]
    hinges: list[Hinge] = []
    foot = jnp.stack([draws.between(0.08, 0.2), draws.between(0.045, 0.075)])
    is_stiff, legs_are_spread = draws.chance(0.4) | is_cheetah, draws.chance(0.5)
    has_two = is_walker | is_cheetah | (is_swimmer & draws.chance(0.4))
    has_feet, has_knees = ~is_swimmer & draws.chance(0.85), is_swimmer | is_cheetah | draws.chance(0.8)
    bends_one_way, way = draws.chance(0.4) & ~is_swimmer, jnp.where(draws.chance(0.5), 0.75, -0.75)
    knee_bend = jnp.where(bends_one_way, way, 0.0)
    for leg, side in enumerate((1.0, -1.0)):
        active = has_two if leg else jnp.array(True)
        # Of a cheetah each knee is before or behind its hip, of the others hardly.
        bend = draws.between(0.3, 0.85) * jnp.where(draws.chance(0.5), 1.0, -1.0)
        spread = draws.between(0.0, 0.3) * jnp.where(is_walker, side * legs_are_spread, 1.0)
        lean = jnp.where(is_cheetah, bend, spread)
        along = 0.85 * side * torso_half[0] * (is_cheetah | is_swimmer)
        hip = jnp.stack([along, jnp.where(is_swimmer, 0.0, -0.7 * torso_half[1])])
        # A swimmer's links lie in a row.
        leans = [jnp.where(is_swimmer, 0.5 * math.pi * side, lean), jnp.where(is_swimmer, 0.5 * math.pi * side, -lean)]
        knee = _add_link(draws, parts, hinges, 0, hip, thigh, active, lean=leans[0])
        of = len(parts) - 1
        ankle = _add_link(
            draws, parts, hinges, of, knee, shin, active, lean=leans[1], bend=knee_bend, is_stiff=~has_knees
        )
        parts.append(Part(position=ankle + jnp.stack([0.4 * foot[0], 0.0]), half=foot, active=active & has_feet))
        limit, of = draws.between(0.4, 0.9), len(parts) - 2
        hinges.append(Hinge(a=of, b=of + 1, at=ankle, limit=limit, is_weld=is_stiff, active=active & has_feet))
    strength, distance = draws.between(0.0, 1.0), draws.between(0.0, 1.0)
    return Thing(
        parts=parts,
        hinges=hinges,
        is_handed=True,
        slab=jnp.stack([draws.between(0.12, 0.25), draws.between(0.25, 0.8)]),
        goal_is_slab=draws.chance(0.6),
        goal_nearness=jnp.where(distance < 0.3, 0, jnp.where(distance < 0.65, 1, 3)),
        has_bump=False,
        has_full_motors=strength < 0.45,
        has_weak_motors=strength > 0.7,
        colours_in_turn=draws.chance(0.8),
        floor_is_red=draws.chance(0.45) & ~is_swimmer,
    )


def build_snake(draws: Draws, capacity: Capacity) -> Thing:
    """Links in a row on the floor, one of them green."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints + 1, MAX_SNAKE_LINKS)
    count = draws.number(min(3, num_links), num_links)
    half = jnp.stack([draws.between(0.75, 1.1) / (count + 1.0), draws.between(0.05, 0.09)])
    green = draws.number(0, num_links - 1) % count
    step, limit = 1.7 * half[0], draws.between(0.7, 1.4)
    parts = [
        Part(
            position=jnp.stack([link * step, jnp.zeros((), jnp.float32)]),
            half=half,
            role=jnp.where(green == link, Role.GREEN, Role.NONE),
            active=link < count,
        )
        for link in range(num_links)
    ]
    hinges = [
        Hinge(
            a=link,
            b=link + 1,
            at=jnp.stack([(link + 0.5) * step, jnp.zeros((), jnp.float32)]),
            limit=limit,
            active=link + 1 < count,
        )
        for link in range(num_links - 1)
    ]
    return Thing(parts=parts, hinges=hinges, goal_nearness=3, floor_is_red=jnp.array(False))


def build_cartpole(draws: Draws, capacity: Capacity) -> Thing:
    """A green pole that stands on a cart, held by nothing but a hinge. Wheels with motors, or jets to both sides.

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
    parts, hinges = [cart, pole], [Hinge(a=0, b=1, at=hinge_at, has_motor=False)]
    if may_roll:
        for side in (-1.0, 1.0):
            axle = jnp.stack([side * 0.8 * cart_half[0], -0.7 * cart_half[1]])
            parts.append(Part(position=axle, radius=radius, active=has_wheels))
            hinges.append(Hinge(a=0, b=len(parts) - 1, at=axle, active=has_wheels))
    mass = 4.0 * (cart_half[0] * cart_half[1] + pole_half[0] * pole_half[1])
    if may_have_tip:
        tip, tip_radius = hinge_at + 1.9 * pole_half[1] * up, draws.between(0.09, 0.19)
        parts.append(Part(position=tip, radius=tip_radius, role=Role.GREEN, active=has_tip))
        hinges.append(Hinge(a=1, b=len(parts) - 1, at=tip, is_weld=True, active=has_tip))
        mass = mass + jnp.where(has_tip, math.pi * tip_radius**2, 0.0)
    jets = []
    if may_fly:
        power = draws.between(1.2, 2.5) * mass * GRAVITY_M_S2 * NEWTON
        for colour, side in enumerate((-1.0, 1.0)):
            at = jnp.stack([side * 0.8 * cart_half[0], jnp.zeros((), jnp.float32)])
            angle = jnp.asarray(0.0 if side < 0.0 else math.pi)
            jets.append(Jet(of=0, at=at, angle=angle, power=power, colour=colour, active=~has_wheels))
    # The goal is as high as the upper half of the pole: one that fell hardly reaches it.
    return Thing(
        parts=parts,
        hinges=hinges,
        jets=jets,
        goal_rise=(0.55, 0.95),
        goal_nearness=jnp.where(draws.chance(0.3), 1, 3),
        has_bump=False,
        floor_is_red=draws.chance(0.8),
    )


def build_flyer(draws: Draws, capacity: Capacity) -> Thing:
    """A green box or disc with two jets that carry it, in the air, and a gap or blocks on the way. The jets push up
    and to the side, or both tilted."""
    parts, jets, half = _flying(draws, capacity)
    return Thing(
        parts=parts,
        hinges=[],
        jets=jets,
        is_handed=True,
        height=draws.between(0.6, 2.6),
        goal_height=draws.between(0.8, 4.6),
        has_bump=False,
        gap=jnp.max(half) + draws.between(0.25, 0.8),
        num_blocks=MAX_BLOCKS,
        floor_is_red=draws.chance(0.6),
    )


def _flying(draws: Draws, capacity: Capacity) -> tuple[list[Part], list[Jet], Array]:
    """A green box and, where there is room, a green disc, one of them active; its two jets, and its half extents ([2]
    m)."""
    is_disc = draws.chance(0.5) if capacity.circles >= 2 else jnp.array(False)
    box = jnp.stack([draws.between(0.13, 0.25), draws.between(0.09, 0.18)])
    radius = draws.between(0.13, 0.27)
    half = jnp.where(is_disc, radius, box)
    weight = jnp.where(is_disc, math.pi * radius**2, 4.0 * box[0] * box[1]) * GRAVITY_M_S2
    is_pair = draws.chance(0.6)
    # Of the weight, by all that push up; in some levels it only just rises.
    lift = jnp.where(draws.chance(0.3), draws.between(1.02, 1.2), draws.between(1.2, 2.2))
    sideways = draws.between(0.25, 1.0)  # of the lift, where one pushes to the side
    tilt = draws.between(0.15, 0.5)
    jets = []
    for colour, side in enumerate((-1.0, 1.0)):
        power = weight * NEWTON * lift * jnp.where(is_pair, 0.6, 1.0 if colour == 0 else sideways)
        angle = jnp.where(is_pair, 0.5 * math.pi + tilt * side, 0.5 * math.pi if colour == 0 else 0.0)
        behind = half * jnp.array([0.0, -1.0] if colour == 0 else [-1.0, 0.0], jnp.float32)
        at = jnp.where(is_pair, half * jnp.array([0.7 * side, 0.0], jnp.float32), behind)
        jets.append(Jet(of=is_disc.astype(jnp.int32), at=at, angle=angle, power=power, colour=colour))
    discs = [Part(position=jnp.zeros(2, jnp.float32), radius=radius, role=Role.GREEN, active=is_disc)]
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=box, role=Role.GREEN, active=~is_disc)]
    return parts + (discs if capacity.circles >= 2 else []), jets, half


def build_climber(draws: Draws, capacity: Capacity) -> Thing:
    """What flies, below one bar or up to three that reach over it from the wall on its side, mostly red. The goal is
    above them at the other side. In a quarter there is a shelf below the goal instead, mostly not red."""
    parts, jets, half = _flying(draws, capacity)
    size = jnp.max(half)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)  # of the goal

    def in_world(x: Array, y: Array) -> Array:
        """[2] m, x from the wall on its side."""
        return jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), y])

    start_x, start_y = draws.between(0.5, 1.5), FLOOR_TOP_M + size + draws.between(0.2, 0.8)
    number, thickness = draws.number(1, MAX_BARS), draws.between(0.05, 0.12)  # half of it
    apart = 2.0 * (size + thickness) + draws.between(0.2, 0.5)  # from one bar to the next
    y = start_y + size + thickness + draws.between(0.15, 0.5)
    radius = draws.between(0.12, 0.28)
    above = thickness + 2.0 * jnp.maximum(radius, size) + WALL_MARGIN_M  # from the last bar to the ceiling, at least
    number = jnp.minimum(number, 1 + jnp.floor((WORLD_SIZE_M - above - y) / apart).astype(jnp.int32))
    goal_x = draws.between(0.6 * WORLD_SIZE_M, WORLD_SIZE_M - WALL_MARGIN_M - radius)
    is_shelf, shelf_reach = draws.chance(0.25), radius + draws.between(0.0, 0.6)  # to both sides of the goal
    # It passes on both sides.
    shelf_x = jnp.minimum(goal_x, WORLD_SIZE_M - 2.0 * size - WALL_MARGIN_M - shelf_reach)
    number = jnp.where(is_shelf, 1, number)
    middle, bars = in_world(start_x, start_y), []
    for bar in range(MAX_BARS):
        beyond = start_x + size * draws.between(0.0, 1.0)  # it is over half of what flies at least
        begin, end = draws.between(0.02, 0.4), draws.between(beyond, WORLD_SIZE_M - 2.0 * size - 0.8)
        begin = jnp.where(is_shelf, shelf_x - shelf_reach, begin)
        end = jnp.where(is_shelf, shelf_x + shelf_reach, end)
        role = jnp.where(draws.chance(0.75) ^ is_shelf, Role.RED, Role.NONE)
        at, bar_half = in_world(0.5 * (begin + end), y + bar * apart), jnp.stack([0.5 * (end - begin), thickness])
        bars.append(Part(position=at - middle, half=bar_half, role=role, is_fixed=True, active=bar < number))
    lowest = y + (number - 1) * apart + thickness + radius + CLEARANCE_M
    goal_y = draws.between(lowest, WORLD_SIZE_M - CLEARANCE_M - radius)
    goal_x = jnp.where(
        is_shelf, jnp.clip(goal_x, shelf_x - shelf_reach + radius, shelf_x + shelf_reach - radius), goal_x
    )
    return Thing(
        parts=[*parts, *bars],
        hinges=[],
        jets=[mirrored_jets(jet, side < 0.0) for jet in jets],
        middle=middle,
        goal=in_world(goal_x, goal_y) - middle,
        goal_radius=radius,
        floor_is_red=draws.chance(0.6),
    )


def build_pusher(draws: Draws, capacity: Capacity) -> Thing:
    """A car and, before it, what it is to push to the goal: a green box, or a disc where there is room for one more."""
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
    return Thing(
        parts=parts,
        hinges=car.hinges,
        is_handed=True,
        has_bump=False,
        goal_rise=(0.0, 0.1),
        floor_is_red=jnp.array(False),
    )


def build_beam(draws: Draws, capacity: Capacity) -> Thing:
    """A beam on a pivot with a motor, and a green disc on one side of it; the goal is above the other end."""
    half = jnp.stack([draws.between(0.9, 1.7), draws.between(0.05, 0.08)])
    ball = draws.between(0.1, 0.22)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    pivot = draws.between(0.1, 0.16)
    start = -side * draws.between(0.1, 0.8) * (half[0] - ball)
    parts = [
        # Below the upper side of the beam: what rolls along it passes.
        Part(position=jnp.stack([jnp.zeros((), jnp.float32), 0.5 * half[1] - pivot]), radius=pivot, is_fixed=True),
        Part(position=jnp.zeros(2, jnp.float32), half=half),
        Part(position=jnp.stack([start, half[1] + ball + CLEARANCE_M]), radius=ball, role=Role.GREEN),
    ]
    hinges = [Hinge(a=0, b=1, at=jnp.zeros(2, jnp.float32), limit=draws.between(0.15, 0.5))]
    # A disc that rolls below the goal touches it where the beam is held about level.
    goal_radius = draws.between(0.08, 0.15)
    goal_y = half[1] + 2.0 * ball + draws.between(0.1, 0.8) * goal_radius
    goal = jnp.stack([side * draws.between(0.6, 0.95) * half[0], goal_y])
    middle = jnp.stack([draws.between(1.9, WORLD_SIZE_M - 1.9), draws.between(FLOOR_TOP_M + 1.1, 3.2)])
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=middle,
        goal=goal,
        goal_radius=goal_radius,
        floor_is_red=draws.chance(0.7),
    )


def build_lander(draws: Draws, capacity: Capacity) -> Thing:
    """A green box with two jets at its lower corners, in the air; the goal is a slab on the floor.

    Where there is room, two fifths carry a green disc on a rope of links instead, and half of the others have two legs.
    """
    rope_fits = capacity.joints > ROPE_LINKS and capacity.polygons - NUM_WALLS >= ROPE_LINKS + 4
    has_rope = draws.chance(0.4) if rope_fits else jnp.array(False)
    half = jnp.stack([draws.between(0.11, 0.22), draws.between(0.1, 0.18)])
    half = half * jnp.where(has_rope, draws.between(1.0, 1.8), 1.0)
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=half, role=jnp.where(has_rope, Role.NONE, Role.GREEN))]
    hinges: list[Hinge] = []
    mass = 4.0 * half[0] * half[1]
    if rope_fits:
        has_legs = draws.chance(0.5) & ~has_rope
        leg, splay = jnp.stack([draws.between(0.02, 0.03), draws.between(0.05, 0.09)]), draws.between(0.3, 0.9)
        link = jnp.stack([draws.between(0.03, 0.045), draws.between(0.08, 0.15)])
        # Feet end above the lower side of the box: green is what must touch blue.
        hip_y = 1.9 * leg[1] * jnp.cos(splay) + leg[0] * jnp.sin(splay) - half[1]
        for side in (-1.0, 1.0):
            hip = jnp.stack([side * 0.9 * half[0], hip_y])
            _add_link(draws, parts, hinges, 0, hip, leg, has_legs, lean=side * splay, motion="welded")
        at = jnp.stack([jnp.zeros((), jnp.float32), -0.9 * half[1]])
        for number in range(ROPE_LINKS):
            of = len(parts) - 1 if number else 0
            at = _add_link(draws, parts, hinges, of, at, link, has_rope, lean=jnp.zeros((), jnp.float32), motion="free")
        radius = draws.between(0.1, 0.18)
        load = Part(
            position=at - jnp.stack([jnp.zeros((), jnp.float32), 0.8 * radius]),
            radius=radius,
            role=Role.GREEN,
            active=has_rope,
        )
        hinges.append(Hinge(a=len(parts) - 1, b=len(parts), at=at, has_motor=False, active=has_rope))
        parts.append(load)
        mass = mass + jnp.where(has_legs, 2.0 * 4.0 * leg[0] * leg[1], 0.0)
        mass = mass + jnp.where(has_rope, ROPE_LINKS * 4.0 * link[0] * link[1] + math.pi * radius**2, 0.0)
    lift, tilt = draws.between(1.1, 2.6), draws.between(0.0, 0.5)
    power = 0.5 * lift * mass * GRAVITY_M_S2 * NEWTON / jnp.cos(tilt)
    jets = [
        Jet(
            of=0,
            at=half * jnp.array([0.9 * side, -0.9], jnp.float32),
            angle=0.5 * math.pi + tilt * side,
            power=power,
            colour=colour,
        )
        for colour, side in enumerate((-1.0, 1.0))
    ]
    return Thing(
        parts=parts,
        hinges=hinges,
        jets=jets,
        height=draws.between(0.9, 2.6),
        slab=jnp.stack([draws.between(0.2, 0.6), draws.between(0.03, 0.1)]),
        has_bump=False,
        floor_is_red=draws.chance(0.8),
    )


def build_carrier(draws: Draws, capacity: Capacity) -> Thing:
    """A car with a green box or disc on it that nothing holds, between low walls: it is carried to the goal. Where the
    goal is a slab on the floor there is no wall in front, and the load has to come off there; in two fifths of these it
    falls onto the car first."""
    radius, along = draws.between(0.12, 0.2), draws.between(0.35, 0.6)
    half = jnp.stack([along + draws.between(0.0, 0.2), draws.between(0.04, 0.08)])
    top = 2.0 * radius + CLEARANCE_M  # no wheel stands out above the chassis
    parts = [Part(position=jnp.stack([jnp.zeros((), jnp.float32), top - half[1]]), half=half)]
    hinges: list[Hinge] = []
    for side in (-1.0, 1.0):
        axle = jnp.stack([side * along, radius])
        hinges.append(Hinge(a=0, b=len(parts), at=axle))
        parts.append(Part(position=axle, radius=radius))
    goal_is_slab = draws.chance(0.4)
    wall = jnp.stack([jnp.full((), 0.03, jnp.float32), draws.between(0.02, 0.1)])  # a disc rolls over low ones
    for side in (-1.0, 1.0):
        active = ~goal_is_slab if side > 0.0 else jnp.array(True)
        foot = jnp.stack([side * (half[0] - wall[0]), top - half[1]])
        hinges.append(Hinge(a=0, b=len(parts), at=foot, is_weld=True, active=active))
        parts.append(Part(position=jnp.stack([foot[0], top + wall[1] - 0.5 * half[1]]), half=wall, active=active))
    size = draws.between(0.09, 0.16)
    room = half[0] - 2.0 * wall[0] - size - CLEARANCE_M
    at = jnp.stack([room * draws.between(-1.0, 0.5), top + size + CLEARANCE_M])
    is_disc = draws.chance(0.6)
    falls = goal_is_slab & draws.chance(0.4)
    at = at.at[1].add(jnp.where(falls, draws.between(0.05, 0.3), 0.0))
    parts.append(Part(position=at, half=jnp.stack([size, size]), role=Role.GREEN, active=~is_disc))
    parts.append(Part(position=at, radius=size, role=Role.GREEN, active=is_disc))
    return Thing(
        parts=parts,
        hinges=hinges,
        is_handed=True,
        slab=jnp.stack([draws.between(0.3, 0.9), draws.between(0.02, 0.06)]),
        goal_is_slab=goal_is_slab,
        goal_rise=(0.75, 0.98),  # mostly above the walls, and never above the load
        has_bump=False,
        floor_is_red=draws.chance(0.6),
    )


def build_jumper(draws: Draws, capacity: Capacity) -> Thing:
    """A small car on a platform, and the goal on another one beyond a gap, at most as high. In two fifths a green bar
    stands on the car, on a motor: it reaches the goal over a wider gap."""
    car = _car(draws, draws.between(0.5, 0.8))
    has_bar, bar_half = draws.chance(0.4), jnp.stack([draws.between(0.03, 0.06), draws.between(0.2, 0.4)])
    chassis = dataclasses.replace(car.parts[0], role=jnp.where(has_bar, Role.NONE, Role.GREEN))
    foot = chassis.position + jnp.stack([jnp.zeros((), jnp.float32), 0.5 * chassis.half[1]])
    bar = Part(
        position=foot + jnp.stack([jnp.zeros((), jnp.float32), 0.85 * bar_half[1]]),
        half=bar_half,
        role=Role.GREEN,
        active=has_bar,
    )
    lowest, highest = extent(car.parts)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    gap, drop = draws.between(0.1, 0.5), draws.between(0.0, 0.7)
    gap = gap + jnp.where(has_bar, draws.between(0.0, 0.8), 0.0)
    # About the upper edge at the gap of the platform that the car is on.
    width = highest[0] - lowest[0]
    lengths = jnp.stack([width + draws.between(0.2, 1.0), draws.between(0.6, 1.1)])
    thickness = draws.between(0.04, 0.14)  # half of it
    car = dataclasses.replace(
        car, parts=[chassis, *car.parts[1:], bar], hinges=[*car.hinges, Hinge(a=0, b=3, at=foot, active=has_bar)]
    )
    start = draws.between(0.05, 0.15) - lengths[0] - lowest[0]
    car = moved(
        car, jnp.stack([side * start + jnp.where(side > 0.0, 0.0, -(lowest[0] + highest[0])), CLEARANCE_M - lowest[1]])
    )
    platforms = [
        Part(position=jnp.stack([side * x, y - thickness]), half=jnp.stack([0.5 * length, thickness]), is_fixed=True)
        for x, y, length in (
            (-0.5 * lengths[0], jnp.zeros((), jnp.float32), lengths[0]),
            (gap + 0.5 * lengths[1], -drop, lengths[1]),
        )
    ]
    goal_radius = draws.between(0.1, 0.2)
    goal_x = gap + lengths[1] - goal_radius - draws.between(0.0, 0.2)
    left, right = WALL_MARGIN_M + lengths[0], WORLD_SIZE_M - WALL_MARGIN_M - gap - lengths[1]
    x = draws.between(left, right)
    x = jnp.where(side > 0.0, x, WORLD_SIZE_M - x)
    return Thing(
        parts=[*car.parts, *platforms],
        hinges=car.hinges,
        middle=jnp.stack([x, draws.between(FLOOR_TOP_M + 1.1, 3.2)]),
        goal=jnp.stack([side * goal_x, goal_radius + CLEARANCE_M - drop]),
        goal_radius=goal_radius,
        colours_in_turn=has_bar & draws.chance(0.8),
        floor_is_red=draws.chance(0.7),
    )


def build_thrower(draws: Draws, capacity: Capacity) -> Thing:
    """An arm that turns about a fixed disc, and a green disc that nothing holds: on the far end of a level arm, which
    throws it over the pivot, or on the tip of an upright one; in two fifths it falls onto it first. The goal is some
    way off."""
    half = jnp.stack([draws.between(0.3, 0.6), draws.between(0.03, 0.06)])
    ball, pivot, goal_radius = draws.between(0.08, 0.16), draws.between(0.06, 0.1), draws.between(0.12, 0.55)
    is_upright, side = draws.chance(0.3), jnp.where(draws.chance(0.5), 1.0, -1.0)
    is_seesaw = draws.chance(0.2)  # the pivot is about in the middle; then the arm is long enough for pivot and disc
    half = half.at[0].max(jnp.where(is_seesaw, 0.45, 0.0))
    out = jnp.where(is_seesaw, draws.between(0.0, 0.3), draws.between(0.5, 0.9)) * half[0]  # from pivot to middle
    inset = draws.between(0.6, 1.4) * ball
    gap = jnp.where(draws.chance(0.4), draws.between(0.05, 0.5), CLEARANCE_M)  # between the disc and the arm
    zero = jnp.zeros((), jnp.float32)
    middle_of_arm = jnp.where(is_upright, jnp.stack([zero, out]), jnp.stack([-side * out, zero]))
    end = out + half[0]
    on_tip = jnp.stack([zero, end + ball + gap])
    on_arm = jnp.stack([-side * (end - inset), half[1] + ball + gap])
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=pivot, is_fixed=True),
        Part(position=middle_of_arm, angle=jnp.where(is_upright, 0.5 * math.pi, 0.0), half=half),
        Part(position=jnp.where(is_upright, on_tip, on_arm), radius=ball, role=Role.GREEN),
    ]
    away = draws.between(jnp.maximum(0.9, half[0] - out + goal_radius + 0.1), 2.5)
    x = draws.between(WALL_MARGIN_M + end, WORLD_SIZE_M - WALL_MARGIN_M - away - goal_radius)
    low = FLOOR_TOP_M + jnp.maximum(0.4, half[0] - out + 0.05)
    y = draws.between(low, jnp.minimum(3.2, WORLD_SIZE_M - WALL_MARGIN_M - end - gap - 2.0 * ball))
    lowest = FLOOR_TOP_M + CLEARANCE_M + goal_radius
    goal_y = jnp.where(draws.chance(0.5), lowest, draws.between(lowest, jnp.maximum(lowest, y + 0.6)))
    return Thing(
        parts=parts,
        hinges=[Hinge(a=0, b=1, at=jnp.zeros(2, jnp.float32))],
        middle=jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), y]),
        goal=jnp.stack([side * away, goal_y - y]),
        goal_radius=goal_radius,
        has_full_motors=draws.chance(0.4),
        floor_is_red=draws.chance(0.4),
    )


def build_turner(draws: Draws, capacity: Capacity) -> Thing:
    """A blue disc and, below it, a red one, in the air and on one motor; green is a slab on the floor. Where there is
    room, half have a blue box instead of the disc. The blue one has to come down first."""
    may_be_box = capacity.polygons - NUM_WALLS >= 2
    radii = [draws.between(0.1, 0.25) for _ in range(2)]
    box = jnp.stack([draws.between(0.08, 0.3), draws.between(0.06, 0.15)])
    is_box = draws.chance(0.5) if may_be_box else jnp.array(False)
    direction = draws.between(0.1, 0.9) * math.pi  # of the blue one, above the red one
    apart = draws.between(0.4, 1.0) * (radii[0] + radii[1]) * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    at = draws.between(0.0, 1.0) * apart
    blue, red = Role.GREEN, Role.RED  # exchanged with the goal's
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=radii[1], role=red),
        Part(position=apart, radius=radii[0], role=blue, active=~is_box),
    ]
    hinges = [Hinge(a=0, b=1, at=at, active=~is_box)]
    if may_be_box:
        parts.append(Part(position=apart, angle=direction, half=box, role=blue, active=is_box))
        hinges.append(Hinge(a=0, b=2, at=at, active=is_box))
    slab = jnp.stack([draws.between(1.2, 2.3), draws.between(0.03, 0.1)])
    middle = jnp.stack([draws.between(0.9, WORLD_SIZE_M - 0.9), draws.between(FLOOR_TOP_M + 1.2, 4.2)])
    slab_x = draws.between(WALL_MARGIN_M + slab[0], WORLD_SIZE_M - WALL_MARGIN_M - slab[0])
    slab_y = FLOOR_TOP_M + CLEARANCE_M + slab[1]
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=middle,
        goal=jnp.stack([slab_x, slab_y]) - middle,
        slab=slab,
        goal_is_green=True,
        has_bump=False,
        floor_is_red=jnp.array(False),
    )


def build_flipper(draws: Draws, capacity: Capacity) -> Thing:
    """A car with a blue wheel and a red one, the red one beside the goal, and two thrusters somewhere on it that push
    up. It has to turn over, so that the blue one comes first; green is a box on the floor."""
    radius = draws.between(0.14, 0.36)
    along = radius + draws.between(0.05, 0.25)
    half = jnp.stack([along, draws.between(0.06, 0.12)])
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)  # of the goal, from the car
    blue, red = Role.GREEN, Role.RED  # exchanged with the goal's
    axles = [jnp.stack([way * side * along, jnp.zeros((), jnp.float32)]) for way in (-1.0, 1.0)]
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=half)]
    parts += [Part(position=axle, radius=radius, role=role) for axle, role in zip(axles, (blue, red), strict=True)]
    mass = 4.0 * half[0] * half[1] + 2.0 * math.pi * radius**2
    power = draws.between(0.65, 2.0) * mass * GRAVITY_M_S2 * NEWTON
    jets = [
        Jet(
            of=0,
            at=half * jnp.stack([draws.between(-0.9, 0.9), jnp.full((), -0.9, jnp.float32)]),
            angle=jnp.asarray(0.5 * math.pi),
            power=power,
            colour=colour,
        )
        for colour in range(2)
    ]
    slab = jnp.stack([draws.between(0.15, 0.35), draws.between(0.2, 0.5)])
    away = along + radius + draws.between(0.1, 1.0) + slab[0]
    reach = along + radius
    x = draws.between(WALL_MARGIN_M + reach, WORLD_SIZE_M - WALL_MARGIN_M - away - slab[0])
    floor = FLOOR_TOP_M + CLEARANCE_M
    middle = jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), floor + radius])
    return Thing(
        parts=parts,
        hinges=[Hinge(a=0, b=1 + k, at=axle) for k, axle in enumerate(axles)],
        jets=jets,
        middle=middle,
        goal=jnp.stack([side * away, slab[1] - radius]),
        slab=slab,
        goal_is_green=True,
        has_bump=False,
        floor_is_red=jnp.array(False),
    )


def _link_to(
    side: Array, start: Array, angle: Array, length: Array, half_width: Array | float, beyond: Array | float = 0.0
) -> tuple[Part, Array]:
    """A box of so much length ([] m) from `start` ([2] m) on, reaching beyond both ends, and its end.

    angle: rad, as where `side` is 1; where it is -1 left and right are exchanged.
    """
    way = jnp.stack([side * jnp.cos(angle), jnp.sin(angle)])
    half = jnp.stack([0.5 * length + beyond, jnp.asarray(half_width)])
    return Part(position=start + 0.5 * length * way, angle=side * angle, half=half), start + length * way


def build_grasper(draws: Draws, capacity: Capacity) -> Thing:
    """An arm of two links on a fixed disc, and a hand of two fingers; on the lower one lies a green box that nothing
    holds. The goal is a slab on the floor, mostly behind the arm."""
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    upper, fore, finger = draws.between(0.5, 0.8), draws.between(0.4, 0.7), draws.between(0.25, 0.4)
    width, palm = draws.between(0.03, 0.05), draws.between(0.16, 0.22)
    lean, lower_rise, upper_rise = draws.between(-0.3, 0.3), draws.between(0.0, 0.12), draws.between(0.0, 0.5)
    size, along = draws.between(0.05, 0.075), draws.between(0.35, 0.8)

    def mirrored(x: Array, y: Array) -> Array:
        return jnp.stack([side * x, y])

    link = functools.partial(_link_to, side)
    zero = jnp.zeros((), jnp.float32)
    upper_arm, elbow = link(jnp.zeros(2, jnp.float32), lean - 0.5 * math.pi, upper, width)
    forearm, wrist = link(elbow, zero, fore, width)
    knuckles = [wrist + jnp.stack([zero, end * palm]) for end in (-1.0, 1.0)]
    fingers = [
        link(knuckle, rise, finger, 0.03)[0] for knuckle, rise in zip(knuckles, (lower_rise, upper_rise), strict=True)
    ]
    on = mirrored(jnp.cos(lower_rise), jnp.sin(lower_rise)), mirrored(-jnp.sin(lower_rise), jnp.cos(lower_rise))
    load = knuckles[0] + (along * (finger - size) + size) * on[0] + (0.03 + size + CLEARANCE_M) * on[1]
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.08, 0.14), is_fixed=True),
        upper_arm,
        forearm,
        Part(position=wrist, half=jnp.stack([jnp.full((), 0.03, jnp.float32), palm])),
        *fingers,
        Part(position=load, angle=side * lower_rise, half=jnp.stack([size, size]), role=Role.GREEN),
    ]
    limit = jnp.full((), 0.8, jnp.float32)
    hinges = [
        Hinge(a=0, b=1, at=jnp.zeros(2, jnp.float32)),
        Hinge(a=1, b=2, at=elbow),
        Hinge(a=2, b=3, at=wrist, is_weld=True),
        *(Hinge(a=3, b=4 + number, at=knuckle, limit=limit) for number, knuckle in enumerate(knuckles)),
    ]
    slab = jnp.stack([draws.between(0.15, 0.4), draws.between(0.03, 0.08)])
    middle = jnp.stack([draws.between(1.7, WORLD_SIZE_M - 1.7), FLOOR_TOP_M + upper + draws.between(0.45, 1.2)])
    goal = jnp.stack([middle[0] + side * draws.between(-1.2, 0.3), FLOOR_TOP_M + CLEARANCE_M + slab[1]])
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=middle,
        goal=goal - middle,
        slab=slab,
        has_bump=False,
        floor_is_red=draws.chance(0.5),
    )


def build_pendulum(draws: Draws, capacity: Capacity) -> Thing:
    """A chain of up to three links that hangs from a fixed disc, with motors in some of its hinges, in four fifths too
    weak to hold it level; the last link is green, or a box at its end. The goal is beside or above: it has to be swung
    up."""
    has_room = capacity.polygons - NUM_WALLS >= 3 and capacity.joints >= 3
    num_links = min(capacity.polygons - NUM_WALLS - has_room, capacity.joints - has_room, MAX_PENDULUM_LINKS)
    count, reach = draws.number(1, num_links), draws.between(0.7, 1.6)
    has_bob = draws.chance(0.4) if has_room else jnp.array(False)
    length, width = reach / count, draws.between(0.04, 0.07)
    driven = draws.number(0, num_links - 1) % count  # one at least
    parts, hinges = [Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.08, 0.16), is_fixed=True)], []
    zero = jnp.zeros((), jnp.float32)
    for link in range(num_links):
        role = jnp.where((link == count - 1) & ~has_bob, Role.GREEN, Role.NONE)
        top = jnp.stack([zero, -link * length])
        half = jnp.stack([width, 0.5 * length + width])
        parts.append(Part(position=top - 0.5 * jnp.stack([zero, length]), half=half, role=role, active=link < count))
        has_motor = (driven == link) | draws.chance(0.4)
        hinges.append(Hinge(a=link, b=link + 1, at=top, has_motor=has_motor, active=link < count))
    size = draws.between(0.09, 0.2)
    if has_room:
        end = jnp.stack([zero, -reach])
        parts.append(Part(position=end, half=jnp.stack([size, size]), role=Role.GREEN, active=has_bob))
        # The last link that there is holds it.
        hinges += [
            Hinge(a=1 + link, b=len(parts) - 1, at=end, is_weld=True, active=has_bob & (link == count - 1))
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
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=jnp.stack([x, y]),
        goal=goal,
        goal_radius=goal_radius,
        motor_power=jnp.where(draws.chance(0.8), draws.between(0.1, 0.9), 4.0) * holding,
        floor_is_red=draws.chance(0.2),
    )


def build_ramp(draws: Draws, capacity: Capacity) -> Thing:
    """A small car on the floor before a steep ramp, a red slab behind it, and the goal beyond: fast enough, it flies
    over. Green is the chassis or the wheel in front."""
    car = _car(draws, draws.between(0.5, 0.75))
    lowest, highest = extent(car.parts)
    wheel_is_green, side = draws.chance(0.4), jnp.where(draws.chance(0.5), 1.0, -1.0)
    front = side > 0.0
    roles = [
        jnp.where(wheel_is_green, Role.NONE, Role.GREEN),
        jnp.where(wheel_is_green & ~front, Role.GREEN, Role.NONE),
        jnp.where(wheel_is_green & front, Role.GREEN, Role.NONE),
    ]
    parts = [dataclasses.replace(part, role=role) for part, role in zip(car.parts, roles, strict=True)]
    # From the end of the car on, all to one side: ramp, slab, goal.
    half, slope = jnp.stack([draws.between(0.15, 0.36), jnp.full((), 0.05, jnp.float32)]), draws.between(0.2, 0.8)
    cos, sin = jnp.cos(slope), jnp.sin(slope)
    ramp_x = draws.between(0.1, 0.7) + half[0] * cos + half[1] * sin
    ramp_y = half[0] * sin - 0.5 * half[1]  # its lower end is in the floor
    red = jnp.stack([draws.between(0.15, 0.4), draws.between(0.02, 0.05)])
    red_x = ramp_x + half[0] * cos + half[1] + red[0]
    radius, is_slab = draws.between(0.12, 0.25), draws.chance(0.5)
    slab = jnp.stack([draws.between(0.12, 0.22), draws.between(0.15, 0.4)])
    goal_half = jnp.where(is_slab, slab, radius)
    goal_x = red_x + red[0] + 0.05 + goal_half[0] + draws.between(0.0, 0.4)
    floor = FLOOR_TOP_M + CLEARANCE_M
    length = goal_x + goal_half[0]
    begin = jnp.where(front, highest[0], -lowest[0])  # from the origin of the car to its end
    width = highest[0] - lowest[0]
    x = WALL_MARGIN_M + width + draws.between(0.0, 1.0) * (WORLD_SIZE_M - 2.0 * WALL_MARGIN_M - width - length)
    middle = jnp.stack([jnp.where(front, x, WORLD_SIZE_M - x) - side * begin, floor - lowest[1]])

    def beside(x: Array, y: Array) -> Array:
        """[2] m, from the origin of the car: x from its end, y from the floor."""
        return jnp.stack([side * (begin + x), FLOOR_TOP_M + y - middle[1]])

    parts += [
        Part(position=beside(ramp_x, ramp_y), angle=side * slope, half=half, is_fixed=True),
        Part(position=beside(red_x, red[1]), half=red, role=Role.RED, is_fixed=True),
    ]
    return Thing(
        parts=parts,
        hinges=car.hinges,
        middle=middle,
        goal=beside(goal_x, CLEARANCE_M + goal_half[1]),
        goal_radius=radius,
        slab=slab,
        goal_is_slab=is_slab,
        has_bump=False,
        has_full_motors=draws.chance(0.8),
        floor_is_red=jnp.array(False),
    )


def build_gripper(draws: Draws, capacity: Capacity) -> Thing:
    """An arm of two links on a fixed disc, and an open hand of two fingers of two links that close towards each other.
    A green box falls between them, or stands on a disc on the floor; the goal is on the floor."""
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    upper, fore, palm, tip = (draws.between(*ends) for ends in ((0.55, 1.0), (0.5, 1.0), (0.2, 0.36), (0.2, 0.36)))
    width, finger_width = draws.between(0.04, 0.09), draws.between(0.03, 0.06)
    lean, spread, size = draws.between(-0.2, 0.2), draws.between(0.2, 0.9), draws.between(0.06, 0.12)
    falls, pedestal = draws.chance(0.5), draws.between(0.12, 0.22)
    limit = draws.between(0.4, 0.6)

    link = functools.partial(_link_to, side)
    upper_arm, elbow = link(jnp.zeros(2, jnp.float32), lean - 0.5 * math.pi, upper, width, beyond=0.5 * width)
    forearm, wrist = link(elbow, jnp.zeros((), jnp.float32), fore, width, beyond=0.5 * width)
    fingers, hinges = [], [Hinge(a=0, b=1, at=jnp.zeros(2, jnp.float32), turn=0), Hinge(a=1, b=2, at=elbow, turn=1)]
    for number, way in enumerate((1.0, -1.0)):  # the upper one, the lower one
        knuckle = wrist + jnp.stack([jnp.zeros((), jnp.float32), way * 0.3 * palm])
        inner, joint = link(knuckle, jnp.asarray(way * 0.5 * math.pi), palm, finger_width, beyond=0.5 * finger_width)
        outer, _ = link(joint, way * spread, tip, finger_width, beyond=0.5 * finger_width)
        fingers += [inner, outer]
        closing, first = -way * side * limit, 3 + 2 * number
        hinges += [
            Hinge(a=of, b=first + place, at=at, limit=limit, bend=closing, turn=2 + number)
            for place, (of, at) in enumerate(((2, knuckle), (first, joint)))
        ]
    reach = upper * jnp.cos(lean) + 1.3 * palm + tip  # below the disc, at most
    above = jnp.where(falls, 0.1, 2.0 * (pedestal + size) + 0.1)
    y = FLOOR_TOP_M + reach + above + draws.between(0.0, 0.4)
    room = fore + jnp.abs(jnp.sin(lean)) * upper + tip + 2.0 * size + 0.3
    x = draws.between(room, WORLD_SIZE_M - 0.9)
    middle = jnp.stack([jnp.where(side < 0.0, x, WORLD_SIZE_M - x), y])
    inside = finger_width + size + draws.between(0.03, 0.15)
    within = wrist + jnp.stack([side * inside, draws.between(-0.2, 0.6) * palm])
    disc_x = wrist[0] + side * draws.between(-0.4, 0.25)
    on_disc = jnp.stack([disc_x, FLOOR_TOP_M + 2.0 * pedestal + size + CLEARANCE_M - y])
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.1, 0.25), is_fixed=True),
        upper_arm,
        forearm,
        *fingers,
        Part(position=jnp.where(falls, within, on_disc), half=jnp.stack([size, size]), role=Role.GREEN),
        Part(position=jnp.stack([disc_x, FLOOR_TOP_M + pedestal - y]), radius=pedestal, is_fixed=True, active=~falls),
    ]
    slab = jnp.stack([draws.between(0.2, 0.45), draws.between(0.03, 0.14)])
    # On the floor of the other side, or nearer, but not where a box that is knocked off its disc falls, where there is
    # room.
    goal_x = middle[0] - side * draws.between(-0.1, 1.2)
    clear = middle[0] + disc_x - side * (pedestal + slab[0] + draws.between(0.4, 0.8))
    goal_x = jnp.where(falls, goal_x, side * jnp.minimum(side * goal_x, side * clear))
    goal_x = jnp.clip(goal_x, WALL_MARGIN_M + slab[0], WORLD_SIZE_M - WALL_MARGIN_M - slab[0])
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=middle,
        goal=jnp.stack([goal_x, FLOOR_TOP_M + CLEARANCE_M + slab[1]]) - middle,
        slab=slab,
        has_bump=False,
        colours_in_turn=True,
        floor_is_red=draws.chance(0.5),
    )


def build_pinball(draws: Draws, capacity: Capacity) -> Thing:
    """Two flippers that guides from the walls lead to, a green disc that falls onto one of them or beside it, and up to
    two fixed discs in its way. The goal is at the side of the other one, above it or its guide."""
    gap, length, width = draws.between(0.08, 0.3), draws.between(0.8, 1.4), draws.between(0.05, 0.09)
    slope, side = draws.between(0.3, 0.8), jnp.where(draws.chance(0.5), 1.0, -1.0)
    run = 0.5 * WORLD_SIZE_M - gap - length  # of a guide, level
    limit = draws.between(0.5, 0.9)
    parts, hinges = [], []
    for number, way in enumerate((-1.0, 1.0)):
        pivot = jnp.stack([way * (gap + length), jnp.zeros((), jnp.float32)])
        rise = 0.5 * run * jnp.tan(slope)
        parts.append(
            Part(
                position=pivot + jnp.stack([0.5 * way * run, rise]),
                angle=way * slope,
                half=jnp.stack([0.5 * run / jnp.cos(slope), width]),
                is_fixed=True,
            )
        )
        parts.append(
            Part(
                position=pivot - jnp.stack([0.5 * way * length, jnp.zeros((), jnp.float32)]),
                half=jnp.stack([0.5 * length + 0.5 * width, width]),
            )
        )
        hinges.append(Hinge(a=2 * number, b=2 * number + 1, at=pivot, limit=limit))
    ball, radius, y = draws.between(0.1, 0.18), draws.between(0.15, 0.35), FLOOR_TOP_M + draws.between(0.7, 1.4)
    ceiling = WORLD_SIZE_M - WALL_MARGIN_M - y

    def lowest(x: Array, disc: Array) -> Array:
        """The y at which a disc of that radius touches a flipper or, beyond its pivot, the guide."""
        return (width + disc) / jnp.cos(slope) + jnp.maximum(x - gap - length, 0.0) * jnp.tan(slope)

    ball_x = draws.between(0.62, 1.3)
    ball_y = draws.between(lowest(ball_x, ball) + 0.05, 2.0)
    parts.append(Part(position=jnp.stack([-side * ball_x, ball_y]), radius=ball, role=Role.GREEN))
    goal_x = draws.between(0.8, 1.9)
    # One in the middle and one beside the wall, where the disc does not begin.
    for low, high, largest in ((-0.08, 0.08, 0.35), (1.75, 2.1, 0.22)):
        at = jnp.stack([-side * draws.between(low, high), draws.between(1.0, ceiling - 0.4)])
        parts.append(Part(position=at, radius=draws.between(0.1, largest), is_fixed=True, active=draws.chance(0.6)))
    return Thing(
        parts=parts,
        hinges=hinges,
        middle=jnp.stack([jnp.full((), 0.5 * WORLD_SIZE_M, jnp.float32), y]),
        goal=jnp.stack([side * goal_x, draws.between(jnp.maximum(0.9, lowest(goal_x, radius)), ceiling - radius)]),
        goal_radius=radius,
        colours_in_turn=draws.chance(0.6),
        floor_is_red=draws.chance(0.7),
    )
