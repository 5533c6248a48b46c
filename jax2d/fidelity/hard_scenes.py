"""Scenes on which solvers fail, each with the thresholds that it must keep.

Bodies are 1 m large, of density 1 and friction coefficient 0.6 unless said otherwise. All scenes fit one capacity,
so that they run as one batch: `hard_scenes()` gives them, hard_table.py runs and judges them. Scenes with more phases
than time (tunnelling, a thousand bounces) stand in tests/engine.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.motion import Motion
from jax2d.scene import Capacity
from jax2d.settings import preset

CAPACITY = Capacity(polygons=64, circles=64, joints=112, thrusters=0)
MU = 0.6 / preset("standard").base_friction  # friction that two such bodies mix to 0.6
SLOP_M = 0.005  # Box2D's linear slop: what counts as touching

Point = Sequence[float]


class Check(NamedTuple):
    """One figure of a scene; it holds when the value is at most the limit (NaN never is)."""

    figure: str
    value: float
    limit: float

    @property
    def holds(self) -> bool:
        return self.value <= self.limit


@dataclasses.dataclass(frozen=True, kw_only=True)
class HardScene:
    name: str
    world: BuiltWorld
    judge: Callable[[Motion], list[Check]]
    seconds: float = 10.0


class Yard:
    """A scene under construction, with a floor whose top is at y = 0 of `at`."""

    def __init__(self, *, at: Point = (0.0, 0.0), gravity: float = 9.81, floor: bool = True, mu: float = MU):
        self.builder = SceneBuilder(CAPACITY, gravity=(0.0, -gravity))
        self.at = np.asarray(at, np.float64)
        self.mu = mu
        if floor:
            self.box(0, -0.5, width=200, fixed=True)

    def box(self, x: float, y: float, *, width: float = 1.0, height: float = 1.0, **options: object) -> int:
        options = {"friction": self.mu} | options
        return self.builder.add_box(width=width, height=height, position=self.place(x, y), **options)  # type: ignore[arg-type]

    def ball(self, x: float, y: float, *, radius: float = 0.5, **options: object) -> int:
        options = {"friction": self.mu} | options
        return self.builder.add_circle(radius=radius, position=self.place(x, y), **options)  # type: ignore[arg-type]

    def polygon(self, points: Sequence[Point], **options: object) -> int:
        options = {"friction": self.mu} | options
        return self.builder.add_polygon(points, position=self.place(0, 0), **options)  # type: ignore[arg-type]

    def hinge(self, a: int, b: int, x: float, y: float, **options: object) -> int:
        return self.builder.add_revolute_joint(a, b, at=self.place(x, y), **options)  # type: ignore[arg-type]

    def place(self, x: float, y: float) -> np.ndarray:
        return self.at + np.array([x, y])

    def scene(self, name: str, judge: Callable[[Motion], list[Check]], **options: object) -> HardScene:
        return HardScene(name=name, world=self.builder.build(), judge=judge, **options)  # type: ignore[arg-type]


# Piles


def single_box() -> HardScene:
    yard = Yard()
    box = yard.box(0, 1.5)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("height is wrong by, m", abs(m.position[-1, box, 1] - 0.5), 2 * SLOP_M),
            Check("moves at, m/s", m.speed()[-1], 1e-3),
        ]

    return yard.scene("single box", judge)


def stack(count: int, at: Point = (0.0, 0.0)) -> HardScene:
    yard = Yard(at=at)
    for i in range(count):
        yard.box(0, 0.5 + i)
    far = f" {max(at):g} m away" if any(at) else ""
    return yard.scene(f"stack of {count}{far}", lambda m: [Check("drifts, m", m.drift(), 0.05)])


def circle_stack() -> HardScene:
    yard = Yard()
    balls = [yard.ball(0, 0.5 + i) for i in range(10)]

    def judge(m: Motion) -> list[Check]:
        return [
            Check("leans, m", np.abs(m.position[-1, balls, 0]).max(), 1e-3),
            Check("sags, m", 9.5 - m.position[-1, balls[-1], 1], 0.03),
        ]

    return yard.scene("circle stack of 10", judge)


def pyramid(rows: int = 10, size: float = 1.0, at: Point = (0.0, 0.0)) -> HardScene:
    yard = Yard(at=at)
    for row in range(rows):
        for k in range(rows - row):
            top = yard.box((k - (rows - row - 1) / 2) * 1.1 * size, (0.5 + row) * size, width=size, height=size)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("top drops, m", m.position[0, top, 1] - m.position[-1, top, 1], 0.1 * size),
            Check("overlap, m", m.depth(), 2 * SLOP_M * size),
        ]

    small = f" of {size:g} m" if size != 1.0 else ""
    far = f" {max(at):g} m away" if any(at) else ""
    return yard.scene(f"pyramid of {rows} rows{small}{far}", judge)


def heavy_on_light(ratio: float) -> HardScene:
    yard = Yard()
    light = yard.box(0, 0.5)
    heavy = yard.box(0, 1.5, density=ratio)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("light box sinks, m", 0.5 - m.position[-1, light, 1], 0.15),
            Check("order is lost by, m", 0.8 - (m.position[-1, heavy, 1] - m.position[-1, light, 1]), 0.0),
            Check("moves at, m/s", m.speed()[-1], 0.01),
        ]

    return yard.scene(f"mass ratio {ratio:g}", judge)


def heavy_pyramid_top(ratio: float = 300.0) -> HardScene:
    """A pyramid of five rows under a block `ratio` times as heavy as each of its boxes."""
    yard = Yard()
    for row in range(5):
        for k in range(5 - row):
            top = yard.box((k - (4 - row) / 2) * 1.1, 0.5 + row)
    heavy = yard.box(0, 5.5, density=ratio)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("order is lost by, m", 0.5 - (m.position[-1, heavy, 1] - m.position[-1, top, 1]), 0.0),
            Check("top drops, m", m.position[0, top, 1] - m.position[-1, top, 1], 1.0),
        ]

    return yard.scene(f"pyramid under mass ratio {ratio:g}", judge)


def overlapping_boxes() -> HardScene:
    yard = Yard()
    for row in range(4):
        for k in range(4 - row):
            yard.box((k - (3 - row) / 2) * 0.75, 0.5 + 0.75 * row)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("fastest, m/s", m.speed().max(), 5.0),
            Check("moves after 5 s, m/s", m.speed()[m.after(5.0) :].max(), 0.05),
        ]

    return yard.scene("overlap of 25 %", judge)


def coincident_centres() -> HardScene:
    yard = Yard(gravity=0.0, floor=False)
    yard.ball(0, 0)
    yard.ball(0, 0)
    yard.box(10, 0)
    yard.box(10, 0)
    yard.box(20, 0)
    yard.ball(20, 0)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("overlap after 2 s, m", m.depth(m.after(2.0)), 2 * SLOP_M),
            Check("fastest, m/s", m.speed().max(), 5.0),
        ]

    return yard.scene("coincident centres", judge)


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
    yard = Yard()
    inner, outer = 0.25 * np.array(_ARCH_INNER), 0.25 * np.array(_ARCH_OUTER)
    mirror = np.array([-1.0, 1.0])
    for k in range(8):
        yard.polygon([inner[k], outer[k], outer[k + 1], inner[k + 1]])
        yard.polygon([inner[k + 1] * mirror, outer[k + 1] * mirror, outer[k] * mirror, inner[k] * mirror])
    keystone = yard.polygon([inner[8], outer[8], outer[8] * mirror, inner[8] * mirror])
    for k in range(4):
        yard.box(0, outer[8][1] + 0.5 + k)

    def judge(m: Motion) -> list[Check]:
        return [Check("keystone drops, m", m.position[0, keystone, 1] - m.position[-1, keystone, 1], 0.5)]

    return yard.scene("arch", judge, seconds=20.0)


def card_house() -> HardScene:
    """Box2D's house of cards: 40 cards of 2 mm by 0.4 m, friction 0.7."""
    yard = Yard(mu=MU * 0.7 / 0.6)
    height, tilt = 0.2, math.radians(25)
    start, y = 0.0, height - 0.02
    for cards in range(5, 0, -1):
        x = start
        for k in range(cards):
            if k < cards - 1:
                yard.box(x + 0.25, y + height - 0.015, width=0.002, height=2 * height, angle=math.pi / 2)
            yard.box(x, y, width=0.002, height=2 * height, angle=-tilt)
            top = yard.box(x + 0.175, y, width=0.002, height=2 * height, angle=tilt)
            x += 0.35
        y += 2 * height - 0.03
        start += 0.175

    def judge(m: Motion) -> list[Check]:
        return [Check("highest card drops, m", m.position[0, top, 1] - m.position[-1, top, 1], 0.1)]

    return yard.scene("card house", judge)


