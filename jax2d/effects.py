"""Effects that scenes call for, and engines compiled for those alone.

    effects = effects_of(scenes)                   # which effects, and how many slots of each kind, these scenes use
    engine = Engine(capacity, effects=effects)     # the code and the local memory of everything else are left out

Within its effects such an engine gives bitwise the results of the full one, and its tables are laid out the same:
states and packed scenes pass between the two. A scene that calls for more is refused with an error that names the
effect; inside jit, where nothing can be refused, `Touching.missing` names it, world by world.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, JointDrive, JointKind, Scene, Shapes, capacity_of, only_what_acts

# Bit i of `Touching.missing` is EFFECTS[i], bit len(EFFECTS) + j is a slot of SLOTS[j] beyond those compiled for.
EFFECTS = (
    "polygon_pairs",
    "polygon_circle_pairs",
    "circle_pairs",
    "friction",
    "restitution",
    "continuous_collision",
    "revolute_joints",
    "fixed_joints",
    "prismatic_joints",
    "joint_limits",
    "motors",
    "brakes_and_servos",
    "springs",
    "thrusters",
    "gravity",
    "kinematic_bodies",
    "surface_speed",
    "damping",
    "rolling_resistance",
    "external_forces",
)
EXTENDED = EFFECTS[-4:]  # effects of a capacity with extended shapes alone
# The appendix of the paper has none of these, nor has the solver of preset `paper`.
NOT_IN_PAPER = ("prismatic_joints", "brakes_and_servos", "springs", "kinematic_bodies", *EXTENDED)
SLOTS = ("polygon_slots", "circle_slots", "joint_slots", "thruster_slots", "contact_slots")


class MissingEffectError(ValueError):
    """A scene calls for an effect that the engine was compiled without."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effects:
    """Effects and slots that an engine is compiled for. Hashable."""

    polygon_pairs: bool = False  # two polygons may touch
    polygon_circle_pairs: bool = False
    circle_pairs: bool = False
    friction: bool = False  # between shapes that may touch
    restitution: bool = False  # of both of two shapes that may touch
    continuous_collision: bool = False  # bodies that could step over what is in their way: wherever shapes may touch
    revolute_joints: bool = False
    fixed_joints: bool = False
    prismatic_joints: bool = False
    joint_limits: bool = False  # of joints that are not fixed
    motors: bool = False  # of joints that are not fixed
    brakes_and_servos: bool = False  # motors that hold still or move to a position
    springs: bool = False  # and dampers, ropes, rods
    thrusters: bool = False
    gravity: bool = False  # that acts on a mass
    kinematic_bodies: bool = False
    surface_speed: bool = False  # of shapes that may touch
    damping: bool = False  # of what can be pushed
    rolling_resistance: bool = False  # where a circle may touch
    external_forces: bool = False  # of controls: wherever a shape that has them can be pushed
    # Number of slots, from the first, in which anything is active
    polygon_slots: int = 0
    circle_slots: int = 0
    joint_slots: int = 0
    thruster_slots: int = 0
    contact_slots: int = 0  # contacts that there can be at a time

    @classmethod
    def full(cls, capacity: Capacity) -> Effects:
        """All effects that a scene of this capacity can call for."""
        absent = {*(() if capacity.extended_shapes else EXTENDED), *(() if capacity.springs else ("springs",))}
        return cls(
            **{name: name not in absent for name in EFFECTS},
            polygon_slots=capacity.polygons,
            circle_slots=capacity.circles,
            joint_slots=capacity.joints,
            thruster_slots=capacity.thrusters,
            contact_slots=capacity.contact_slots,
        )

    def known_to(self, solver: str) -> Effects:
        """Returns these effects as far as a solver has them."""
        return self if solver == "soft_step" else self.without(*NOT_IN_PAPER)

    def missing(self, other: Effects) -> tuple[str, ...]:
        """Names of what `other` calls for and this has not, in the order of EFFECTS and SLOTS."""
        return tuple(name for name in EFFECTS + SLOTS if getattr(other, name) > getattr(self, name))

    def covers(self, other: Effects) -> bool:
        return not self.missing(other)

    def __or__(self, other: Effects) -> Effects:
        """Returns the effects of both."""
        return Effects(**{name: max(getattr(self, name), getattr(other, name)) for name in EFFECTS + SLOTS})

    def without(self, *names: str) -> Effects:
        """Returns these effects less some, to see what they cost or do."""
        for name in names:
            if name not in EFFECTS:
                raise ValueError(f"unknown effect {name!r}; effects are {', '.join(EFFECTS)}")
        return dataclasses.replace(self, **dict.fromkeys(names, False))

    def missing_worlds(self, table: EffectTable) -> jax.Array:
        """[...] int32 of every world of a table: 0, or the bits of what it calls for and this has not."""
        flags = np.array([getattr(self, name) for name in EFFECTS])
        slots = np.array([getattr(self, name) for name in SLOTS], np.int32)
        lacks = jnp.concatenate([table.flags & ~flags, table.slots > slots], axis=-1)
        bits = np.int32(1) << np.arange(len(EFFECTS + SLOTS), dtype=np.int32)
        return jnp.sum(lacks * bits, axis=-1, dtype=jnp.int32)

    def covers_worlds(self, table: EffectTable) -> jax.Array:
        """[...] bool, worlds of a table that these effects suffice for."""
        return self.missing_worlds(table) == 0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class EffectTable:
    """Effects of each of a batch of scenes."""

    flags: Array  # [..., len(EFFECTS)] bool
    slots: Array  # [..., len(SLOTS)] int32

    def union(self) -> Effects:
        """Effects that any world of the table calls for (concrete arrays only)."""
        flags = np.any(np.asarray(self.flags).reshape(-1, len(EFFECTS)), axis=0).tolist()
        slots = np.asarray(self.slots).reshape(-1, len(SLOTS)).max(axis=0, initial=0).tolist()
        return Effects(**dict(zip(EFFECTS, flags)), **dict(zip(SLOTS, slots)))


