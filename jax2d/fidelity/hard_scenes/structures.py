"""Grids, nets and beams: many joints that share a load."""

from __future__ import annotations

from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder, widest_gap
from jax2d.fidelity.trajectory import Trajectory


def joint_grid() -> HardScene:
    """Eight by seven discs of 0.4 m, each joined to its neighbours 1 m away; the top row is held at its ends."""
    b = HardSceneBuilder(floor=False)
    columns, rows = 8, 7
    balls = [
        [b.circle(x, -y, radius=0.4, fixed=y == 0 and x in (0, columns - 1)) for x in range(columns)]
        for y in range(rows)
    ]
    for y in range(rows):
        for x in range(columns):
            if x:
                b.revolute(balls[y][x - 1], balls[y][x], x - 0.5, -y)
            if y:
                b.revolute(balls[y - 1][x], balls[y][x], x, -y + 0.5)

    def checks(trajectory: Trajectory) -> list[Check]:
        speed = trajectory.speed()
        return [
            widest_gap(trajectory, 0.05),
            Check("fastest in the last second, m/s", speed[trajectory.index_at(trajectory.time[-1] - 1) :].max(), 0.1),
        ]

    return b.scene("joint grid", checks)


def net() -> HardScene:
    """A net of bilateral joints with loops everywhere, pulled out of shape, for a minute."""
    b = HardSceneBuilder(floor=False)
    columns, rows = 8, 6
    balls = [[b.circle(x, -y, radius=0.3, fixed=y == 0) for x in range(columns)] for y in range(rows)]
    for y in range(1, rows):
        for x in range(columns):
            if x:
                b.revolute(balls[y][x - 1], balls[y][x], x - 0.3, -y + 0.2)
            b.revolute(balls[y - 1][x], balls[y][x], x + 0.1, -y + 0.5)

    def checks(trajectory: Trajectory) -> list[Check]:
        energy = trajectory.energy(zero_at=trajectory.position[0])  # at rest at the start: what it gains
        return [
            Check("fastest, m/s", trajectory.speed().max(), 20.0),
            Check("energy gained, J", energy.max(), 0.1),
        ]

    return b.scene("net of joints", checks, seconds=60.0)


def cantilever() -> HardScene:
    """Eight bars welded in a row to a wall."""
    b = HardSceneBuilder(floor=False)
    last = b.box(-0.5, 0, fixed=True)
    for k in range(8):
        bar = b.box(k + 0.5, 0, height=0.25)
        b.fixed_joint(last, bar, k, 0)
        last = bar

    def checks(trajectory: Trajectory) -> list[Check]:
        speed = trajectory.speed()
        early, late = speed[: trajectory.index_at(1.0)].max(), speed[trajectory.index_at(9.0) :].max()
        return [
            Check("speed of the last second to the first", late / early, 0.5),
            widest_gap(trajectory, 0.05),
        ]

    return b.scene("cantilever of 8 welds", checks)


def scenes() -> list[HardScene]:
    return [joint_grid(), net(), cantilever()]
