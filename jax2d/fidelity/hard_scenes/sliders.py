"""Prismatic joints: loads to the side, stacked stages, strong motors, a closed loop."""

from __future__ import annotations

import math

import numpy as np

from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder, widest_gap
from jax2d.fidelity.trajectory import Trajectory


def slider_against_limit(power: float) -> HardScene:
    """A cart of 0.04 kg that its motor drives against a limit 0.8 m away."""
    b = HardSceneBuilder(gravity=0.0, floor=False)
    rail = b.box(0, 0, width=3, height=0.1, fixed=True)
    cart = b.box(0, 0.2, width=0.2, height=0.2)
    b.prismatic(rail, cart, 0, 0.2, motor_speed=2.0, motor_power=power, limits=(-0.8, 0.8))

    def checks(trajectory: Trajectory) -> list[Check]:
        x = trajectory.position[:, cart, 0]
        return [
            Check("overshoots, m", x.max() - 0.8, 0.01),
            Check("stays short of, m", 0.8 - x[-1], 0.01),
            widest_gap(trajectory, 0.001),
        ]

    return b.scene(f"slider of power {power:g} against a limit", checks)


def side_load(arm: float) -> HardScene:
    """A cart of 0.04 kg on a vertical rail carries 0.25 kg `arm` metres to its side, falls 0.5 m and rests on its lower
    limit."""
    b = HardSceneBuilder(floor=False)
    rail = b.box(0, 0, width=0.2, height=3, fixed=True)
    cart = b.box(0.3, 0, width=0.2, height=0.2)
    load = b.box(0.3 + arm, 0, width=0.5, height=0.5)
    b.prismatic(rail, cart, 0.3, 0, axis_angle=math.pi / 2, limits=(-0.5, 0.5))
    b.fixed_joint(cart, load, 0.3 + arm / 2, 0)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            widest_gap(trajectory, 0.05),
            Check("away from its limit, m", np.abs(trajectory.position[-1, cart, 1] + 0.5), 0.01),
            Check("tilts at rest, degrees", math.degrees(np.abs(trajectory.angle[-1, cart])), 2.0),
        ]

    return b.scene(f"load {arm:g} m to the side of a slider", checks)


def telescope(ratio: float) -> HardScene:
    """Three stages of 0.2 m of reach, each `ratio` times as dense as the one before; they run out to their limits."""
    b = HardSceneBuilder(floor=False)
    previous = b.box(0, 0, width=0.2, height=0.4, fixed=True)
    for k in range(3):
        stage = b.box(0.25 * (k + 1), 0, width=0.2, height=0.4, density=ratio**k)
        b.prismatic(previous, stage, 0.25 * k, 0, axis_angle=-1.0, limits=(-0.2, 0.2))
        previous = stage

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            widest_gap(trajectory, 0.05),
            Check("tilts, degrees", math.degrees(np.abs(trajectory.angle).max()), 5.0),
            Check("fastest in the last second, m/s", trajectory.speed()[trajectory.index_at(9.0) :].max(), 0.5),
        ]

    return b.scene(f"telescope of 3 stages, mass ratio {ratio:g}", checks)


def press(density: float) -> HardScene:
    """A driven slab of that density pushes a box of 0.09 kg against a wall: the force is 100 m/s2 times the slab."""
    b = HardSceneBuilder(gravity=0.0, floor=False)
    frame = b.box(-2, 0, width=0.2, height=2, fixed=True)
    b.box(1, 0, width=0.2, height=2, fixed=True)
    slab = b.box(-1, 0, width=0.5, height=0.5, density=density)
    box = b.box(0, 0.05, width=0.3, height=0.3)
    b.prismatic(frame, slab, -1, 0, motor_speed=1.0, motor_power=1.0)

    def checks(trajectory: Trajectory) -> list[Check]:
        late = trajectory.index_at(5.0)
        return [
            Check("overlap, m", trajectory.depth(), 0.01),
            Check("box leaves, m", np.abs(trajectory.position[:, box, 1]).max(), 0.3),
            Check("moves at, m/s", trajectory.speed()[late:].max(), 0.05),
        ]

    return b.scene(f"press of density {density:g}", checks)


def slider_crank() -> HardScene:
    """A crank of 0.4 m drives a piston on a rail through a rod of 1.2 m: a closed loop of four joints."""
    b = HardSceneBuilder(gravity=0.0, floor=False)
    frame = b.box(0.8, -1, width=3, height=0.2, fixed=True)
    crank = b.box(0.2, 0, width=0.4, height=0.1)
    rod = b.box(1.0, 0, width=1.2, height=0.1)
    piston = b.box(1.6, 0, width=0.3, height=0.3)
    b.revolute(frame, crank, 0, 0, motor_speed=0.5, motor_power=20.0)
    b.revolute(crank, rod, 0.4, 0)
    b.revolute(rod, piston, 1.6, 0)
    b.prismatic(frame, piston, 1.6, 0)
    b.keep_all_apart([frame, crank, rod, piston])

    def checks(trajectory: Trajectory) -> list[Check]:
        angle = trajectory.angle[:, crank]
        x = 0.4 * np.cos(angle) + np.sqrt(1.2**2 - (0.4 * np.sin(angle)) ** 2)
        late = trajectory.angular_velocity[trajectory.index_at(1.0) :, crank]
        return [
            widest_gap(trajectory, 0.004),
            Check("piston is off its formula by, m", np.abs(trajectory.position[:, piston, 0] - x).max(), 0.01),
            Check("motor speed is wrong by a share of", np.abs(late / 3.0 - 1).max(), 0.02),
        ]

    return b.scene("slider crank", checks)


def lift() -> HardScene:
    """A platform of 1 kg lifts a stack of three boxes of 1 kg by 2 m and holds it there."""
    b = HardSceneBuilder(floor=False)
    shaft = b.box(-3, 0, width=0.2, height=6, fixed=True)
    platform = b.box(0, 0, width=2, height=0.5)
    boxes = [b.box(0, 0.75 + k) for k in range(3)]
    b.prismatic(shaft, platform, 0, 0, axis_angle=math.pi / 2, motor_speed=0.5, motor_power=2.0, limits=(0.0, 2.0))

    def checks(trajectory: Trajectory) -> list[Check]:
        late = trajectory.index_at(5.0)
        return [
            Check("away from its limit, m", np.abs(trajectory.position[late:, platform, 1] - 2.0).max(), 0.01),
            Check("boxes drift, m", np.abs(trajectory.position[:, boxes, 0]).max(), 0.05),
            Check("moves at, m/s", trajectory.speed()[-1], 0.01),
            widest_gap(trajectory, 0.01),
        ]

    return b.scene("lift of three boxes", checks)


def scenes() -> list[HardScene]:
    return [
        *(slider_against_limit(power) for power in (1.0, 30.0)),
        *(side_load(arm) for arm in (0.5, 2.0)),
        *(telescope(ratio) for ratio in (1.0, 2.0)),
        *(press(density) for density in (1.0, 10.0)),
        slider_crank(),
        lift(),
    ]
