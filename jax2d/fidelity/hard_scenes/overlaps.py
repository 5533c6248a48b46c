"""Bodies that start inside each other."""

from __future__ import annotations

import numpy as np

from jax2d.fidelity.hard_scenes.scene import SLOP_M, Check, HardScene, HardSceneBuilder
from jax2d.fidelity.trajectory import Trajectory


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
            Check("overlap after 2 s, m", trajectory.depth(trajectory.index_at(2.0)), 2 * SLOP_M),
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


def scenes() -> list[HardScene]:
    return [overlapping_boxes(), coincident_centres(), squeezed_circles()]
