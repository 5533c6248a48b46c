"""Options of the scene builder: of shapes, of motors, of springs; and the fields of a Scene that they become.

Each kind of options has two declarations: a TypedDict, whose keywords an editor completes, and a frozen record of the
same names with defaults, which checks them. A motor's numbers come in two units:

    motor_speed, motor_power    of a level: times settings.base_motor_speed and base_motor_power (of sliders
                                base_slider_speed and base_slider_power)
    speed                       rad/s, of sliders m/s
    max_torque, max_force       N m, of sliders N: power x base power x what the motor moves of its two bodies alone

A motor moves kg m^2 with 1/I = 1/I_a + 1/I_b; of a slider kg along its axis, turning of the bodies included.
"""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any, NamedTuple, TypedDict

import numpy as np

from jax2d.builder_checks import (
    LARGEST,
    Point,
    SceneError,
    direction,
    finite,
    flag,
    in_units,
    not_negative,
    number,
    one_of,
    positive,
)
from jax2d.scene import NO_MAXIMUM_M, Capacity, JointDrive, JointKind
from jax2d.settings import Settings
from jax2d.whole_numbers import whole_number

FILTER_BITS = 16  # of categories and masks
DRIVES = {drive.name.lower(): drive for drive in JointDrive}  # names in the scene builder

# Shapes


class MaterialKeywords(TypedDict, total=False):
    """Keywords of a shape that does not move, such as a tile of terrain. Units and defaults: `BodyOptions`."""

    density: float
    friction: float | None
    friction_coefficient: float | None
    restitution: float
    surface_speed: float
    linear_damping: float
    angular_damping: float
    rolling_resistance: float
    category: int
    mask: int


class BodyKeywords(MaterialKeywords, total=False):
    """Keywords of add_polygon, add_box and add_circle. Units and defaults: `BodyOptions`."""

    position: Point
    angle: float
    velocity: Point
    angular_velocity: float
    fixed: bool | np.bool_
    kinematic: bool | np.bool_


POSE_AND_MOTION = tuple(name for name in BodyKeywords.__annotations__ if name not in MaterialKeywords.__annotations__)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BodyOptions:
    """Options of add_polygon, add_box and add_circle."""

    position: Point = (0.0, 0.0)  # m, world frame, of the origin that the shape is given in
    angle: float = 0.0  # rad
    velocity: Point = (0.0, 0.0)  # m/s, of the centre of mass
    angular_velocity: float = 0.0  # rad/s
    density: float = 1.0  # kg/m^2
    fixed: bool | np.bool_ = False  # it has no mass and never moves
    kinematic: bool | np.bool_ = False  # it has no mass and moves as its velocity says; nothing pushes it
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
        "kinematic": bool(o.kinematic),
        "density": density,
        "friction": _friction(o, settings),
        "restitution": restitution,
        **_extended(o, capacity, has_mass=has_mass),
    }
    allowed = Filter(_bits("category", o.category), _bits("mask", o.mask))
    return Body(shape, finite("position", o.position, 2), direction("angle", o.angle), velocity, spin, allowed)


