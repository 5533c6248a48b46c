"""Run-time numbers of a solver: those of `Settings`, and those that follow from them.

Both backends take them from here: the reference as the tuple, the kernel as one float32 table (`flat`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from jax2d.settings import Settings

Scalar = Any  # float or traced array


class Softness(NamedTuple):
    """A soft constraint solved over one sub-step: a spring that stays stable at any step."""

    bias_rate: Scalar  # 1/s
    mass_scale: Scalar
    impulse_scale: Scalar


class SolverNumbers(NamedTuple):
    """Names and units are those of `Settings`, but for what its comments say."""

    dt: Scalar
    h: Scalar  # s, what constraints are solved over
    substeps: Scalar
    warm_start: Scalar
    base_friction: Scalar
    base_motor_speed: Scalar
    base_motor_power: Scalar
    base_slider_speed: Scalar
    base_slider_power: Scalar
    base_thruster_power: Scalar
    max_speed: Scalar
    max_angular_speed: Scalar
    contact: Softness
    fixed: Softness  # contacts with fixed bodies, which do not yield: twice as stiff
    spring: Softness
    joint_correction: Scalar
    push_out_speed: Scalar
    joint_pull_speed: Scalar
    joint_turn_speed: Scalar
    speculative_distance: Scalar
    restitution_threshold: Scalar
    bounce_rounds: Scalar
    impact_passes: Scalar
    slop: Scalar
    collision_correction: Scalar
    joint_velocity_correction: Scalar
    joint_position_correction: Scalar
    joint_stiffness: Scalar
    fixed_angle_rate: Scalar
    limit_angle_rate: Scalar
    motor_decay: Scalar
    motor_fade_angle: Scalar


def solver_numbers(settings: Settings) -> SolverNumbers:
    h = settings.substep_seconds
    contact_hertz = min(settings.contact_hertz, settings.contact_hertz_share / h)
    spring_hertz = min(settings.spring_hertz, settings.spring_hertz_share / h)
    derived = {
        "h": h,
        "contact": softness(contact_hertz, settings.contact_damping_ratio, h),
        "fixed": softness(2 * contact_hertz, settings.contact_damping_ratio, h),
        "spring": softness(spring_hertz, settings.spring_damping_ratio, h),
    }
    given = {name: getattr(settings, name) for name in SolverNumbers._fields if name not in derived}
    return SolverNumbers(**given, **derived)


def softness(hertz: float, damping_ratio: float, h: float) -> Softness:
    """Softness of a constraint of this frequency (Hz), solved over h seconds.

    omega = 2 pi f, a1 = 2 zeta + h omega, a2 = h omega a1: omega / a1, a2 / (1 + a2), 1 / (1 + a2).
    """
    if hertz == 0.0:
        return Softness(0.0, 1.0, 0.0)
    omega = 2.0 * math.pi * hertz
    a1 = 2.0 * damping_ratio + h * omega
    a2 = h * omega * a1
    return Softness(omega / a1, a2 / (1.0 + a2), 1.0 / (1.0 + a2))


def flat(numbers: SolverNumbers) -> dict[str, float]:
    """Returns all numbers by name; those of a softness by its name first: contact_bias_rate."""
    values: dict[str, float] = {}
    for name, value in zip(numbers._fields, numbers):
        if isinstance(value, Softness):
            values |= {f"{name}_{part}": number for part, number in zip(Softness._fields, value)}
        else:
            values[name] = value
    return values
