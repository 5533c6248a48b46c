"""The numbers of a settings object as one tuple: arguments of the compiled program, so a change compiles nothing."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax

from jax2d.settings import Settings, softness

Scalar = float | jax.Array


class Softness(NamedTuple):
    """A soft constraint solved over one sub-step; see `settings.softness`."""

    bias_rate: Scalar  # 1/s
    mass_scale: Scalar
    impulse_scale: Scalar


class Parameters(NamedTuple):
    """Run-time numbers; names and units are those of `Settings`."""

    dt: Scalar
    h: Scalar  # s, what constraints are solved over
    warm_start: bool | jax.Array
    base_friction: Scalar
    base_motor_speed: Scalar
    base_motor_power: Scalar
    base_thruster_power: Scalar
    max_speed: Scalar
    max_angular_speed: Scalar
    contact_soft: Softness
    fixed_soft: Softness  # contacts with fixed bodies, which do not yield: twice as stiff
    joint_soft: Softness
    push_out_speed: Scalar
    joint_pull_speed: Scalar
    joint_turn_speed: Scalar
    speculative_distance: Scalar
    restitution_threshold: Scalar
    slop: Scalar
    collision_correction: Scalar
    joint_velocity_correction: Scalar
    joint_position_correction: Scalar
    joint_stiffness: Scalar
    fixed_angle_rate: Scalar
    limit_angle_rate: Scalar
    motor_decay: Scalar
    motor_fade_angle: Scalar


class Rules(NamedTuple):
    """What is compiled in."""

    solver: str
    friction_mixing: str
    substeps: int
    bounce_rounds: int
    solver_batch_size: int
    published_details: frozenset[str]  # of jax2d/published_details.py

    @property
    def is_soft(self) -> bool:
        return self.solver == "soft_step"


def parameters_of(settings: Settings) -> Parameters:
    h = settings.substep_seconds
    contact_hertz = min(settings.contact_hertz, settings.contact_hertz_share / h)
    joint_hertz = min(settings.joint_hertz, settings.joint_hertz_share / h)
    derived = {
        "h": h,
        "contact_soft": Softness(*softness(contact_hertz, settings.contact_damping_ratio, h)),
        "fixed_soft": Softness(*softness(2 * contact_hertz, settings.contact_damping_ratio, h)),
        "joint_soft": Softness(*softness(joint_hertz, settings.joint_damping_ratio, h)),
    }
    given = {name: value for name, value in dataclasses.asdict(settings).items() if name in Parameters._fields}
    return Parameters(**given, **derived)


def rules_of(settings: Settings) -> Rules:
    return Rules(
        settings.solver,
        settings.friction_mixing,
        settings.substeps,
        settings.bounce_rounds,
        settings.solver_batch_size,
        frozenset(settings.published_details),
    )
