"""Small random changes of a level, on the device inside jit: for curricula that edit levels, and for editing by hand.

    level, changed = mutate(key, level, capacity, config, num_changes=3)

A mutator makes one change and the level stays valid: one green and one blue shape, walls as they are, ends of joints
together. Where it has nothing to change (no free slot, nothing to remove) the level stays as it is and `changed` is
False. `derive` then brings masses and contact permissions up to date. Everything is for one level; `jax.vmap` gives a
batch.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist import prng
from kinetix_dist.level.derive import connections, derive
from kinetix_dist.level.draft import (
    Draft,
    DrivenJoints,
    DrivenThrusters,
    Shapes,
    first_free,
    read_slot,
    with_draft,
    write_slot,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_THRUSTER_COLOURS, NUM_WALLS, WORLD_SIZE_M, Level, Role
from kinetix_dist.level.proposals import NUM_DRAWS, Request, add_best, pick, point_inside, propose
from kinetix_dist.level.walls import FLOOR_TOP_M, GRAVITY_M_S2

MAX_MOVE_M = 1.0  # of a body in one change, along each axis
MAX_SCALING = 1.5  # of a shape's size in one change, up or down
MAX_GRAVITY = 2.0  # times the usual gravity; 0 is allowed
_NUM_DRAWS = 8  # uniform numbers of a mutator that proposes no shape


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Edited:
    """A level whose masses and contact permissions are to be derived again."""

    level: Level
    is_fixed: Array  # [n] bool
    changed: Array  # bool


Mutator = Callable[[Array, Edited, Capacity, GeneratorConfig], Edited]


def mutate(
    key: Array, level: Level, capacity: Capacity, config: GeneratorConfig, num_changes: int = 1
) -> tuple[Level, Array]:
    """The level after `num_changes` mutators, each drawn with equal chance, and whether anything changed (bool).

    Raises ValueError for less than one change. Consumes `key`."""
    if num_changes < 1:
        raise ValueError(f"num_changes is {num_changes}; give 1 or more")

    def change(edited: Edited, key: Array) -> tuple[Edited, None]:
        which_key, draws_key = prng.split(key)
        which = prng.randint(which_key, (), 0, len(MUTATORS))
        branches = [functools.partial(_run, mutator, capacity, config) for mutator in MUTATORS.values()]
        after = jax.lax.switch(which, branches, draws_key, edited)
        return dataclasses.replace(after, changed=after.changed | edited.changed), None

    edited, _ = jax.lax.scan(change, begin(level), prng.split(key, num_changes))
    return derive(edited.level, edited.is_fixed), edited.changed


def apply(name: str, key: Array, level: Level, capacity: Capacity, config: GeneratorConfig) -> tuple[Level, Array]:
    """The level after the mutator of that name, and whether it changed (bool). Raises ValueError for an unknown one."""
    if name not in MUTATORS:
        raise ValueError(f"there is no mutator {name!r}; there are {', '.join(MUTATORS)}")
    edited = _run(MUTATORS[name], capacity, config, key, begin(level))
    return derive(edited.level, edited.is_fixed), edited.changed


def begin(level: Level) -> Edited:
    shapes = level.scene.shapes
    is_fixed = jnp.asarray(shapes.active) & (jnp.asarray(shapes.inverse_mass) == 0)
    return Edited(level=jax.tree.map(jnp.asarray, level), is_fixed=is_fixed, changed=jnp.array(False))


def _run(mutator: Mutator, capacity: Capacity, config: GeneratorConfig, key: Array, edited: Edited) -> Edited:
    """The level after a mutator, or the same level, bit for bit, where it changes nothing."""
    after = mutator(key, edited, capacity, config)
    result = jax.tree.map(lambda new, old: jnp.where(after.changed, new, old), after, edited)
    return dataclasses.replace(result, changed=after.changed)


# Choices of shapes


def _owned(edited: Edited) -> Array:
    """[n] bool, active shapes that are no walls."""
    active = edited.level.scene.shapes.active
    return active & (jnp.arange(active.shape[0]) >= NUM_WALLS)


def _bodies(level: Level) -> Array:
    """[n, n] bool, held together by joints."""
    joints = level.scene.joints
    return connections(joints.a, joints.b, joints.active, level.scene.shapes.active.shape[0])[1]


def _choose(may: Array, draw: Array) -> Array:
    return pick(may.astype(jnp.float32), draw)


def _draws(key: Array) -> Array:
    return prng.uniform(key, (_NUM_DRAWS,))


# Shapes and joints


def add_shape(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """A free shape, as the generator draws them."""
    return _add(key, edited, capacity, config, is_joined=False)


def add_joined_shape(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """A shape that a joint holds to another one, as the generator draws them."""
    return _add(key, edited, capacity, config, is_joined=True)


def _add(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig, *, is_joined: bool) -> Edited:
    draft = draft_of(edited, capacity)
    request = Request(
        is_joined=jnp.array(is_joined),
        force_motor=jnp.array(False),
        may_be_fixed=jnp.array(config.allow_fixed is not False),
        step=jnp.int32(capacity.shapes),
    )
    draws = prng.uniform(key, (config.num_proposals, NUM_DRAWS))
    proposals = jax.vmap(lambda draw: propose(draft, request, draw, capacity.polygons, config))(draws)
    after = add_best(draft, proposals, jnp.array(is_joined), jnp.array(True))
    level = with_draft(edited.level, after, capacity)
    return Edited(level=level, is_fixed=after.shapes.is_fixed, changed=proposals.is_possible.any())


def draft_of(edited: Edited, capacity: Capacity) -> Draft:
    """A level as a draft, for `with_draft`."""
    level, shapes, joints = edited.level, edited.level.scene.shapes, edited.level.scene.joints
    circles, polygons = capacity.circles, capacity.polygons
    ends = (jnp.stack([joints.a, joints.b])[..., None] == jnp.arange(capacity.shapes)) & joints.active[..., None]
    return Draft(
        shapes=Shapes(
            active=shapes.active,
            position=level.position,
            angle=level.angle,
            vertices=jnp.concatenate([shapes.vertices, jnp.zeros((circles, capacity.vertices, 2), jnp.float32)]),
            num_vertices=jnp.concatenate([shapes.num_vertices, jnp.zeros(circles, jnp.int32)]),
            radius=jnp.concatenate([jnp.zeros(polygons, jnp.float32), shapes.radius]),
            role=level.shape_role,
            is_fixed=edited.is_fixed,
            body=jnp.argmax(_bodies(level), axis=-1).astype(jnp.int32),
            num_joints=ends.sum((0, 1)).astype(jnp.int32),
            added_at=jnp.where(shapes.active, 0, -1),
        ),
        driven_joints=DrivenJoints(joints=joints, colour=level.motor_colour),
        driven_thrusters=DrivenThrusters(thrusters=level.scene.thrusters, colour=level.thruster_colour),
    )


def remove_shape(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """A shape that is neither green nor blue, with its joints and thrusters."""
    level, draw = edited.level, _draws(key)
    may = _owned(edited) & (level.shape_role != Role.GREEN) & (level.shape_role != Role.BLUE)
    gone = _choose(may, draw[0])
    scene, joints, thrusters = level.scene, level.scene.joints, level.scene.thrusters
    scene = scene.replace(
        shapes={"active": scene.shapes.active & (jnp.arange(capacity.shapes) != gone)},
        joints={"active": joints.active & (joints.a != gone) & (joints.b != gone)},
        thrusters={"active": thrusters.active & (thrusters.body != gone)},
    )
    here = jnp.arange(capacity.shapes) == gone
    level = dataclasses.replace(level, scene=scene, shape_role=jnp.where(here, Role.NONE, level.shape_role))
    return Edited(level=level, is_fixed=edited.is_fixed & ~here, changed=may.any())


def remove_joint(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    level, joints = edited.level, edited.level.scene.joints
    here = jnp.arange(capacity.joints) == _choose(joints.active, _draws(key)[0])
    scene = level.scene.replace(joints={"active": joints.active & ~here})
    return Edited(level=dataclasses.replace(level, scene=scene), is_fixed=edited.is_fixed, changed=joints.active.any())


# Thrusters


def add_thruster(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """Inside a shape that moves, in any direction."""
    level, draw = edited.level, _draws(key)
    may = _owned(edited) & ~edited.is_fixed
    body = _choose(may, draw[0])
    shapes = draft_of(edited, capacity).shapes
    inverse_mass = level.scene.shapes.inverse_mass[body]
    mass = 1.0 / jnp.where(inverse_mass > 0, inverse_mass, 1.0)
    thruster = Thrusters(
        active=jnp.array(True),
        body=body,
        position=point_inside(read_slot(shapes, body), draw[1:3]),
        angle=2.0 * math.pi * draw[3],
        power=mass * config.thruster_power_factor * (0.5 + 1.5 * draw[4]),
    )
    driven = DrivenThrusters(thrusters=level.scene.thrusters, colour=level.thruster_colour)
    row = DrivenThrusters(thrusters=thruster, colour=jnp.floor(draw[5] * NUM_THRUSTER_COLOURS).astype(jnp.int32))
    active = level.scene.thrusters.active
    after = write_slot(driven, first_free(active), row, jnp.array(True))
    scene = level.scene.replace(thrusters=after.thrusters)
    level = dataclasses.replace(level, scene=scene, thruster_colour=after.colour)
    # A shape that another change has just freed has no mass yet: its thruster would have no power.
    return Edited(level=level, is_fixed=edited.is_fixed, changed=may[body] & (inverse_mass > 0) & ~active.all())


def remove_thruster(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    level, thrusters = edited.level, edited.level.scene.thrusters
    here = jnp.arange(capacity.thrusters) == _choose(thrusters.active, _draws(key)[0])
    scene = level.scene.replace(thrusters={"active": thrusters.active & ~here})
    return Edited(
        level=dataclasses.replace(level, scene=scene), is_fixed=edited.is_fixed, changed=thrusters.active.any()
    )


# Properties of shapes


def swap_roles(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """Exchanges the roles of two shapes."""
    level, draw = edited.level, _draws(key)
    owned = _owned(edited)
    one = _choose(owned & (level.shape_role != Role.NONE), draw[0])
    may = owned & (level.shape_role != level.shape_role[one])
    other = _choose(may, draw[1])
    roles = level.shape_role.at[one].set(level.shape_role[other]).at[other].set(level.shape_role[one])
    changed = may.any() & owned[one] & (level.shape_role[one] != Role.NONE)
    return Edited(level=dataclasses.replace(level, shape_role=roles), is_fixed=edited.is_fixed, changed=changed)


def toggle_fixed(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """Fixes a moving shape or frees a fixed one. Fixed shapes have no thrusters and no speed."""
    level, owned = edited.level, _owned(edited)
    here = jnp.arange(capacity.shapes) == _choose(owned, _draws(key)[0])
    is_fixed, thrusters = edited.is_fixed ^ here, level.scene.thrusters
    carries = here[thrusters.body] & is_fixed[thrusters.body]
    level = dataclasses.replace(
        level,
        scene=level.scene.replace(thrusters={"active": thrusters.active & ~carries}),
        velocity=jnp.where(is_fixed[:, None], 0.0, level.velocity),
        angular_velocity=jnp.where(is_fixed, 0.0, level.angular_velocity),
    )
    return Edited(level=level, is_fixed=is_fixed, changed=owned.any())


def change_size(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """Scales a shape by a factor up to MAX_SCALING or its inverse, within the generator's sizes. Joints stay in
    place."""
    level, draw, polygons = edited.level, _draws(key), capacity.polygons
    owned = _owned(edited)
    here = jnp.arange(capacity.shapes) == _choose(owned, draw[0])
    factor = jnp.exp((2.0 * draw[1] - 1.0) * math.log(MAX_SCALING))
    factors = jnp.where(here, factor, 1.0)
    vertices = level.scene.shapes.vertices * factors[:polygons, None, None]
    radius = level.scene.shapes.radius * factors[polygons:]
    reach = jnp.concatenate([jnp.linalg.norm(vertices, axis=-1).max(-1), radius])
    largest = config.max_shape_size * max(1.0, config.large_rectangle_scale)
    fits = (reach >= min(config.min_radius, config.min_half_extent)) & (reach <= largest)
    scene = level.scene.replace(shapes={"vertices": vertices, "radius": radius})
    return Edited(
        level=dataclasses.replace(level, scene=scene), is_fixed=edited.is_fixed, changed=(owned & here & fits).any()
    )


# Positions of shapes


def move_body(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """A shape with all that joints hold to it, unless a wall is among them; centres stay inside the box."""
    draw = _draws(key)
    by = (2.0 * draw[1:3] - 1.0) * MAX_MOVE_M
    return _move(edited, draw[0], by, jnp.zeros((), jnp.float32))


def turn_body(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """The same, about the shape's centre by any angle."""
    draw = _draws(key)
    return _move(edited, draw[0], jnp.zeros(2, jnp.float32), (2.0 * draw[1] - 1.0) * math.pi)


