"""Machines: linkages and vehicles, motors of any strength, sliders."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import Point
from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder, widest_gap
from jax2d.fidelity.trajectory import Trajectory

MOTOR_LIMITS = ((-0.5, 1.0), (-4.0, 4.5), (-1.0, 7.5))  # rad, also beyond half a turn

# Linkages and vehicles


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
        first, last = np.asarray(start), np.asarray(end)
        run = last - first
        middle = (first + last) / 2
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
            Check("motor speed is wrong by a fraction of", np.abs(late / 3.0 - 1).max(), 0.02),
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
            Check("motor speed is wrong by a fraction of", np.abs(late / -6.0 - 1).max(), 0.02),
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


# Motors


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
            Check("speed is wrong by a fraction of", np.abs(late / 6.0 - 1).max(), 0.01),
            Check("speed alternates by, rad/s", np.abs(np.diff(late)).max(), 0.02),
        ]

    return b.scene(f"motor of power {power:g}", checks)


# Sliders


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
            Check("overlap, m", float(trajectory.depth()), 0.01),
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
            Check("motor speed is wrong by a fraction of", np.abs(late / 3.0 - 1).max(), 0.02),
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
        four_bar(),
        cart(),
        strong_wheel(),
        *(motor_against_limit(power, limit) for power in (1.0, 30.0) for limit in MOTOR_LIMITS),
        *(motor_settles(power) for power in (0.05, 1.0, 4.0, 30.0, 1000.0)),
        *(slider_against_limit(power) for power in (1.0, 30.0)),
        *(side_load(arm) for arm in (0.5, 2.0)),
        *(telescope(ratio) for ratio in (1.0, 2.0)),
        *(press(density) for density in (1.0, 10.0)),
        slider_crank(),
        lift(),
    ]
