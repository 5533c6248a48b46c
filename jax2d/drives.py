"""Motors as arguments of the scene builder: drive, limits, units.

    motor_speed, motor_power    of a level: times settings.base_motor_speed and base_motor_power (of sliders
                                base_slider_speed and base_slider_power)
    speed                       rad/s, of sliders m/s
    max_torque, max_force       N m, of sliders N: power x base power x what the motor moves of its two bodies alone

What a motor moves: kg m^2 with 1/I = 1/I_a + 1/I_b; of a slider kg along its axis, turning of the bodies included.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from jax2d.given import SceneError, finite, in_units, number, one_of, positive
from jax2d.scene import JointDrive, JointKind
from jax2d.settings import Settings

DRIVES = {drive.name.lower(): drive for drive in JointDrive}  # names in the scene builder


class MotorUnits(NamedTuple):
    """Units of the numbers of a motor: names of settings."""

    speed: str  # rad/s or m/s at motor_speed 1
    acceleration: str  # rad/s^2 or m/s^2 that a motor of power 1 gives to its two bodies alone


def motor_units(kind: JointKind) -> MotorUnits:
    if kind == JointKind.PRISMATIC:
        return MotorUnits("base_slider_speed", "base_slider_power")
    return MotorUnits("base_motor_speed", "base_motor_power")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotorOptions:
    """Arguments of a motor and limits; None where left out."""

    motor_speed: float | None
    motor_power: float | None
    speed: float | None
    strength: float | None  # N m or N
    strength_name: str
    drive: str
    limits: tuple[float, float] | None

    def fields(self, kind: JointKind, settings: Settings, moved: float) -> dict[str, float]:
        """Fields of `Joints`; raises SceneError for what contradicts itself. `moved`: kg m^2, of a slider kg."""
        return self._motor(motor_units(kind), settings, moved) | self._limits()

    def _motor(self, units: MotorUnits, settings: Settings, moved: float) -> dict[str, float]:
        one_of(("motor_speed", self.motor_speed), ("speed", self.speed))
        one_of(("motor_power", self.motor_power), (self.strength_name, self.strength))
        if not isinstance(self.drive, str) or self.drive not in DRIVES:
            raise SceneError(f"drive is {self.drive!r}; use {', '.join(map(repr, DRIVES))}")
        if self.motor_speed is None and self.speed is None:
            strengths = {self.strength_name: self.strength, "motor_power": self.motor_power}
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
            speed = number("motor_speed", self.motor_speed)  # type: ignore[arg-type]
        if self.drive == "servo" and speed == 0:
            raise SceneError("a servo of speed 0 never moves; give the largest speed at which it goes to its position")
        if self.strength is not None:
            name = self.strength_name
            power = in_units(name, positive(name, self.strength), settings, units.acceleration) / moved
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