def _move(edited: Edited, choice: Array, by: Array, turn: Array) -> Edited:
    level, bodies, owned = edited.level, _bodies(edited.level), _owned(edited)
    may = owned & ~bodies[:, :NUM_WALLS].any(-1)
    chosen = _choose(may, choice)
    here = bodies[chosen] & owned
    from_centre = level.position - level.position[chosen]
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    x, y = from_centre[:, 0], from_centre[:, 1]
    turned = level.position[chosen] + jnp.stack([cos * x - sin * y, sin * x + cos * y], -1) + by
    position = jnp.where(here[:, None], turned, level.position)
    inside = (position >= jnp.array([0.0, FLOOR_TOP_M], jnp.float32)).all(-1) & (position <= WORLD_SIZE_M).all(-1)
    level = dataclasses.replace(level, position=position, angle=jnp.where(here, level.angle + turn, level.angle))
    return Edited(level=level, is_fixed=edited.is_fixed, changed=may.any() & (inside | ~here).all())


def change_gravity(key: Array, edited: Edited, capacity: Capacity, config: GeneratorConfig) -> Edited:
    """Downward gravity from none to MAX_GRAVITY times the usual one."""
    down = jnp.asarray(GRAVITY_M_S2) * _draws(key)[0] * MAX_GRAVITY
    scene = edited.level.scene.replace(gravity=down.astype(edited.level.scene.gravity.dtype))
    level = dataclasses.replace(edited.level, scene=scene)
    return Edited(level=level, is_fixed=edited.is_fixed, changed=jnp.array(True))


MUTATORS: dict[str, Mutator] = {
    mutator.__name__: mutator
    for mutator in (
        add_shape,
        add_joined_shape,
        remove_shape,
        remove_joint,
        add_thruster,
        remove_thruster,
        swap_roles,
        toggle_fixed,
        change_size,
        move_body,
        turn_body,
        change_gravity,
    )
}
