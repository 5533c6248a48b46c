"""Units of a scene under the default settings, and friction in plain units."""

from __future__ import annotations

import math

from jax2d.settings import Settings

_DEFAULTS = Settings()
G = 9.81  # m/s^2
MOTOR_ACCELERATION = _DEFAULTS.base_motor_power  # rad/s^2 of a motor of power 1
MOTOR_SPEED = _DEFAULTS.base_motor_speed  # rad/s at motor_speed 1
THRUST = _DEFAULTS.base_thruster_power  # N of a thruster of power 1


def with_plain_friction(settings: Settings) -> Settings:
    """The settings under which two shapes of coefficient mu have a friction of mu, whatever the mixing rule."""
    mixed = math.sqrt(2.0) if settings.friction_mixing == "root_sum_square" else 1.0  # of 1 and 1
    return settings.replace(base_friction=1.0 / mixed)