def effects_of(scenes: Scene) -> Effects:
    """Effects that a scene or a batch of scenes calls for. Works on concrete arrays; `called_for` also works inside
    jit."""
    return called_for(scenes).union()


@jax.jit  # one program, not one for each operation, outside of jit too
def called_for(scenes: Scene) -> EffectTable:
    """Effects that each scene calls for; batched as the scenes are. May name too many (friction of a shape that is
    never touched), never too few."""
    scenes = only_what_acts(scenes)
    capacity = capacity_of(scenes)
    polygons = capacity.polygons
    meets = scenes.shapes.can_touch  # each pair once
    between = {
        "polygon_pairs": meets[..., :polygons, :polygons],
        "polygon_circle_pairs": meets[..., :polygons, polygons:],
        "circle_pairs": meets[..., polygons:, polygons:],
    }
    active_joints = jnp.asarray(scenes.joints.active)
    has_kind = {kind: active_joints & scenes.joints.is_kind(kind) for kind in JointKind}
    is_driven = active_joints & ~has_kind[JointKind.FIXED]
    flags: dict[str, Array] = {name: pairs.any((-2, -1)) for name, pairs in between.items()}
    flags["friction"] = (meets & _of_pair(jnp.logical_or, scenes.shapes.friction)).any((-2, -1))
    flags["restitution"] = (meets & _of_pair(jnp.logical_and, scenes.shapes.restitution)).any((-2, -1))
    flags["continuous_collision"] = meets.any((-2, -1))
    flags |= {f"{kind.name.lower()}_joints": joints.any(-1) for kind, joints in has_kind.items()}
    flags["joint_limits"] = (is_driven & scenes.joints.has_limits).any(-1)
    has_motor = is_driven & scenes.joints.motor_on
    flags["motors"] = has_motor.any(-1)
    flags["brakes_and_servos"] = (has_motor & ~scenes.joints.is_drive(JointDrive.VELOCITY)).any(-1)
    flags["springs"] = jnp.asarray(scenes.springs.active).any(-1)
    flags["thrusters"] = jnp.asarray(scenes.thrusters.active).any(-1)
    has_gravity = (jnp.asarray(scenes.gravity) != 0).any(-1)
    flags["gravity"] = has_gravity & (scenes.shapes.inverse_mass > 0).any(-1)
    flags["kinematic_bodies"] = scenes.shapes.kinematic.any(-1)
    flags |= _called_for_by_extended_shapes(scenes.shapes, meets, polygons)

    points = {name: pairs.sum((-2, -1), dtype=jnp.int32) for name, pairs in between.items()}
    contacts = 2 * points["polygon_pairs"] + points["polygon_circle_pairs"] + points["circle_pairs"]
    slots = {
        "polygon_slots": _slots_in_use(scenes.shapes.active[..., :polygons]),
        "circle_slots": _slots_in_use(scenes.shapes.active[..., polygons:]),
        "joint_slots": _slots_in_use(scenes.joints.active),
        "thruster_slots": _slots_in_use(scenes.thrusters.active),
        "contact_slots": jnp.minimum(contacts, capacity.contact_slots),
    }
    return EffectTable(
        flags=jnp.stack([flags[name] for name in EFFECTS], axis=-1),
        slots=jnp.stack([slots[name] for name in SLOTS], axis=-1),
    )


