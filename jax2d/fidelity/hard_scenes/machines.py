"""Linkages and vehicles: motors, closed loops and wheels."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import Point
from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder, widest_gap
from jax2d.fidelity.trajectory import Trajectory


def four_bar() -> HardScene:
    """A crank of 0.4 m drives a rocker of 1 m through a coupler of 1.2 m; frame 1.1 m."""
    b = HardSceneBuilder(floor=False)
    frame = b.box(0.55, -1, width=2, height=0.2, fixed=True)
    crank_end = np.array([0.0, 0.4])
    # Where the coupler meets the rocker: 1.2 m from the crank's end, 1 m from (1.1, 0).
    along = np.array([1.1, 0.0]) - crank_end
    distance = float(np.hypot(*along))
    share = (1.2**2 - 1.0**2 + distance**2) / (2 * distance)
    meet = (
        crank_end + share * along / distance + math.sqrt(1.2**2 - share**2) * np.array([-along[1], along[0]]) / distance
    )

    def bar(start: Point, end: Point) -> int:
        start, end = np.asarray(start), np.asarray(end)
        run = end - start
        middle = (start + end) / 2
        return b.box(*middle, width=float(np.hypot(*run)), height=0.1, angle=math.atan2(run[1], run[0]))

    crank, coupler, rocker = bar((0, 0), crank_end), bar(crank_end, meet), bar((1.1, 0), meet)
    b.revolute(frame, crank, 0, 0, motor_speed=0.5, motor_power=20.0)
    b.revolute(crank, coupler, *crank_end)
    b.revolute(coupler, rocker, *meet)
    b.revolute(frame, rocker, 1.1, 0)
    b.keep_all_apart([frame, crank, coupler, rocker])

    def checks(trajectory: Trajectory) -> list[Check]:
        late = trajectory.angular_velocity[trajectory.index_at(1.0) :, crank]
        return [
            widest_gap(trajectory, 0.004),
            Check("motor speed is wrong by a share of", np.abs(late / 3.0 - 1).max(), 0.02),
        ]

    return b.scene("four-bar linkage", checks)


def cart() -> HardScene:
    """A cart on two driven wheels, on level ground."""
    b = HardSceneBuilder()
    body = b.box(0, 0.6, width=2, height=0.4)
    wheels = []
    for x in (-0.8, 0.8):
        wheels.append(b.circle(x, 0.4, radius=0.4))
        b.revolute(body, wheels[-1], x, 0.4, motor_speed=-1.0, motor_power=0.3)

    def checks(trajectory: Trajectory) -> list[Check]:
        turning = trajectory.angular_velocity[:, wheels] - trajectory.angular_velocity[:, [body]]
        late = turning[trajectory.index_at(5.0) :]
        return [
            widest_gap(trajectory, 0.01),
            Check("motor speed is wrong by a share of", np.abs(late / -6.0 - 1).max(), 0.02),
        ]

    return b.scene("cart", checks)


def strong_wheel() -> HardScene:
    """The same cart with its motors a hundred times as strong: it may spin its wheels, not jump."""
    b = HardSceneBuilder()
    body = b.box(0, 0.6, width=2, height=0.4)
    for x in (-0.8, 0.8):
        wheel = b.circle(x, 0.4, radius=0.4)
        b.revolute(body, wheel, x, 0.4, motor_speed=-2.0, motor_power=30.0)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("rises, m", trajectory.position[:, trajectory.is_movable, 1].max() - 0.6, 0.5),
            Check("vertical speed, m/s", np.abs(trajectory.velocity[:, trajectory.is_movable, 1]).max(), 3.0),
        ]

    return b.scene("strong wheels", checks)


def scenes() -> list[HardScene]:
    return [four_bar(), cart(), strong_wheel()]
