"""Bodies on bodies: stacks, shapes that start inside each other, arches and card houses."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import Point
from jax2d.fidelity.hard_scenes.scene import MU, SLOP_M, Check, HardScene, HardSceneBuilder, drop
from jax2d.fidelity.trajectory import Trajectory

# Stacks


def single_box() -> HardScene:
    b = HardSceneBuilder()
    box = b.box(0, 1.5)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("height is wrong by, m", abs(trajectory.position[-1, box, 1] - 0.5), 2 * SLOP_M),
            Check("moves at, m/s", trajectory.speed()[-1], 1e-3),
        ]

    return b.scene("single box", checks)


def stack(count: int, at: Point = (0.0, 0.0)) -> HardScene:
    b = HardSceneBuilder(at=at)
    for i in range(count):
        b.box(0, 0.5 + i)
    far = f" {max(at):g} m away" if any(at) else ""
    return b.scene(f"stack of {count}{far}", lambda trajectory: [Check("drifts, m", float(trajectory.drift()), 0.05)])


def circle_stack() -> HardScene:
    b = HardSceneBuilder()
    balls = [b.circle(0, 0.5 + i) for i in range(10)]

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("leans, m", np.abs(trajectory.position[-1, balls, 0]).max(), 1e-3),
            Check("sags, m", 9.5 - trajectory.position[-1, balls[-1], 1], 0.03),
        ]

    return b.scene("circle stack of 10", checks)


def pyramid(rows: int = 10, size: float = 1.0, at: Point = (0.0, 0.0)) -> HardScene:
    b = HardSceneBuilder(at=at)
    for row in range(rows):
        for k in range(rows - row):
            top = b.box((k - (rows - row - 1) / 2) * 1.1 * size, (0.5 + row) * size, width=size, height=size)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("top drops, m", drop(trajectory, top), 0.1 * size),
            Check("overlap, m", float(trajectory.depth()), 2 * SLOP_M * size),
        ]

    small = f" of {size:g} m" if size != 1.0 else ""
    far = f" {max(at):g} m away" if any(at) else ""
    return b.scene(f"pyramid of {rows} rows{small}{far}", checks)


def heavy_on_light(ratio: float, size: float = 1.0) -> HardScene:
    """A box on a box of the same size that is `ratio` times lighter."""
    b = HardSceneBuilder()
    light = b.box(0, 0.5 * size, width=size, height=size)
    heavy = b.box(0, 1.5 * size, width=size, height=size, density=ratio)

    def checks(trajectory: Trajectory) -> list[Check]:
        height = trajectory.position[-1, :, 1]
        return [
            Check("light box sinks, m", 0.5 * size - height[light], 0.15 * size),
            Check("order is lost by, m", 0.8 * size - (height[heavy] - height[light]), 0.0),
            Check("moves at, m/s", trajectory.speed()[-1], 0.01),
        ]

    small = f" of boxes of {size:g} m" if size != 1.0 else ""
    return b.scene(f"mass ratio {ratio:g}{small}", checks)


def heavy_pyramid_top(ratio: float = 300.0) -> HardScene:
    """A pyramid of five rows under a block `ratio` times as heavy as each of its boxes."""
    b = HardSceneBuilder()
    for row in range(5):
        for k in range(5 - row):
            top = b.box((k - (4 - row) / 2) * 1.1, 0.5 + row)
    heavy = b.box(0, 5.5, density=ratio)

    def checks(trajectory: Trajectory) -> list[Check]:
        height = trajectory.position[-1, :, 1]
        return [
            Check("order is lost by, m", 0.5 - (height[heavy] - height[top]), 0.0),
            Check("top drops, m", drop(trajectory, top), 1.0),
        ]

    return b.scene(f"pyramid under mass ratio {ratio:g}", checks)


# Overlaps


def overlapping_boxes() -> HardScene:
    b = HardSceneBuilder()
    for row in range(4):
        for k in range(4 - row):
            b.box((k - (3 - row) / 2) * 0.75, 0.5 + 0.75 * row)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("fastest, m/s", trajectory.speed().max(), 5.0),
            Check("moves after 5 s, m/s", trajectory.speed()[trajectory.index_at(5.0) :].max(), 0.05),
        ]

    return b.scene("overlap of 25 %", checks)


def coincident_centres() -> HardScene:
    b = HardSceneBuilder(gravity=0.0, floor=False)
    b.circle(0, 0)
    b.circle(0, 0)
    b.box(10, 0)
    b.box(10, 0)
    b.box(20, 0)
    b.circle(20, 0)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("overlap after 2 s, m", float(trajectory.depth(trajectory.index_at(2.0))), 2 * SLOP_M),
            Check("fastest, m/s", trajectory.speed().max(), 5.0),
        ]

    return b.scene("coincident centres", checks)


def squeezed_circles() -> HardScene:
    """Sixty discs, pressed to four fifths of their distance in a closed box."""
    b = HardSceneBuilder(floor=False)
    for x, y, width, height in ((0, -4.5, 12, 1), (0, 4.5, 12, 1), (-4.5, 0, 1, 12), (4.5, 0, 1, 12)):
        b.box(x, y, width=width, height=height, fixed=True)
    for i in range(60):
        b.circle(-3.2 + 0.8 * (i % 9), -3.2 + 0.8 * (i // 9))

    def checks(trajectory: Trajectory) -> list[Check]:
        inside = np.abs(trajectory.position[:, trajectory.is_movable]).max()
        energy = trajectory.kinetic_energy()
        early, late = energy[: trajectory.index_at(1.0)].max(), energy[trajectory.index_at(5.0) :].max()
        return [
            Check("farthest centre, m", inside, 4.0),
            Check("kinetic energy after 5 s to that of the first second", late / early, 0.05),
        ]

    return b.scene("squeezed circles", checks)


# Masonry


# Outer and inner corners of one half of Box2D's arch, x, y in units of 0.25 m.
_ARCH_INNER = (
    (16.0, 0.0),
    (14.938037, 5.133601),
    (13.798717, 10.249281),
    (12.562530, 15.341070),
    (11.200410, 20.398565),
    (9.665212, 25.403699),
    (7.871799, 30.317934),
    (5.635200, 35.038207),
    (2.405938, 39.095541),
)
_ARCH_OUTER = (
    (24.0, 0.0),
    (22.336195, 6.022998),
    (20.549369, 12.009644),
    (18.608546, 17.947032),
    (16.467693, 23.813679),
    (14.053250, 29.570794),
    (11.235510, 35.137758),
    (7.752568, 40.304507),
    (3.016932, 44.288916),
)


def arch() -> HardScene:
    """Seventeen stones without mortar, loaded with four blocks."""
    b = HardSceneBuilder()
    inner, outer = 0.25 * np.array(_ARCH_INNER), 0.25 * np.array(_ARCH_OUTER)
    mirror = np.array([-1.0, 1.0])
    for k in range(8):
        b.polygon([inner[k], outer[k], outer[k + 1], inner[k + 1]])
        b.polygon([inner[k + 1] * mirror, outer[k + 1] * mirror, outer[k] * mirror, inner[k] * mirror])
    keystone = b.polygon([inner[8], outer[8], outer[8] * mirror, inner[8] * mirror])
    for k in range(4):
        b.box(0, outer[8][1] + 0.5 + k)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [Check("keystone drops, m", drop(trajectory, keystone), 0.5)]

    return b.scene("arch", checks, seconds=20.0)


def card_house() -> HardScene:
    """Box2D's house of cards: 40 cards of 2 mm by 0.4 m, friction 0.7."""
    b = HardSceneBuilder(mu=MU * 0.7 / 0.6)
    height, tilt = 0.2, math.radians(25)
    start, y = 0.0, height - 0.02
    for cards in range(5, 0, -1):
        x = start
        for k in range(cards):
            if k < cards - 1:
                b.box(x + 0.25, y + height - 0.015, width=0.002, height=2 * height, angle=math.pi / 2)
            b.box(x, y, width=0.002, height=2 * height, angle=-tilt)
            top = b.box(x + 0.175, y, width=0.002, height=2 * height, angle=tilt)
            x += 0.35
        y += 2 * height - 0.03
        start += 0.175

    def checks(trajectory: Trajectory) -> list[Check]:
        return [Check("highest card drops, m", drop(trajectory, top), 0.1)]

    return b.scene("card house", checks)


def scenes() -> list[HardScene]:
    return [
        single_box(),
        *(stack(count) for count in (5, 10, 15)),
        circle_stack(),
        pyramid(),
        *(heavy_on_light(ratio) for ratio in (10.0, 100.0, 400.0)),
        *(heavy_on_light(ratio, size=0.2) for ratio in (200.0, 400.0)),
        heavy_pyramid_top(),
        overlapping_boxes(),
        coincident_centres(),
        squeezed_circles(),
        arch(),
        card_house(),
    ]