def _called_for_by_extended_shapes(shapes: Shapes, meets: jax.Array, polygons: int) -> dict[str, jax.Array]:
    """Flags of EXTENDED. `meets` [..., n, n]: who may touch whom."""
    if shapes.surface_speed.shape[-1] == 0:
        return dict.fromkeys(EXTENDED, jnp.zeros(meets.shape[:-2], bool))
    has_circle = meets & (np.arange(meets.shape[-1]) >= polygons)  # pairs stand at [lower, higher]
    can_move, can_turn = jnp.asarray(shapes.inverse_mass) > 0, jnp.asarray(shapes.inverse_inertia) > 0
    damped = (can_move & (shapes.linear_damping > 0)) | (can_turn & (shapes.angular_damping > 0))
    return {
        "surface_speed": (meets & _of_pair(jnp.logical_or, jnp.abs(shapes.surface_speed))).any((-2, -1)),
        "damping": damped.any(-1),
        "rolling_resistance": (has_circle & _of_pair(jnp.logical_or, shapes.rolling_resistance)).any((-2, -1)),
        "external_forces": (can_move | can_turn).any(-1),
    }


def _of_pair(combine: Callable[[jax.Array, jax.Array], jax.Array], coefficient: Array) -> jax.Array:
    """[..., n, n] bool, of shapes with a coefficient above zero."""
    positive = jnp.asarray(coefficient) > 0
    return combine(positive[..., :, None], positive[..., None, :])


def _slots_in_use(active: Array) -> jax.Array:
    """[...] int32, one past the last active slot."""
    active = jnp.asarray(active)
    numbers = np.arange(1, active.shape[-1] + 1, dtype=np.int32)
    return jnp.max(jnp.where(active, numbers, 0), axis=-1, initial=0)


def names_of_bits(bits: int) -> Iterator[str]:
    """The effects and slots that a value of `Touching.missing` stands for."""
    return (name for i, name in enumerate(EFFECTS + SLOTS) if bits >> i & 1)


def check_effects(effects: Effects, capacity: Capacity) -> None:
    """Raises ValueError for effects that hold more than the capacity, or slots below zero."""
    full = Effects.full(capacity)
    for name in SLOTS:
        if not 0 <= getattr(effects, name) <= getattr(full, name):
            raise ValueError(
                f"Effects.{name} is {getattr(effects, name)}, but {capacity} has {getattr(full, name)}; "
                "take the effects of scenes of this capacity"
            )
    if effects.polygon_slots + effects.circle_slots == 0:
        raise ValueError("Effects have no slot for any shape; an engine needs at least one")