def _extended(o: BodyOptions, capacity: Capacity, *, has_mass: bool) -> dict[str, float]:
    """Fields of dimension E, where the capacity has them."""
    values = {"surface_speed": number("surface_speed", o.surface_speed)}
    for name in ("linear_damping", "angular_damping", "rolling_resistance"):
        values[name] = not_negative(name, getattr(o, name))
    given = [name for name, value in values.items() if value]
    if given and not capacity.extended_shapes:
        raise SceneError(
            f"{given[0]} is {values[given[0]]:g}, but this capacity has no slots for it; build with "
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


# Motors and limits of joints


class JointKeywords(TypedDict, total=False):
    """Keywords of any joint with a motor. Units and defaults: `MotorOptions`."""

    motor_speed: float | None
    motor_power: float | None
    speed: float | None
    drive: str
    limits: tuple[float, float] | None


class RevoluteKeywords(JointKeywords, total=False):
    """Keywords of add_revolute_joint."""

    max_torque: float | None  # N m


class PrismaticKeywords(JointKeywords, total=False):
    """Keywords of add_prismatic_joint."""

    max_force: float | None  # N


class MotorUnits(NamedTuple):
    """Units of the numbers of a motor: names of settings."""

    speed: str  # rad/s or m/s at motor_speed 1
    acceleration: str  # rad/s^2 or m/s^2 that a motor of power 1 gives to its two bodies alone
    strength: str  # option for its largest torque or force


def motor_units(kind: JointKind) -> MotorUnits:
    if kind == JointKind.PRISMATIC:
        return MotorUnits("base_slider_speed", "base_slider_power", "max_force")
    return MotorUnits("base_motor_speed", "base_motor_power", "max_torque")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotorOptions:
    """Options of a motor and limits of any kind of joint."""

    motor_speed: float | None = None  # times the base speed of the settings
    motor_power: float | None = None  # times the base power of the settings, 1 unless given
    speed: float | None = None  # rad/s, of sliders m/s
    drive: str = "velocity"  # of DRIVES
    limits: tuple[float, float] | None = None  # rad, of sliders m

    def fields(self, kind: JointKind, settings: Settings, moved: float) -> dict[str, float]:
        """Fields of `Joints`; raises SceneError for what contradicts itself. `moved`: kg m^2, of a slider kg."""
        return self._motor(motor_units(kind), settings, moved) | self._limits()

    def _motor(self, units: MotorUnits, settings: Settings, moved: float) -> dict[str, float]:
        one_of(("motor_speed", self.motor_speed), ("speed", self.speed))
        strength_name, strength = units.strength, getattr(self, units.strength)
        one_of(("motor_power", self.motor_power), (strength_name, strength))
        if not isinstance(self.drive, str) or self.drive not in DRIVES:
            raise SceneError(f"drive is {self.drive!r}; use {', '.join(map(repr, DRIVES))}")
        if self.motor_speed is None and self.speed is None:
            strengths = {strength_name: strength, "motor_power": self.motor_power}
            given = [name for name, value in strengths.items() if value is not None]
            if given or self.drive != "velocity":
                what = given[0] if given else f"drive {self.drive!r}"
                raise SceneError(f"{what} without a motor; give its speed= (or motor_speed=) too")
            return {}
        if self.drive == "servo" and self.limits is None:
            raise SceneError("a servo without limits has no positions to move between; give limits=(lower, upper)")
        if self.speed is not None:
            speed = in_units("speed", number("speed", self.speed), settings, units.speed)
        else:
            # pyrefly: ignore[bad-argument-type]  # `one_of` above raises if both speeds are None
            speed = number("motor_speed", self.motor_speed)
        if self.drive == "servo" and speed == 0:
            raise SceneError("a servo of speed 0 never moves; give the largest speed at which it goes to its position")
        if strength is not None:
            power = in_units(strength_name, positive(strength_name, strength), settings, units.acceleration) / moved
        else:
            power = positive("motor_power", 1.0 if self.motor_power is None else self.motor_power)
        return {"motor_on": True, "drive": DRIVES[self.drive], "motor_speed": speed, "motor_power": power}

    def _limits(self) -> dict[str, float]:
        if self.limits is None:
            return {}
        lower, upper = finite("limits", self.limits, 2)
        if lower > upper:
            raise SceneError(f"limits {lower:g} to {upper:g} are empty; give the smaller number first")
        if not lower <= 0 <= upper:
            raise SceneError(
                f"limits {lower:g} to {upper:g} leave out 0, which is how the shapes stand now; limits count from "
                "there: add the shapes where they are within the limits"
            )
        return {"has_limits": True, "lower_limit": lower, "upper_limit": upper}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RevoluteMotor(MotorOptions):
    """Options of add_revolute_joint."""

    max_torque: float | None = None  # N m


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrismaticMotor(MotorOptions):
    """Options of add_prismatic_joint."""

    max_force: float | None = None  # N


# Springs, dampers, ropes and rods


class SpringKeywords(TypedDict, total=False):
    """Keywords of add_spring. Units and defaults: `SpringOptions`."""

    rest_length: float | None
    stiffness: float
    damping: float
    min_length: float
    max_length: float | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpringOptions:
    """Options of an element between two anchors; a rest length of None: as far as they are apart now."""

    rest_length: float | None = None  # m
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N s/m
    min_length: float = 0.0  # m
    max_length: float | None = None  # m; None: none

    def fields(self, apart: float) -> dict[str, float]:
        """Fields of `Springs`; raises SceneError for what cannot be simulated. `apart`: m between the anchors now."""
        values = {name: not_negative(name, getattr(self, name)) for name in ("stiffness", "damping", "min_length")}
        values["rest_length"] = apart if self.rest_length is None else not_negative("rest_length", self.rest_length)
        longest = NO_MAXIMUM_M if self.max_length is None else number("max_length", self.max_length)
        if longest == 0:
            raise SceneError("max_length is 0; anchors that stay in one place are a joint: use add_revolute_joint")
        if not values["min_length"] <= longest <= LARGEST:
            raise SceneError(
                f"min_length {values['min_length']:g} and max_length {longest:g} leave no length; give the smaller "
                "number as min_length, none below 0"
            )
        has_force = values["stiffness"] > 0 or values["damping"] > 0
        if not has_force and values["min_length"] == 0 and self.max_length is None:
            raise SceneError("the spring does nothing; give stiffness, damping, min_length or max_length")
        return values | {"max_length": longest}
