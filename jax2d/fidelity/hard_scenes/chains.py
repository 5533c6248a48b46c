"""Many joints: bridges and chains, grids, nets and beams."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from jax2d.builder_checks import Points
from jax2d.fidelity.hard_scenes.scene import Check, HardScene, HardSceneBuilder, widest_gap
from jax2d.fidelity.trajectory import Trajectory

# Bridges and chains


def _planks(b: HardSceneBuilder, corners: Points) -> None:
    """Planks of 1 m from corner to corner, hinged to each other and to a fixed block at either end."""
    last = b.box(corners[0][0] - 0.5, corners[0][1], height=0.25, fixed=True)
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        plank = b.box((x0 + x1) / 2, (y0 + y1) / 2, height=0.25, angle=math.atan2(y1 - y0, x1 - x0))
        b.revolute(last, plank, x0, y0)
        last = plank
    end = b.box(corners[-1][0] + 0.5, corners[-1][1], height=0.25, fixed=True)
    b.revolute(last, end, *corners[-1])


def bridge() -> HardScene:
    """Twenty planks that hang in an arc between ends 19 m apart."""
    b = HardSceneBuilder(floor=False)
    turn = 0.0553  # rad from plank to plank, with which twenty chords of 1 m span 19 m
    steps = [(math.cos(turn * (k - 9.5)), math.sin(turn * (k - 9.5))) for k in range(20)]
    _planks(b, np.cumsum([(0.0, 0.0), *steps], axis=0))
    return b.scene("bridge", lambda trajectory: [widest_gap(trajectory, 0.01)])


def taut_bridge() -> HardScene:
    """The planks level between ends 20 m apart, as in Box2D's samples: without gaps no force, however large, holds
    them up, so a bridge gets its sag, and its tension a bound, from the gaps alone."""
    b = HardSceneBuilder(floor=False)
    _planks(b, [(float(k), 0.0) for k in range(21)])
    return b.scene("taut bridge", lambda trajectory: [widest_gap(trajectory, 0.01)])


def _chain(b: HardSceneBuilder, links: int, *, fall: float = 0.0) -> int:
    """Links of 1 m in a straight line from a fixed post, `fall` rad below level; returns the last one."""
    last = b.circle(0, 0, radius=0.1, fixed=True)
    c, s = math.cos(fall), -math.sin(fall)
    for k in range(links):
        link = b.box((k + 0.5) * c, (k + 0.5) * s, height=0.25, angle=-fall)
        b.revolute(last, link, k * c, k * s)
        last = link
    return last


def hanging_chain() -> HardScene:
    """Ten links, let go at 0.5 rad from where they will hang."""
    b = HardSceneBuilder(floor=False)
    _chain(b, 10, fall=math.pi / 2 - 0.5)
    return b.scene("hanging chain", lambda trajectory: [widest_gap(trajectory, 0.01)])


def falling_chain() -> HardScene:
    """The same, let go level: its end cracks like a whip."""
    b = HardSceneBuilder(floor=False)
    _chain(b, 10)
    return b.scene("chain let go level", lambda trajectory: [widest_gap(trajectory, 0.1)])


def ball_and_chain(ratio: float) -> HardScene:
    """Eight links with a disc of `ratio` times the mass of a link (0.25 kg) at the end."""
    b = HardSceneBuilder(floor=False)
    last = _chain(b, 8)
    ball = b.circle(9, 0, radius=1.0, density=ratio * 0.25 / math.pi)
    b.revolute(last, ball, 8, 0)

    def checks(trajectory: Trajectory) -> list[Check]:
        energy = trajectory.energy(zero_at=trajectory.position[0])
        gained = (energy - energy[0]).max() / (ratio * 0.25 * 9.81 * 9)
        return [widest_gap(trajectory, 0.1), Check("energy gained, fraction of the fall", gained, 0.01)]

    return b.scene(f"ball and chain, mass ratio {ratio:g}", checks)


def stretched_chain() -> HardScene:
    """A hanging chain whose links start twice as far apart as their joints allow."""
    b = HardSceneBuilder(floor=False)
    _chain(b, 10, fall=math.pi / 2)
    scene = b.scene("stretched chain", lambda trajectory: [widest_gap(trajectory, 0.01, after=1.0)])
    return dataclasses.replace(scene, world=scene.world._replace(position=2 * scene.world.position))


# Grids, nets and beams


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
    return [
        bridge(),
        taut_bridge(),
        hanging_chain(),
        falling_chain(),
        *(ball_and_chain(ratio) for ratio in (10.0, 50.0, 150.0)),
        stretched_chain(),
        joint_grid(),
        net(),
        cantilever(),
    ]
