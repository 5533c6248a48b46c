"""Sliding down ramps and over the seams of a floor."""

from __future__ import annotations

import math

import numpy as np

from jax2d.fidelity.hard_scenes.scene import MU, Check, HardScene, HardSceneBuilder
from jax2d.fidelity.trajectory import Trajectory


def friction_ramp(mu: float, slope: float = 0.25) -> HardScene:
    b = HardSceneBuilder(floor=False, mu=MU * mu / 0.6)
    b.box(0, 0, width=100, angle=-slope, fixed=True)
    box = b.box(math.sin(slope), math.cos(slope), angle=-slope)
    stays = mu > math.tan(slope)
    slide = 9.81 * (math.sin(slope) - mu * math.cos(slope))

    def checks(trajectory: Trajectory) -> list[Check]:
        if stays:
            moved = trajectory.position[-1, box] - trajectory.position[trajectory.index_at(1.0), box]
            return [Check("creeps, m/s", float(np.linalg.norm(moved)) / 9.0, 1e-3)]
        speed = float(np.linalg.norm(trajectory.velocity[trajectory.index_at(3.0), box]))
        return [Check("speed after 3 s is wrong by a fraction of", abs(speed / (3 * slide) - 1), 0.02)]

    return b.scene(f"ramp of 0.25 rad, friction {mu:g}", checks)


def tiled_floor(disc: bool) -> HardScene:
    """A box or a disc slides without friction over a floor of tiles: inner edges must not trip it."""
    b = HardSceneBuilder(floor=False, mu=0.0)
    for k in range(60):
        b.box(k, -0.5, fixed=True)
    body = b.circle(0, 0.5, velocity=(5.0, 0.0)) if disc else b.box(0, 0.5, velocity=(5.0, 0.0))

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("vertical speed, m/s", np.abs(trajectory.velocity[:, body, 1]).max(), 0.05),
            Check("loses speed, m/s", 5.0 - trajectory.velocity[-1, body, 0], 0.05),
        ]

    return b.scene(f"{'disc' if disc else 'box'} over a tiled floor", checks)


def scenes() -> list[HardScene]:
    return [*(friction_ramp(mu) for mu in (0.2, 0.3)), *(tiled_floor(disc) for disc in (False, True))]
