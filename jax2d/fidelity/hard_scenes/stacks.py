"""Stacks of boxes, circles and unequal masses."""

from __future__ import annotations

import numpy as np

from jax2d.builder import Point
from jax2d.fidelity.hard_scenes.scene import SLOP_M, Check, HardScene, HardSceneBuilder, drop
from jax2d.fidelity.trajectory import Trajectory


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
    return b.scene(f"stack of {count}{far}", lambda trajectory: [Check("drifts, m", trajectory.drift(), 0.05)])


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
            Check("overlap, m", trajectory.depth(), 2 * SLOP_M * size),
        ]

    small = f" of {size:g} m" if size != 1.0 else ""
    far = f" {max(at):g} m away" if any(at) else ""
    return b.scene(f"pyramid of {rows} rows{small}{far}", checks)


def heavy_on_light(ratio: float) -> HardScene:
    b = HardSceneBuilder()
    light = b.box(0, 0.5)
    heavy = b.box(0, 1.5, density=ratio)

    def checks(trajectory: Trajectory) -> list[Check]:
        height = trajectory.position[-1, :, 1]
        return [
            Check("light box sinks, m", 0.5 - height[light], 0.15),
            Check("order is lost by, m", 0.8 - (height[heavy] - height[light]), 0.0),
            Check("moves at, m/s", trajectory.speed()[-1], 0.01),
        ]

    return b.scene(f"mass ratio {ratio:g}", checks)


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


def scenes() -> list[HardScene]:
    return [
        single_box(),
        *(stack(count) for count in (5, 10, 15)),
        circle_stack(),
        pyramid(),
        *(heavy_on_light(ratio) for ratio in (10.0, 100.0, 400.0)),
        heavy_pyramid_top(),
    ]