def friction_ramp(mu: float, slope: float = 0.25) -> HardScene:
    yard = Yard(floor=False, mu=MU * mu / 0.6)
    yard.box(0, 0, width=100, angle=-slope, fixed=True)
    box = yard.box(math.sin(slope), math.cos(slope), angle=-slope)
    stays = mu > math.tan(slope)
    slide = 9.81 * (math.sin(slope) - mu * math.cos(slope))

    def judge(m: Motion) -> list[Check]:
        moved = np.linalg.norm(m.position[:, box] - m.position[m.after(1.0), box], axis=-1)
        if stays:
            return [Check("creeps, m/s", moved[-1] / 9.0, 1e-3)]
        speed = np.linalg.norm(m.velocity[m.after(3.0), box])
        return [Check("speed after 3 s is wrong by a share of", abs(speed / (3 * slide) - 1), 0.02)]

    return yard.scene(f"ramp of 0.25 rad, friction {mu:g}", judge)


def squeezed_circles() -> HardScene:
    """Sixty discs, pressed to four fifths of their distance in a closed box."""
    yard = Yard(floor=False)
    for x, y, width, height in ((0, -4.5, 12, 1), (0, 4.5, 12, 1), (-4.5, 0, 1, 12), (4.5, 0, 1, 12)):
        yard.box(x, y, width=width, height=height, fixed=True)
    for i in range(60):
        yard.ball(-3.2 + 0.8 * (i % 9), -3.2 + 0.8 * (i // 9))

    def judge(m: Motion) -> list[Check]:
        inside = np.abs(m.position[:, m.movable]).max()
        early, late = m.kinetic_energy()[: m.after(1.0)].max(), m.kinetic_energy()[m.after(5.0) :].max()
        return [
            Check("farthest centre, m", inside, 4.0),
            Check("kinetic energy after 5 s to that of the first second", late / early, 0.05),
        ]

    return yard.scene("squeezed circles", judge)


def tiled_floor(disc: bool) -> HardScene:
    """A box or a disc slides without friction over a floor of tiles: inner edges must not trip it."""
    yard = Yard(floor=False, mu=0.0)
    for k in range(60):
        yard.box(k, -0.5, fixed=True)
    body = yard.ball(0, 0.5, velocity=(5.0, 0.0)) if disc else yard.box(0, 0.5, velocity=(5.0, 0.0))

    def judge(m: Motion) -> list[Check]:
        return [
            Check("vertical speed, m/s", np.abs(m.velocity[:, body, 1]).max(), 0.05),
            Check("loses speed, m/s", 5.0 - m.velocity[-1, body, 0], 0.05),
        ]

    return yard.scene(f"{'disc' if disc else 'box'} over a tiled floor", judge)


def huge_ground() -> HardScene:
    yard = Yard(floor=False)
    yard.box(0, -0.5, width=1e4, fixed=True)
    for x in (0.3, 4000.3):
        for k in range(5):
            yard.box(x, 0.5 + k)
    return yard.scene("ground of 10 km", lambda m: [Check("drifts, m", m.drift(), 0.05)])


def thin_shapes() -> HardScene:
    """A triangle of 1 m by 1 mm, a disc of 1 mm and a needle fall on a floor."""
    yard = Yard()
    yard.builder.add_polygon([(0, 0), (1, 0), (0.5, 1e-3)], position=(0, 1), friction=MU)
    yard.builder.add_polygon([(0, 0), (1e-3, 0), (0, 1)], position=(3, 1), friction=MU)
    yard.ball(6, 1, radius=1e-3)
    yard.box(9, 1, width=1, height=1e-3)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("lowest centre, m below the floor", -m.position[:, m.movable, 1].min(), SLOP_M),
            Check("moves at, m/s", m.speed()[-1], 0.05),
        ]

    return yard.scene("thin and tiny shapes", judge)


# Joints


def _gap(m: Motion, limit: float, after: float = 0.0) -> Check:
    return Check("joint gap, m", m.gaps()[m.after(after) :].max(), limit)


def _planks(yard: Yard, corners: Sequence[Point]) -> None:
    """Planks of 1 m from corner to corner, hinged to each other and to a fixed block at either end."""
    last = yard.box(corners[0][0] - 0.5, corners[0][1], height=0.25, fixed=True)
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        plank = yard.box((x0 + x1) / 2, (y0 + y1) / 2, height=0.25, angle=math.atan2(y1 - y0, x1 - x0))
        yard.hinge(last, plank, x0, y0)
        last = plank
    end = yard.box(corners[-1][0] + 0.5, corners[-1][1], height=0.25, fixed=True)
    yard.hinge(last, end, *corners[-1])


def bridge() -> HardScene:
    """Twenty planks that hang in an arc between ends 19 m apart."""
    yard = Yard(floor=False)
    turn = 0.0553  # rad from plank to plank, with which twenty chords of 1 m span 19 m
    steps = [(math.cos(turn * (k - 9.5)), math.sin(turn * (k - 9.5))) for k in range(20)]
    _planks(yard, np.cumsum([(0.0, 0.0), *steps], axis=0))
    return yard.scene("bridge", lambda m: [_gap(m, 0.01)])


def taut_bridge() -> HardScene:
    """The planks level between ends 20 m apart, as in Box2D's samples: without gaps no force, however large, holds
    them up, so a bridge gets its sag, and its tension a bound, from the gaps alone."""
    yard = Yard(floor=False)
    _planks(yard, [(float(k), 0.0) for k in range(21)])
    return yard.scene("taut bridge", lambda m: [_gap(m, 0.01)])


def _chain(yard: Yard, links: int, *, fall: float = 0.0) -> int:
    """Links of 1 m in a straight line from a fixed post, `fall` rad below level; returns the last one."""
    last = yard.ball(0, 0, radius=0.1, fixed=True)
    c, s = math.cos(fall), -math.sin(fall)
    for k in range(links):
        link = yard.box((k + 0.5) * c, (k + 0.5) * s, height=0.25, angle=-fall)
        yard.hinge(last, link, k * c, k * s)
        last = link
    return last


def hanging_chain() -> HardScene:
    """Ten links, let go at 0.5 rad from where they will hang."""
    yard = Yard(floor=False)
    _chain(yard, 10, fall=math.pi / 2 - 0.5)
    return yard.scene("hanging chain", lambda m: [_gap(m, 0.01)])


def falling_chain() -> HardScene:
    """The same, let go level: its end cracks like a whip."""
    yard = Yard(floor=False)
    _chain(yard, 10)
    return yard.scene("chain let go level", lambda m: [_gap(m, 0.1)])


def ball_and_chain(ratio: float) -> HardScene:
    """Eight links with a disc of `ratio` times the mass of a link (0.25 kg) at the end."""
    yard = Yard(floor=False)
    last = _chain(yard, 8)
    ball = yard.ball(9, 0, radius=1.0, density=ratio * 0.25 / math.pi)
    yard.hinge(last, ball, 8, 0)

    def judge(m: Motion) -> list[Check]:
        gained = (m.energy() - m.energy()[0]).max() / (ratio * 0.25 * 9.81 * 9)
        return [_gap(m, 0.1), Check("energy gained, share of the fall", gained, 0.01)]

    return yard.scene(f"ball and chain, mass ratio {ratio:g}", judge)


def stretched_chain() -> HardScene:
    """A hanging chain whose links start twice as far apart as their joints allow."""
    yard = Yard(floor=False)
    _chain(yard, 10, fall=math.pi / 2)
    scene = yard.scene("stretched chain", lambda m: [_gap(m, 0.01, after=1.0)])
    return dataclasses.replace(scene, world=scene.world._replace(position=2 * scene.world.position))


def joint_grid(held: bool = True) -> HardScene:
    """Eight by seven discs of 0.4 m, each joined to its neighbours 1 m away; the top row is held at its ends."""
    yard = Yard(floor=False)
    columns, rows = 8, 7
    balls = [
        [yard.ball(x, -y, radius=0.4, fixed=y == 0 and x in (0, columns - 1)) for x in range(columns)]
        for y in range(rows)
    ]
    for y in range(rows):
        for x in range(columns):
            if x:
                yard.hinge(balls[y][x - 1], balls[y][x], x - 0.5, -y)
            if y:
                yard.hinge(balls[y - 1][x], balls[y][x], x, -y + 0.5)

    def judge(m: Motion) -> list[Check]:
        speed = m.speed()
        return [
            _gap(m, 0.05),
            Check("fastest in the last second, m/s", speed[m.after(m.time[-1] - 1) :].max(), 0.1),
        ]

    return yard.scene("joint grid", judge)


def net() -> HardScene:
    """A net of bilateral joints with loops everywhere, pulled out of shape, for a minute."""
    yard = Yard(floor=False)
    columns, rows = 8, 6
    balls = [[yard.ball(x, -y, radius=0.3, fixed=y == 0) for x in range(columns)] for y in range(rows)]
    for y in range(1, rows):
        for x in range(columns):
            if x:
                yard.hinge(balls[y][x - 1], balls[y][x], x - 0.3, -y + 0.2)
            yard.hinge(balls[y - 1][x], balls[y][x], x + 0.1, -y + 0.5)

    def judge(m: Motion) -> list[Check]:
        return [Check("fastest, m/s", m.speed().max(), 20.0), Check("energy gained, J", m.energy().max(), 0.1)]

    return yard.scene("net of joints", judge, seconds=60.0)


def four_bar() -> HardScene:
    """A crank of 0.4 m drives a rocker of 1 m through a coupler of 1.2 m; frame 1.1 m."""
    yard = Yard(floor=False)
    frame = yard.box(0.55, -1, width=2, height=0.2, fixed=True)
    crank_end = np.array([0.0, 0.4])
    # Where the coupler meets the rocker: 1.2 m from the crank's end, 1 m from (1.1, 0).
    along = np.array([1.1, 0.0]) - crank_end
    distance = float(np.hypot(*along))
    share = (1.2**2 - 1.0**2 + distance**2) / (2 * distance)
    meet = (
        crank_end + share * along / distance + math.sqrt(1.2**2 - share**2) * np.array([-along[1], along[0]]) / distance
    )

    def bar(a: Point, b: Point) -> int:
        a, b = np.asarray(a), np.asarray(b)
        run = b - a
        middle = (a + b) / 2
        return yard.box(*middle, width=float(np.hypot(*run)), height=0.1, angle=math.atan2(run[1], run[0]))

    crank, coupler, rocker = bar((0, 0), crank_end), bar(crank_end, meet), bar((1.1, 0), meet)
    yard.hinge(frame, crank, 0, 0, motor_speed=0.5, motor_power=20.0)
    yard.hinge(crank, coupler, *crank_end)
    yard.hinge(coupler, rocker, *meet)
    yard.hinge(frame, rocker, 1.1, 0)
    bars = (frame, crank, coupler, rocker)
    for one in range(4):
        for other in range(one):
            yard.builder.keep_apart(bars[one], bars[other])

    def judge(m: Motion) -> list[Check]:
        late = m.angular_velocity[m.after(1.0) :, crank]
        return [_gap(m, 0.004), Check("motor speed is wrong by a share of", np.abs(late / 3.0 - 1).max(), 0.02)]

    return yard.scene("four-bar linkage", judge)


def cart() -> HardScene:
    """A cart on two driven wheels, on level ground."""
    yard = Yard()
    body = yard.box(0, 0.6, width=2, height=0.4)
    wheels = []
    for x in (-0.8, 0.8):
        wheels.append(yard.ball(x, 0.4, radius=0.4))
        yard.hinge(body, wheels[-1], x, 0.4, motor_speed=-1.0, motor_power=0.3)

    def judge(m: Motion) -> list[Check]:
        turning = m.angular_velocity[:, wheels] - m.angular_velocity[:, [body]]
        late = turning[m.after(5.0) :]
        return [_gap(m, 0.01), Check("motor speed is wrong by a share of", np.abs(late / -6.0 - 1).max(), 0.02)]

    return yard.scene("cart", judge)


def strong_wheel() -> HardScene:
    """The same cart with its motors a hundred times as strong: it may spin its wheels, not jump."""
    yard = Yard()
    body = yard.box(0, 0.6, width=2, height=0.4)
    for x in (-0.8, 0.8):
        wheel = yard.ball(x, 0.4, radius=0.4)
        yard.hinge(body, wheel, x, 0.4, motor_speed=-2.0, motor_power=30.0)

    def judge(m: Motion) -> list[Check]:
        return [
            Check("rises, m", m.position[:, m.movable, 1].max() - 0.6, 0.5),
            Check("vertical speed, m/s", np.abs(m.velocity[:, m.movable, 1]).max(), 3.0),
        ]

    return yard.scene("strong wheels", judge)


def cantilever() -> HardScene:
    """Eight bars welded in a row to a wall."""
    yard = Yard(floor=False)
    last = yard.box(-0.5, 0, fixed=True)
    for k in range(8):
        bar = yard.box(k + 0.5, 0, height=0.25)
        yard.builder.add_fixed_joint(last, bar, at=yard.place(k, 0))
        last = bar

    def judge(m: Motion) -> list[Check]:
        early, late = m.speed()[: m.after(1.0)].max(), m.speed()[m.after(9.0) :].max()
        return [
            Check("speed of the last second to the first", late / early, 0.5),
            _gap(m, 0.05),
        ]

    return yard.scene("cantilever of 8 welds", judge)


def motor_against_limit(power: float, limits: tuple[float, float]) -> HardScene:
    yard = Yard(floor=False)
    base = yard.box(0, 0, fixed=True)
    arm = yard.box(0.9, 0, height=0.2)
    yard.hinge(base, arm, 0.5, 0, motor_speed=2.0, motor_power=power, limits=limits)

    def judge(m: Motion) -> list[Check]:
        over = math.degrees(m.angle[:, arm].max() - limits[1])
        short = math.degrees(limits[1] - m.angle[-1, arm])
        return [Check("overshoots, degrees", over, 1.0), Check("stays short of, degrees", short, 1.0)]

    return yard.scene(f"motor of power {power:g} against a limit of {limits[1]:g} rad", judge)


def motor_settles(power: float) -> HardScene:
    """An arm held off its centre, no gravity: at speed within 1 %, and steady there."""
    yard = Yard(gravity=0.0, floor=False)
    post = yard.ball(0, 0, radius=0.1, fixed=True)
    arm = yard.box(0.4, 0, height=0.2)
    tip = yard.box(1.4, 0, height=0.2)
    yard.hinge(post, arm, 0, 0, motor_speed=1.0, motor_power=power)
    yard.builder.add_fixed_joint(arm, tip, at=yard.place(0.9, 0))

    def judge(m: Motion) -> list[Check]:
        late = m.angular_velocity[m.after(8.0) :, arm]
        return [
            Check("speed is wrong by a share of", np.abs(late / 6.0 - 1).max(), 0.01),
            Check("speed alternates by, rad/s", np.abs(np.diff(late)).max(), 0.02),
        ]

    return yard.scene(f"motor of power {power:g}", judge)


def hard_scenes() -> list[HardScene]:
    """All of them, in the order of the published table."""
    return [
        single_box(),
        *(stack(count) for count in (5, 10, 15)),
        circle_stack(),
        pyramid(),
        *(heavy_on_light(ratio) for ratio in (10.0, 100.0, 400.0)),
        heavy_pyramid_top(),
        overlapping_boxes(),
        coincident_centres(),
        arch(),
        card_house(),
        *(friction_ramp(mu) for mu in (0.2, 0.3)),
        squeezed_circles(),
        *(tiled_floor(disc) for disc in (False, True)),
        huge_ground(),
        thin_shapes(),
        pyramid(rows=5, size=0.05),
        *(stack(count, at=(far, far)) for far in (1e3, 1e4) for count in (5, 10, 15)),
        *(pyramid(at=(far, far)) for far in (1e3, 1e4)),
        bridge(),
        taut_bridge(),
        hanging_chain(),
        falling_chain(),
        *(ball_and_chain(ratio) for ratio in (10.0, 50.0, 150.0)),
        stretched_chain(),
        joint_grid(),
        net(),
        four_bar(),
        cart(),
        strong_wheel(),
        cantilever(),
        *(
            motor_against_limit(power, limits)
            for power in (1.0, 30.0)
            for limits in ((-0.5, 1.0), (-4.0, 4.5), (-1.0, 7.5))
        ),
        *(motor_settles(power) for power in (0.05, 1.0, 4.0, 30.0, 1000.0)),
    ]
