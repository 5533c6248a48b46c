"""Motors of any strength: against limits, and at their target speed."""

from __future__ import annotations

import math

import numpy as np

from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder
from jax2d.fidelity.trajectory import Trajectory


def motor_against_limit(power: float, limits: tuple[float, float]) -> HardScene:
    b = HardSceneBuilder(floor=False)
    base = b.box(0, 0, fixed=True)
    arm = b.box(0.9, 0, height=0.2)
    b.revolute(base, arm, 0.5, 0, motor_speed=2.0, motor_power=power, limits=limits)

    def checks(trajectory: Trajectory) -> list[Check]:
        over = math.degrees(trajectory.angle[:, arm].max() - limits[1])
        short = math.degrees(limits[1] - trajectory.angle[-1, arm])
        return [Check("overshoots, degrees", over, 1.0), Check("stays short of, degrees", short, 1.0)]

    return b.scene(f"motor of power {power:g} against a limit of {limits[1]:g} rad", checks)


def motor_settles(power: float) -> HardScene:
    """An arm held off its centre, no gravity: at speed within 1 %, and steady there."""
    b = HardSceneBuilder(gravity=0.0, floor=False)
    post = b.circle(0, 0, radius=0.1, fixed=True)
    arm = b.box(0.4, 0, height=0.2)
    tip = b.box(1.4, 0, height=0.2)
    b.revolute(post, arm, 0, 0, motor_speed=1.0, motor_power=power)
    b.fixed_joint(arm, tip, 0.9, 0)

    def checks(trajectory: Trajectory) -> list[Check]:
        late = trajectory.angular_velocity[trajectory.index_at(8.0) :, arm]
        return [
            Check("speed is wrong by a share of", np.abs(late / 6.0 - 1).max(), 0.01),
            Check("speed alternates by, rad/s", np.abs(np.diff(late)).max(), 0.02),
        ]

    return b.scene(f"motor of power {power:g}", checks)


def scenes() -> list[HardScene]:
    limits = ((-0.5, 1.0), (-4.0, 4.5), (-1.0, 7.5))  # rad, also beyond half a turn
    return [
        *(motor_against_limit(power, limit) for power in (1.0, 30.0) for limit in limits),
        *(motor_settles(power) for power in (0.05, 1.0, 4.0, 30.0, 1000.0)),
    ]
