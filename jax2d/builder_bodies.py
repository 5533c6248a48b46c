"""What shapes of all kinds are given when a builder adds them: mass, surface and motion, checked."""

from __future__ import annotations

from typing import NamedTuple

from jax2d.builder_numbers import LARGEST, Point, SceneError, finite, number, positive


class Body(NamedTuple):
    """What shapes of both kinds have."""

    shape: dict[str, float]  # fields of `Shapes`
    angle: float
    velocity: list[float]
    angular_velocity: float


def body_of(
    area: float,
    second_moment: float,
    angle: float,
    density: float,
    friction: float,
    restitution: float,
    fixed: bool,
    velocity: Point,
    angular_velocity: float,
) -> Body:
    """`second_moment`: of area about the centre of mass, m^4."""
    density = positive("density", density)
    friction, restitution = number("friction", friction), number("restitution", restitution)
    if friction < 0:
        raise SceneError(f"friction is {friction:g}; it must be 0 or more")
    if not 0 <= restitution <= 1:
        raise SceneError(f"restitution is {restitution:g}; it must be from 0 to 1")
    speed, spin = finite("velocity", velocity, 2), number("angular_velocity", angular_velocity)
    if fixed and (any(speed) or spin):
        raise SceneError("a fixed shape cannot move: drop its velocity, or fixed=True")
    mass, inertia = density * area, density * second_moment
    if not fixed and not all(1 / LARGEST <= x <= LARGEST for x in (mass, inertia)):
        raise SceneError(
            f"the shape has a mass of {mass:g} kg and an inertia of {inertia:g} kg m^2; both must be from "
            f"{1 / LARGEST:g} to {LARGEST:g}: change its size or density"
        )
    shape = {
        "inverse_mass": 0.0 if fixed else 1.0 / mass,
        "inverse_inertia": 0.0 if fixed else 1.0 / inertia,
        "density": density,
        "friction": friction,
        "restitution": restitution,
    }
    return Body(shape, number("angle", angle), speed, spin)
