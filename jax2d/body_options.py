"""Options of shapes in the scene builder, and the fields of `Shapes` that they become."""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any, NamedTuple

from jax2d.given import LARGEST, Point, SceneError, finite, flag, in_units, not_negative, number, positive
from jax2d.scene import Capacity
from jax2d.settings import Settings
from jax2d.whole_numbers import whole_number

FILTER_BITS = 16  # of categories and masks
PLACE_AND_MOTION = ("position", "angle", "velocity", "angular_velocity", "fixed", "kinematic")  # options


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyOptions:
    """Options of add_polygon, add_box and add_circle."""

    position: Point = (0.0, 0.0)  # m, world frame, of the origin that the shape is given in
    angle: float = 0.0  # rad
    velocity: Point = (0.0, 0.0)  # m/s, of the centre of mass
    angular_velocity: float = 0.0  # rad/s
    density: float = 1.0  # kg/m^2
    fixed: bool = False  # it has no mass and never moves
    kinematic: bool = False  # it has no mass and moves as its velocity says; nothing pushes it
    friction: float | None = None  # share of settings.base_friction, 1 unless given
    friction_coefficient: float | None = None  # in its place: two shapes of mu have mu, with the presets' settings
    restitution: float = 0.0  # 0 to 1, the lower of two counts
    # Of a capacity with extended shapes
    surface_speed: float = 0.0  # m/s, of a belt around it, clockwise: the top of a floor goes towards +x
    linear_damping: float = 0.0  # 1/s, at which velocity decays
    angular_damping: float = 0.0  # 1/s, at which angular velocity decays
    rolling_resistance: float = 0.0  # torque against rolling, share of normal force x radius; the larger of two counts
    category: int = 1  # bits of what it is, 0 to 65535
    mask: int = (
        2**FILTER_BITS - 1
    )  # bits of what it may touch: two touch where each one's mask has the other's category

    @classmethod
    def of(cls, **options: Any) -> BodyOptions:
        """Raises SceneError for an option that there is none of."""
        known = [field.name for field in dataclasses.fields(cls)]
        if unknown := [name for name in options if name not in known]:
            near = difflib.get_close_matches(unknown[0], known, 1)
            meant = f"did you mean {near[0]}?" if near else f"options are {', '.join(known)}"
            raise SceneError(f"a shape has no option {unknown[0]}; {meant}")
        return cls(**options)


class Filter(NamedTuple):
    """Filter of collisions by category and mask (Box2D's b2Filter without groups)."""

    category: int
    mask: int

    def lets_touch(self, other: Filter) -> bool:
        return bool(self.category & other.mask) and bool(other.category & self.mask)


class Body(NamedTuple):
    """The options of a shape, checked."""

    shape: dict[str, float]  # fields of `Shapes`
    position: list[float]
    angle: float
    velocity: list[float]
    angular_velocity: float
    filter: Filter


def body_of(area: float, second_moment: float, options: BodyOptions, capacity: Capacity, settings: Settings) -> Body:
    """`second_moment`: of area about the centre of mass, m^4. Raises SceneError."""
    o = options
    if all([flag("fixed", o.fixed), flag("kinematic", o.kinematic)]):
        raise SceneError("a shape is fixed or kinematic, not both: drop fixed=True if it moves")
    density, restitution = positive("density", o.density), number("restitution", o.restitution)
    if not 0 <= restitution <= 1:
        raise SceneError(f"restitution is {restitution:g}; it must be from 0 to 1")
    velocity, spin = finite("velocity", o.velocity, 2), number("angular_velocity", o.angular_velocity)
    if o.fixed and (any(velocity) or spin):
        raise SceneError("a fixed shape cannot move: drop its velocity, or say kinematic=True in place of fixed=True")
    mass, inertia = density * area, density * second_moment
    has_mass = not (o.fixed or o.kinematic)
    if has_mass and not all(1 / LARGEST <= x <= LARGEST for x in (mass, inertia)):
        raise SceneError(
            f"the shape has a mass of {mass:g} kg and an inertia of {inertia:g} kg m^2; both must be from "
            f"{1 / LARGEST:g} to {LARGEST:g}: change its size or density"
        )
    shape = {
        "inverse_mass": 1.0 / mass if has_mass else 0.0,
        "inverse_inertia": 1.0 / inertia if has_mass else 0.0,
        "kinematic": o.kinematic,
        "density": density,
        "friction": _friction(o, settings),
        "restitution": restitution,
        **_extended(o, capacity, has_mass=has_mass),
    }
    allowed = Filter(_bits("category", o.category), _bits("mask", o.mask))
    return Body(shape, finite("position", o.position, 2), number("angle", o.angle), velocity, spin, allowed)


def _extended(o: BodyOptions, capacity: Capacity, *, has_mass: bool) -> dict[str, float]:
    """Fields of dimension E, where the capacity has room for them."""
    values = {"surface_speed": number("surface_speed", o.surface_speed)}
    for name in ("linear_damping", "angular_damping", "rolling_resistance"):
        values[name] = not_negative(name, getattr(o, name))
    given = [name for name, value in values.items() if value]
    if given and not capacity.extended_shapes:
        raise SceneError(
            f"{given[0]} is {values[given[0]]:g}, but this capacity has no room for it; build with "
            "Capacity(extended_shapes=True)"
        )
    if not has_mass and (damped := [name for name in given if name.endswith("damping")]):
        raise SceneError(f"{damped[0]} of a shape that is fixed or kinematic would slow nothing; leave it out")
    return values if capacity.extended_shapes else {}


def _friction(o: BodyOptions, settings: Settings) -> float:
    """Returns friction in units of settings.base_friction, which two equal shapes have in every way of mixing."""
    if o.friction_coefficient is None:
        return not_negative("friction", 1.0 if o.friction is None else o.friction)
    if o.friction is not None:
        raise SceneError(
            f"friction {o.friction!r} and friction_coefficient {o.friction_coefficient!r} are the same in two units; "
            "give one of them"
        )
    name = "friction_coefficient"
    return in_units(name, not_negative(name, o.friction_coefficient), settings, "base_friction")


def _bits(name: str, value: int) -> int:
    try:
        bits = whole_number(name, value)
    except ValueError as error:
        raise SceneError(str(error)) from None
    if not 0 <= bits < 2**FILTER_BITS:
        raise SceneError(f"{name} is {bits}; it has {FILTER_BITS} bits: give 0 to {2**FILTER_BITS - 1}")
    return bits
