"""Sizes and positions at the ends of what float32 holds: huge, thin, tiny, far from the origin."""

from __future__ import annotations

from jax2d.fidelity.hard_scenes.scene import MU, SLOP_M, Check, HardScene, HardSceneBuilder
from jax2d.fidelity.hard_scenes.stacks import pyramid, stack
from jax2d.fidelity.trajectory import Trajectory


def huge_ground() -> HardScene:
    b = HardSceneBuilder(floor=False)
    b.box(0, -0.5, width=1e4, fixed=True)
    for x in (0.3, 4000.3):
        for k in range(5):
            b.box(x, 0.5 + k)
    return b.scene("ground of 10 km", lambda trajectory: [Check("drifts, m", float(trajectory.drift()), 0.05)])


def thin_shapes() -> HardScene:
    """A triangle of 1 m by 1 mm, a disc of 1 mm and a needle fall on a floor."""
    b = HardSceneBuilder()
    b.builder.add_polygon([(0, 0), (1, 0), (0.5, 1e-3)], position=(0, 1), friction=MU)
    b.builder.add_polygon([(0, 0), (1e-3, 0), (0, 1)], position=(3, 1), friction=MU)
    b.circle(6, 1, radius=1e-3)
    b.box(9, 1, width=1, height=1e-3)

    def checks(trajectory: Trajectory) -> list[Check]:
        return [
            Check("lowest centre, m below the floor", -trajectory.position[:, trajectory.is_movable, 1].min(), SLOP_M),
            Check("moves at, m/s", trajectory.speed()[-1], 0.05),
        ]

    return b.scene("thin and tiny shapes", checks)


def scenes() -> list[HardScene]:
    return [
        huge_ground(),
        thin_shapes(),
        pyramid(rows=5, size=0.05),
        *(stack(count, at=(far, far)) for far in (1e3, 1e4) for count in (5, 10, 15)),
        *(pyramid(at=(far, far)) for far in (1e3, 1e4)),
    ]
