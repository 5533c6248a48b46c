"""Records of a world: Capacity, Scene (what exists), State (how it moves), Controls, Touching.

Scene and State are apart on purpose. A `Scene` holds what cannot change during a step (shapes, masses, joints,
thrusters, who may touch whom) and is replaced only at a reset. A `State` holds what a step changes.

Shapes are indexed polygons first, then circles: shape `i < capacity.polygons` is polygon `i`, shape
`capacity.polygons + j` is circle `j`. Every field below is declared for one world (`fields.py` says how); a batch of
worlds has one leading axis more, `[num_worlds, ...]`, on every field. Units: m, kg, s, rad. Vertices run
counter-clockwise about the centre of mass, which is the origin of the body frame.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import fields
from jax2d.constants import CONSTANTS
from jax2d.contact_report import ContactReport
from jax2d.fields import Array, array, part
from jax2d.whole_numbers import whole_number

MAX_SHAPES = 512  # an int32 contact key has 9 bits for each of two shapes, and 12 for the feature
SHAPE_INDEX_BITS = 10  # of a shape's number in a packed word
MAX_FORCE = 1e9  # N and N m of a control: more is a mistake, and squares of what it does must fit float32
JOINT_IMPULSES = 5  # numbers that warm starting keeps of a joint
NO_MAXIMUM_M = CONSTANTS.no_maximum
EMPTY_POLYGON_M = ((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1))  # corners of unused slots: never degenerate, never seen


class JointKind(enum.IntEnum):
    """Freedom that a joint leaves."""

    REVOLUTE = 0  # turning about the common point; may have a motor and limits
    FIXED = 1  # nothing: a weld
    PRISMATIC = 2  # sliding along an axis of a; may have a motor and limits


class JointDrive(enum.IntEnum):
    """Meaning of a motor's control, -1 to 1."""

    VELOCITY = 0  # a share of its speed; 0: it exerts nothing
    BRAKE = 1  # a share of its speed; 0: it holds still with its whole strength
    SERVO = 2  # a position, from the lower limit at -1 to the upper one at 1, approached at its speed at most


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capacity:
    """Numbers of slots of a world. Compile-time: engines are built for one capacity."""

    polygons: int
    circles: int
    joints: int
    thrusters: int
    vertices: int = 4  # a polygon has at most
    springs: int = 0  # springs, dampers, ropes and rods
    extended_shapes: bool = False  # shapes have surface speed, damping and rolling resistance, controls have forces

    def __post_init__(self) -> None:
        for name in ("polygons", "circles", "joints", "thrusters", "vertices", "springs"):
            if whole_number(f"Capacity.{name}", getattr(self, name)) < 0:
                raise ValueError(f"Capacity.{name} is {getattr(self, name)}; it must be 0 or more")
        if self.shapes == 0:
            raise ValueError("Capacity has neither polygons nor circles; give at least one shape")
        if self.shapes > MAX_SHAPES:
            raise ValueError(
                f"Capacity has {self.polygons} polygons and {self.circles} circles; a world holds at most {MAX_SHAPES} "
                "shapes: split it into several worlds"
            )
        if not isinstance(self.extended_shapes, bool):
            raise ValueError(f"Capacity.extended_shapes is {self.extended_shapes!r}; it must be True or False")
        if not 3 <= self.vertices <= 8:
            raise ValueError(f"Capacity.vertices is {self.vertices}; polygons have 3 to 8 vertices")

    @property
    def shapes(self) -> int:
        return self.polygons + self.circles

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the dimensions that fields are declared with."""
        letters = {"n": self.shapes, "P": self.polygons, "V": self.vertices, "C": self.circles, "J": self.joints}
        letters |= {"T": self.thrusters, "S": self.springs, "K": self.contact_slots}
        letters |= {"E": self.shapes * self.extended_shapes, "R": self.contact_slots * self.extended_shapes}
        return letters | {str(number): number for number in range(1, 10)}

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
class Shapes:
    """`n` shapes, polygons first: `P` polygons of at most `V` vertices and `C` circles."""

    active: Array = array("n", bool, "padded slots are False", empty=False)
    inverse_mass: Array = array("n", float, "0: nothing pushes it", unit="1/kg", at_least=0)
    inverse_inertia: Array = array("n", float, "0: nothing turns it", unit="1/(kg m^2)", at_least=0)
    density: Array = array("n", float, "for observations and editing", unit="kg/m^2", empty=1, stepped=False)
    kinematic: Array = array(
        "n", bool, "moves as its velocity says, and nothing pushes it: it has no mass", empty=False
    )
    friction: Array = array("n", float, "coefficient", empty=1, at_least=0)
    restitution: Array = array("n", float, "share of the speed that a bounce leaves", at_least=0, at_most=1)
    vertices: Array = array(
        "P V 2",
        float,
        "body frame, counter-clockwise; unused slots repeat the last vertex",
        unit="m",
        empty=EMPTY_POLYGON_M,
    )
    num_vertices: Array = array("P", int, "of each polygon", empty=len(EMPTY_POLYGON_M))
    radius: Array = array("C", float, "of each circle", unit="m", empty=0.1, above=0)
    can_touch: Array = array("n n", bool, "symmetric, False on the diagonal; collision modes and joints applied")
    # Of a capacity with extended shapes
    surface_speed: Array = array(
        "E", float, "of a belt around it, clockwise: the top of a floor goes towards +x", unit="m/s"
    )
    linear_damping: Array = array("E", float, "velocity decays at this rate", unit="1/s", at_least=0)
    angular_damping: Array = array("E", float, "angular velocity decays at this rate", unit="1/s", at_least=0)
    rolling_resistance: Array = array(
        "E", float, "torque against rolling, share of normal force x radius; the larger of two counts", at_least=0
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Joints:
    """`J` joints: body b is held to body a. A joint of a shape that is not active does nothing.

    What limits bound and a motor drives forward at positive speed: of a revolute joint angle_b - angle_a - rest_angle
    (rad), of a prismatic one how far the anchor of b lies along the axis from that of a (m).
    """

    active: Array = array("J", bool, "padded slots are False", empty=False, bits=1)
    kind: Array = array("J", int, "JointKind", bits=2, at_least=0, at_most=max(JointKind))
    a: Array = array("J", int, "shape index", refers_to="n", bits=SHAPE_INDEX_BITS)
    b: Array = array("J", int, "shape index", refers_to="n", bits=SHAPE_INDEX_BITS)
    anchor_a: Array = array("J 2", float, "frame of a", unit="m")
    anchor_b: Array = array("J 2", float, "frame of b", unit="m")
    rest_angle: Array = array(
        "J", float, "angle_b - angle_a that a weld or a slider holds; zero of a revolute joint's limits", unit="rad"
    )
    axis_angle: Array = array("J", float, "frame of a: along which b slides, of prismatic joints", unit="rad")
    motor_on: Array = array("J", bool, "it has a motor", empty=False, bits=1)
    drive: Array = array("J", int, "JointDrive of the motor", bits=2, at_least=0, at_most=max(JointDrive))
    motor_speed: Array = array(
        "J",
        float,
        "at control 1; a servo's largest, which turns its direction round if negative",
        unit="settings.base_motor_speed or base_slider_speed",
        empty=1,
    )
    motor_power: Array = array(
        "J",
        float,
        "strength",
        unit="settings.base_motor_power or base_slider_power",
        empty=1,
        at_least=0,
        only_where="motor_on",
    )
    has_limits: Array = array("J", bool, "it has limits", empty=False, bits=1)
    lower_limit: Array = array("J", float, "at most upper_limit", unit="rad or m")
    upper_limit: Array = array("J", float, "at least lower_limit", unit="rad or m")

    def is_kind(self, kind: JointKind) -> Array:
        """[..., J] bool, joints of this kind, active or not."""
        return self.kind == kind

    def is_drive(self, drive: JointDrive) -> Array:
        """[..., J] bool, joints whose motor, if they have one, is driven this way."""
        return self.drive == drive


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Thrusters:
    """`T` thrusters. One on a shape that is not active does nothing."""

    active: Array = array("T", bool, "padded slots are False", empty=False, bits=1)
    body: Array = array("T", int, "shape index", refers_to="n", bits=SHAPE_INDEX_BITS)
    position: Array = array("T 2", float, "body frame", unit="m")
    angle: Array = array("T", float, "body frame, direction in which the body is pushed", unit="rad")
    power: Array = array("T", float, "force", unit="settings.base_thruster_power", empty=1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Springs:
    """`S` elements between an anchor on a and one on b, along the line between the two: spring and damper, a rope (a
    maximum alone), a rod (minimum = maximum). One of a shape that is not active does nothing."""

    active: Array = array("S", bool, "padded slots are False", empty=False, bits=1)
    a: Array = array("S", int, "shape index", refers_to="n", bits=SHAPE_INDEX_BITS)
    b: Array = array("S", int, "shape index", refers_to="n", bits=SHAPE_INDEX_BITS)
    anchor_a: Array = array("S 2", float, "frame of a", unit="m")
    anchor_b: Array = array("S 2", float, "frame of b", unit="m")
    rest_length: Array = array("S", float, "at which the spring exerts nothing", unit="m", at_least=0)
    stiffness: Array = array("S", float, "force over length", unit="N/m", at_least=0)
    damping: Array = array("S", float, "force over speed", unit="N s/m", at_least=0)
    min_length: Array = array("S", float, "at most max_length; 0: none", unit="m", at_least=0)
    max_length: Array = array("S", float, "NO_MAXIMUM_M: none", unit="m", empty=NO_MAXIMUM_M, above=0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything in a world that a step does not change."""

    shapes: Shapes = part(Shapes)
    joints: Joints = part(Joints)
    thrusters: Thrusters = part(Thrusters)
    springs: Springs = part(Springs)
    gravity: Array = array("2", float, "acceleration", unit="m/s^2", empty=0)

    def replace(self, **changes: Any) -> Scene:
        """A scene in which some fields are others: scene.replace(joints={"active": x}, gravity=g)."""
        return fields.replace(self, **changes)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class State:
    """Everything in a world that a step changes. `K` is the number of contact slots for warm starting."""

    position: Array = array("n 2", float, "world frame, centre of mass", unit="m")
    angle: Array = array(
        "n", float, "-pi to pi after a step; of joints with limits of over 3/4 of a turn turns are counted", unit="rad"
    )
    velocity: Array = array("n 2", float, "of the centre of mass", unit="m/s")
    angular_velocity: Array = array("n", float, "counter-clockwise", unit="rad/s")
    joint_impulse: Array = array(
        "J 5",
        float,
        "point x, point y (prismatic: across the axis, angle), angle or motor, lower limit, upper limit",
        unit="N s and N m s",
    )
    spring_impulse: Array = array("S 3", float, "spring, minimum, maximum", unit="N s")
    contact_key: Array = array("K", int, "which pair and feature a slot belongs to; -1 for an unused slot", empty=-1)
    contact_impulse: Array = array("K 2", float, "normal, tangent", unit="N s")
    rolling_impulse: Array = array("R", float, "of rolling resistance", unit="N m s")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Controls:
    """Actions of one step."""

    motor: Array = array(
        "J", float, "share of the motor's target speed, or a servo's position: see JointDrive", at_least=-1, at_most=1
    )
    thruster: Array = array("T", float, "share of the thruster's power", at_least=0, at_most=1)
    # Of a capacity with extended shapes, constant over the steps of a call
    force: Array = array(
        "E 2",
        float,
        "on each shape at its centre of mass, world frame",
        unit="N",
        at_least=-MAX_FORCE,
        at_most=MAX_FORCE,
        may_be_none=True,
    )
    torque: Array = array(
        "E",
        float,
        "on each shape, counter-clockwise",
        unit="N m",
        at_least=-MAX_FORCE,
        at_most=MAX_FORCE,
        may_be_none=True,
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Touching:
    """Touching pairs, as bits: bit `j % 32` of word `j // 32` in row `i` says that i touches j."""

    at_end: Array  # [n, words] uint32, after the last physics step of the call
    during: Array  # [n, words] uint32, in any physics step of the call
    overflow: Array  # [] int32, contacts that found no slot in this call (0 unless capacity is exceeded)
    limited: Array  # [] int32, bodies on which a speed limit of the settings acted, each once a step
    open_joints: Array  # [] int32, joints, ropes and rods that do not hold at the end of the call (`measure.num_open`)
    invalid_controls: Array  # [] int32, controls of this call that were out of range (clamped) or NaN (taken as 0)
    invalid_scene: Array  # [] int32, what `num_invalid` counts: it is off, or clamped
    missing: Array  # [] int32, bits of `effects.EFFECTS` that the scene calls for and the engine was compiled without
    contacts: ContactReport | None = None  # of the last physics step; None unless the engine has report_contacts


class BackendReport(NamedTuple):
    """Report of a backend on a call; fields as in `Touching`."""

    at_end: Array
    during: Array
    overflow: Array
    limited: Array
    open_joints: Array
    contacts: ContactReport | None = None


def touch_matrix(bits: Array, num_shapes: int) -> Array:
    """Expands `[..., n, words]` uint32 touch bits to a `[..., n, n]` bool matrix."""
    columns = np.arange(num_shapes)
    words = jnp.asarray(bits)[..., :, columns // 32]
    return ((words >> (columns % 32).astype(np.uint32)) & 1).astype(bool)


def pack_bits(mask: Array) -> jax.Array:
    """[..., n] bool to [..., words] uint32: bit `i % 32` of word `i // 32` is mask i; the inverse of `touch_matrix`."""
    num_shapes = mask.shape[-1]
    words = (num_shapes + 31) // 32
    padded = jnp.zeros((*mask.shape[:-1], words * 32), bool).at[..., :num_shapes].set(mask)
    weights = np.uint32(1) << np.arange(32, dtype=np.uint32)
    return (padded.reshape(*mask.shape[:-1], words, 32).astype(jnp.uint32) * weights).sum(-1, dtype=jnp.uint32)


def capacity_of(scene: Scene) -> Capacity:
    """The capacity that the arrays of a scene (or of a batch) have."""
    return Capacity(
        polygons=scene.shapes.num_vertices.shape[-1],
        circles=scene.shapes.radius.shape[-1],
        joints=scene.joints.active.shape[-1],
        thrusters=scene.thrusters.active.shape[-1],
        vertices=scene.shapes.vertices.shape[-2],
        springs=scene.springs.active.shape[-1],
        extended_shapes=scene.shapes.surface_speed.shape[-1] > 0,
    )


def only_what_acts(scene: Scene) -> Scene:
    """The scene as solvers need it, [..., n] on every field: shapes that are not active have no mass, joints, springs
    and thrusters that are not on active shapes are off, joints of no JointKind too, and `can_touch` holds each pair
    once, at [lower, higher], and only where both are active and one of the two can move. No index is out of range."""
    shapes = scene.shapes
    active = jnp.asarray(shapes.active)
    inverse_mass = jnp.where(active, shapes.inverse_mass, 0)
    inverse_inertia = jnp.where(active, shapes.inverse_inertia, 0)
    movable = (inverse_mass > 0) | (inverse_inertia > 0)
    meets = jnp.asarray(shapes.can_touch) & active[..., :, None] & active[..., None, :]
    meets &= movable[..., :, None] | movable[..., None, :]
    meets &= np.triu(np.ones(meets.shape[-2:], bool), 1)
    body = scene.thrusters.body
    return scene.replace(
        shapes={
            "inverse_mass": inverse_mass,
            "inverse_inertia": inverse_inertia,
            "kinematic": active & shapes.kinematic,
            "num_vertices": jnp.clip(jnp.asarray(shapes.num_vertices), 3, shapes.vertices.shape[-2]),
            "can_touch": meets,
        },
        joints={"active": scene.joints.active & _joins(active, scene.joints) & _has_kind(scene.joints)},
        springs={"active": scene.springs.active & _joins(active, scene.springs)},
        thrusters={"active": scene.thrusters.active & _is_shape(active, body) & _of_shape(active, body)},
    )


@jax.jit  # one program, not one for each operation, outside of jit too
def num_invalid(scene: Scene) -> jax.Array:
    """[...] int32, what `only_what_acts` must mend: active joints, springs and thrusters whose indices name no (two)
    shapes, joints of no JointKind, and active polygons whose number of vertices is none."""
    active = jnp.asarray(scene.shapes.active)
    number = jnp.asarray(scene.shapes.num_vertices)
    polygons = (number >= 3) & (number <= scene.shapes.vertices.shape[-2])
    wrong = [
        scene.joints.active & ~(_are_two(active, scene.joints) & _has_kind(scene.joints)),
        scene.springs.active & ~_are_two(active, scene.springs),
        scene.thrusters.active & ~_is_shape(active, scene.thrusters.body),
        active[..., : number.shape[-1]] & ~polygons,
    ]
    return jnp.sum(jnp.concatenate(wrong, axis=-1), axis=-1, dtype=jnp.int32)


def _joins(active: jax.Array, ends: Joints | Springs) -> jax.Array:
    """[..., k] bool, those between two active shapes."""
    return _are_two(active, ends) & _of_shape(active, ends.a) & _of_shape(active, ends.b)


def _has_kind(joints: Joints) -> jax.Array:
    """[..., J] bool, those of a JointKind."""
    return (jnp.asarray(joints.kind) >= min(JointKind)) & (jnp.asarray(joints.kind) <= max(JointKind))


def _are_two(active: jax.Array, ends: Joints | Springs) -> jax.Array:
    """[..., k] bool, those whose ends are two shapes, active or not."""
    return _is_shape(active, ends.a) & _is_shape(active, ends.b) & (jnp.asarray(ends.a) != jnp.asarray(ends.b))


def _is_shape(active: jax.Array, index: Array) -> jax.Array:
    """[..., k] bool, indices of shapes, active [..., n] or not."""
    return (jnp.asarray(index) >= 0) & (jnp.asarray(index) < active.shape[-1])


def _of_shape(x: jax.Array, shape: Array) -> jax.Array:
    """[..., k] of x [..., n] at shape [..., k]; of the nearest one where that is no index."""
    return jnp.take_along_axis(x, jnp.clip(jnp.asarray(shape), 0, x.shape[-1] - 1), axis=-1)


def index_worlds(tree: Any, index: Any) -> Any:
    """Selects worlds from a batch (`[num_worlds, ...]` on every field) by an index, slice or index array."""
    return jax.tree.map(lambda x: x[index], tree)


def stack_worlds(worlds: list[Any]) -> Any:
    """Stacks single worlds of one capacity into a batch with a leading world axis."""
    if not worlds:
        raise ValueError("stack_worlds has no worlds to stack; give a list of one or more")
    kind, shapes = type(worlds[0]), [np.shape(x) for x in jax.tree.leaves(worlds[0])]
    for k, world in enumerate(worlds):
        if type(world) is not kind:
            raise TypeError(f"world {k} is of type {type(world).__name__}, world 0 {kind.__name__}; give one type")
        if [np.shape(x) for x in jax.tree.leaves(world)] != shapes:
            raise ValueError(f"worlds 0 and {k} are of different capacities; build them with one")
    return jax.tree.map(lambda *xs: np.stack([np.asarray(x) for x in xs]), *worlds)
