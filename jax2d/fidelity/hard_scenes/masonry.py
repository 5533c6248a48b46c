"""Structures that stand by contacts and friction alone."""

from __future__ import annotations

import math

import numpy as np

from jax2d.fidelity.hard_scenes.scene import MU, Check, HardScene, HardSceneBuilder, drop
from jax2d.fidelity.trajectory import Trajectory

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
    return [arch(), card_house()]
