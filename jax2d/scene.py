"""What exists in a world and how it moves: Capacity, Scene, State, Controls, Touching.

Kept apart on purpose. A `Scene` holds what cannot change during a step (shapes, masses, joints,
thrusters, who may touch whom) and is replaced only at a reset. A `State` holds what a step changes.

Shapes are indexed polygons first, then circles: shape `i < capacity.polygons` is polygon `i`, shape
`capacity.polygons + j` is circle `j`. Every field below is given for one world; a batch of worlds
has one leading axis more, `[num_worlds, ...]`, on every field. Units: m, kg, s, rad. Vertices run
counter-clockwise about the centre of mass, which is the origin of the body frame.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.whole_numbers import whole_number

MAX_SHAPES = 512  # an int32 contact key has 9 bits for each of two shapes, and 12 for the feature

Array = Any  # jax.Array or numpy.ndarray: fields are traced, stored and compared alike


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capacity:
    """How many of each thing a world has room for. Compile-time: engines are built for one capacity."""

    polygons: int
    circles: int
    joints: int
    thrusters: int
    vertices: int = 4  # most vertices of a polygon

    def __post_init__(self) -> None:
        for name in ("polygons", "circles", "joints", "thrusters", "vertices"):
            if whole_number(f"Capacity.{name}", getattr(self, name)) < 0:
                raise ValueError(f"Capacity.{name} is {getattr(self, name)}; it must be 0 or more")
        if self.shapes == 0:
            raise ValueError("Capacity has neither polygons nor circles; give at least one shape")
        if self.shapes > MAX_SHAPES:
            raise ValueError(
                f"Capacity has {self.polygons} polygons and {self.circles} circles; a world holds at most {MAX_SHAPES} "
                "shapes: split it into several worlds"
            )
        if not 3 <= self.vertices <= 8:
            raise ValueError(f"Capacity.vertices is {self.vertices}; polygons have 3 to 8 vertices")

    @property
    def shapes(self) -> int:
        return self.polygons + self.circles

    @property
    def touch_words(self) -> int:
        """Number of 32-bit words that hold one bit per shape."""
        return (self.shapes + 31) // 32

    @property
    def contact_slots(self) -> int:
        """Contacts that an engine keeps for a world: two points a polygon pair, one for any other pair, at most six a
        shape (touching convex shapes that do not overlap have at most three neighbours each on average)."""
        every_pair = (
            self.polygons * (self.polygons - 1) + self.polygons * self.circles + self.circles * (self.circles - 1) // 2
        )
        return max(1, min(every_pair, 6 * self.shapes))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """What exists. `n` shapes, `P` polygons, `V` vertices, `C` circles, `J` joints, `T` thrusters."""

    # Shapes
    shape_active: Array  # [n] bool, padded slots are False
    inverse_mass: Array  # [n] 1/kg, 0 for fixed shapes
    inverse_inertia: Array  # [n] 1/(kg m^2), 0 for fixed shapes
    density: Array  # [n] kg/m^2 (area density); not used by a step, kept for observations and editing
    friction: Array  # [n] coefficient
    restitution: Array  # [n] 0..1
    vertices: Array  # [P, V, 2] m, body frame, counter-clockwise; unused slots repeat the last vertex
    num_vertices: Array  # [P] int32
    radius: Array  # [C] m
    can_touch: Array  # [n, n] bool, symmetric, False on the diagonal; collision modes and joints applied
    # Joints: body b is held to body a
    joint_active: Array  # [J] bool; a joint of a shape that is not active does nothing
    joint_a: Array  # [J] int32 shape index
    joint_b: Array  # [J] int32 shape index
    joint_anchor_a: Array  # [J, 2] m, frame of a
    joint_anchor_b: Array  # [J, 2] m, frame of b
    joint_is_fixed: Array  # [J] bool, True: also holds the relative angle (a weld)
    joint_rest_angle: Array  # [J] rad, angle_b - angle_a at which a fixed joint rests, zero of limits
    motor_on: Array  # [J] bool
    motor_speed: Array  # [J] target of (angular_velocity_b - angular_velocity_a), in units of settings.base_motor_speed
    motor_power: Array  # [J] in units of settings.base_motor_power
    has_limits: Array  # [J] bool
    lower_limit: Array  # [J] rad, of angle_b - angle_a - rest_angle
    upper_limit: Array  # [J] rad
    # Thrusters
    thruster_active: Array  # [T] bool; one on a shape that is not active does nothing
    thruster_body: Array  # [T] int32 shape index
    thruster_position: Array  # [T, 2] m, body frame
    thruster_angle: Array  # [T] rad, body frame, direction in which the body is pushed
    thruster_power: Array  # [T] in units of settings.base_thruster_power
    # World
    gravity: Array  # [2] m/s^2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class State:
    """How it moves. `K` is the number of contact slots an engine keeps for warm starting."""

    position: Array  # [n, 2] m, world frame, centre of mass
    angle: Array  # [n] rad, not wrapped
    velocity: Array  # [n, 2] m/s
    angular_velocity: Array  # [n] rad/s
    joint_impulse: Array  # [J, 5] N s and N m s: point x, point y, angle or motor, lower limit, upper limit
    contact_key: Array  # [K] int32, which pair and feature a slot belongs to; -1 for an unused slot
    contact_impulse: Array  # [K, 2] N s: normal, tangent


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Controls:
    """What an agent does in one step."""

    motor: Array  # [J] -1..1, share of the motor's target speed (0: motor exerts nothing)
    thruster: Array  # [T] 0..1, share of the thruster's power


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Touching:
    """Who touches whom, as bits: bit `j % 32` of word `j // 32` in row `i` says that i touches j."""

    at_end: Array  # [n, words] uint32, after the last physics step of the call
    during: Array  # [n, words] uint32, in any physics step of the call
    overflow: Array  # [] int32, contacts that found no slot in this call (0 unless capacity is exceeded)
    limited: Array  # [] int32, times a speed limit of the settings acted in this call
    invalid_controls: Array  # [] int32, controls of this call that were out of range (clamped) or NaN (taken as 0)
    invalid_scene: Array  # [] int32, joints and thrusters on no shape (off) and wrong num_vertices (clamped)
    missing: Array  # [] int32, bits of `effects.EFFECTS` that the scene calls for and the engine was compiled without


class Noted(NamedTuple):
    """What a backend notes of a call; fields as in `Touching`."""

    at_end: Array
    during: Array
    overflow: Array
    limited: Array


def touch_matrix(bits: Array, num_shapes: int) -> Array:
    """Expands `[..., n, words]` uint32 touch bits to a `[..., n, n]` bool matrix."""
    columns = np.arange(num_shapes)
    words = jnp.asarray(bits)[..., :, columns // 32]
    return ((words >> (columns % 32).astype(np.uint32)) & 1).astype(bool)


def touch_bits(matrix: Array) -> jax.Array:
    """Packs `[..., n, n]` bool into `[..., n, words]` uint32; the inverse of `touch_matrix`."""
    num_shapes = matrix.shape[-1]
    words = (num_shapes + 31) // 32
    padded = jnp.zeros((*matrix.shape[:-1], words * 32), bool).at[..., :num_shapes].set(matrix)
    weights = np.uint32(1) << np.arange(32, dtype=np.uint32)
    return (padded.reshape(*matrix.shape[:-1], words, 32).astype(jnp.uint32) * weights).sum(-1, dtype=jnp.uint32)


def only_what_acts(scene: Scene) -> Scene:
    """The scene as solvers need it, [..., n] on every field: shapes that are not active have no mass, joints and
    thrusters that are not on active shapes are off, and `can_touch` holds each pair once, at [lower, higher], and only
    where both are active and one of the two can move. No index is out of range."""
    active = jnp.asarray(scene.shape_active)
    inverse_mass = jnp.where(active, scene.inverse_mass, 0)
    inverse_inertia = jnp.where(active, scene.inverse_inertia, 0)
    movable = (inverse_mass > 0) | (inverse_inertia > 0)
    meets = jnp.asarray(scene.can_touch) & active[..., :, None] & active[..., None, :]
    meets &= movable[..., :, None] | movable[..., None, :]
    meets &= np.triu(np.ones(meets.shape[-2:], bool), 1)
    joints, thrusters = _names_shapes(scene)
    on_active = [_of_shape(active, index) for index in (scene.joint_a, scene.joint_b, scene.thruster_body)]
    return dataclasses.replace(
        scene,
        inverse_mass=inverse_mass,
        inverse_inertia=inverse_inertia,
        num_vertices=jnp.clip(jnp.asarray(scene.num_vertices), 3, scene.vertices.shape[-2]),
        can_touch=meets,
        joint_active=scene.joint_active & joints & on_active[0] & on_active[1],
        thruster_active=scene.thruster_active & thrusters & on_active[2],
    )


def num_invalid(scene: Scene) -> jax.Array:
    """[...] int32, what `only_what_acts` must mend: active joints and thrusters whose indices name no (two) shapes, and
    active polygons whose number of vertices is none."""
    joints, thrusters = _names_shapes(scene)
    number = jnp.asarray(scene.num_vertices)
    polygons = (number >= 3) & (number <= scene.vertices.shape[-2])
    active_polygons = scene.shape_active[..., : number.shape[-1]]
    wrong = [scene.joint_active & ~joints, scene.thruster_active & ~thrusters, active_polygons & ~polygons]
    return jnp.sum(jnp.concatenate(wrong, axis=-1), axis=-1, dtype=jnp.int32)


def _names_shapes(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """(joints [..., J], thrusters [..., T]) bool, those whose indices are of shapes, two different ones for a joint."""
    num_shapes = scene.shape_active.shape[-1]
    a, b, body = (jnp.asarray(x) for x in (scene.joint_a, scene.joint_b, scene.thruster_body))
    is_a, is_b, is_body = ((x >= 0) & (x < num_shapes) for x in (a, b, body))
    return is_a & is_b & (a != b), is_body


def _of_shape(x: jax.Array, shape: Array) -> jax.Array:
    """[..., k] of x [..., n] at shape [..., k]; of the nearest one where that is no index."""
    return jnp.take_along_axis(x, jnp.clip(jnp.asarray(shape), 0, x.shape[-1] - 1), axis=-1)


def index_worlds(tree: Any, index: Any) -> Any:
    """Selects worlds from a batch (`[num_worlds, ...]` on every field) by an index, slice or index array."""
    return jax.tree.map(lambda x: x[index], tree)


def stack_worlds(worlds: list[Any]) -> Any:
    """Stacks single worlds of one capacity into a batch with a leading world axis."""
    return jax.tree.map(lambda *xs: np.stack([np.asarray(x) for x in xs]), *worlds)
