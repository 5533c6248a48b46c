"""Fast bodies: nothing passes a wall, a post or a ball, from 64 positions spread over one step's motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jax2d import BuiltWorld, SceneBuilder, preset
from jax2d.fidelity import Trajectory, record_worlds
from tests.engine.worlds import CAPACITY, builder, engine

PHASES = 64  # positions within a step's motion from which a fast body meets an obstacle


def trajectories(worlds: list[BuiltWorld], seconds: float = 1.0, *, settings=preset("standard")) -> list[Trajectory]:
    return record_worlds(engine(settings), worlds, seconds=seconds)


def shots(speed: float, *, angle: float = 0.0, width: float, height: float, ball: bool, across: np.ndarray):
    """One world a phase: a fixed box at the origin, hit from the left; `across` gives where, in m, for each phase."""
    worlds = []
    for phase, y in enumerate(across):
        b = builder(gravity=(0, 0))
        b.add_box(width=width, height=height, angle=angle, fixed=True)
        start = (-3 - speed / 60 * phase / len(across), float(y))
        if ball:
            b.add_circle(radius=0.1, position=start, velocity=(speed, 0))
        else:
            b.add_box(width=0.2, height=0.2, angle=0.1 * phase, position=start, velocity=(speed, 0), angular_velocity=5)
        worlds.append(b.build())
    return worlds


@pytest.mark.also_gpu
@pytest.mark.parametrize("speed", [5.0, 10.0, 15.0, 20.0, 40.0, 60.0, 80.0, 100.0])
def test_nothing_passes_a_thin_wall(speed: float):
    across = np.linspace(0, 0.6, PHASES)
    for ball, body in ((True, CAPACITY.polygons), (False, 1)):
        for m in trajectories(shots(speed, width=0.1, height=4, ball=ball, across=across)):
            assert m.position[:, body, 0].max() < 0


def before_a_wall(phase: int) -> SceneBuilder:
    """A fixed wall from x = 0 to 0.1 m."""
    b = builder(gravity=(0, 0))
    b.add_box(width=0.1, height=4, position=(0.05, 0), fixed=True)
    return b


def struck(b: SceneBuilder, phase: int) -> int:
    """A disc of 100 m/s hits one at rest 3 to 30 cm before the wall."""
    at = -0.1 - (0.03, 0.1, 0.3)[phase % 3]
    body = b.add_circle(radius=0.1, position=(at, 0))
    b.add_circle(radius=0.1, position=(at - 1.25 - 100 / 60 * phase / PHASES, 0), velocity=(100, 0))
    return body


def struck_twice(b: SceneBuilder, phase: int) -> int:
    """A row of three discs, the first of which moves."""
    body = b.add_circle(radius=0.1, position=(-0.3, 0))
    b.add_circle(radius=0.1, position=(-0.6 - 0.2 * phase / PHASES, 0))
    b.add_circle(radius=0.1, position=(-1.5 - phase / PHASES, 0), velocity=(60, 0))
    return body


def thrust(b: SceneBuilder, phase: int) -> int:
    """A thruster of power 2 on a disc of 8 g: 44 m/s more in every step."""
    at = -0.05 - 0.03 - 0.3 * phase / PHASES
    body = b.add_circle(radius=0.05, position=(at, 0))
    b.add_thruster(body, at=(at, 0), angle=0.0, power=2.0)
    return body


def convoy(b: SceneBuilder, phase: int) -> int:
    """A convoy of two discs at 80 m/s; the first bounces back into the second."""
    b.add_circle(radius=0.1, position=(-1.2 - 80 / 60 * phase / PHASES, 0), velocity=(80, 0), restitution=1.0)
    return b.add_circle(radius=0.1, position=(-1.8 - 80 / 60 * phase / PHASES, 0), velocity=(80, 0))


@pytest.mark.also_gpu
@pytest.mark.parametrize("settings", [preset("standard"), preset("fine")], ids=["standard", "fine"])
@pytest.mark.parametrize("build", [struck, struck_twice, thrust, convoy])
def test_what_gets_its_speed_within_a_step_passes_no_wall(build, settings):
    worlds, bodies = [], []
    for phase in range(PHASES):
        b = before_a_wall(phase)
        bodies.append(build(b, phase))
        worlds.append(b.build())
    for m, body in zip(trajectories(worlds, settings=settings), bodies):
        assert m.position[:, body, 0].max() < 0
        assert m.position[:, :, 0].max() < 0.06  # the wall is at 0.05


@pytest.mark.also_gpu
def test_gravity_of_a_hundred_g_pulls_nothing_through_a_wall():
    worlds = []
    for phase in range(PHASES):
        b = builder(gravity=(1000, 0))
        b.add_box(width=0.1, height=4, position=(0.05, 0), fixed=True)
        b.add_circle(radius=0.05, position=(-0.08 - 0.5 * phase / PHASES, 0))
        worlds.append(b.build())
    for m in trajectories(worlds):
        assert m.position[:, CAPACITY.polygons, 0].max() < 0


@pytest.mark.also_gpu
@pytest.mark.parametrize(("power", "length", "width"), [(2, 2, 0.05), (3, 2, 0.1), (3, 1, 0.05)])
def test_rod_that_a_motor_starts_stops_at_a_post(power: float, length: float, width: float):
    worlds, posts = [], 0.2 + 0.4 * np.arange(PHASES) / PHASES
    for angle in posts:
        b = builder(gravity=(0, 0))
        pivot = b.add_circle(radius=0.02, fixed=True)
        bar = b.add_box(width=length, height=width)
        b.add_revolute_joint(pivot, bar, at=(0, 0), motor_speed=3.0, motor_power=power)
        at = 0.45 * length
        b.add_circle(radius=0.05, position=(at * math.cos(angle), at * math.sin(angle)), fixed=True)
        worlds.append(b.build())
    for m, angle in zip(trajectories(worlds), posts):
        assert m.angle[:, 0].max() < angle + 0.15


@pytest.mark.also_gpu
@pytest.mark.parametrize("speed", [5.0, 20.0, 60.0, 100.0])
def test_ball_that_hits_a_corner_goes_around_it(speed: float):
    ball = CAPACITY.polygons
    across = np.random.default_rng(0).permutation(np.linspace(-0.09, 0.09, PHASES))
    for m in trajectories(shots(speed, width=1, height=1, angle=math.pi / 4, ball=True, across=across)):
        assert (np.abs(m.position[:, ball]).sum(-1) > math.sqrt(0.5)).all()  # the centre stays out of the diamond
    for m in trajectories(shots(speed, width=0.1, height=4, ball=True, across=2 + across)):
        x, y = m.position[:, ball].T
        assert not ((np.abs(x) < 0.05) & (np.abs(y) < 2)).any()


def rod(phase: int, spin: float, *, density: float = 1.0) -> tuple[SceneBuilder, int]:
    """A rod of 2 m that spins about a pivot at its middle."""
    b = builder(gravity=(0, 0))
    bar = b.add_box(width=2, height=0.05, angle=2 * math.pi * phase / PHASES, angular_velocity=spin, density=density)
    pivot = b.add_circle(radius=0.02, fixed=True)
    b.add_revolute_joint(pivot, bar, at=(0, 0))
    return b, bar


@pytest.mark.also_gpu
@pytest.mark.parametrize("spin", [10.0, 30.0, 50.0])
def test_spinning_rod_stops_at_a_post(spin: float):
    worlds = []
    for phase in range(PHASES):
        b, bar = rod(phase, spin)
        b.add_circle(radius=0.1, position=(0.8 * math.cos(-0.2), 0.8 * math.sin(-0.2)), fixed=True)
        worlds.append(b.build())
    for m in trajectories(worlds):
        half_turns = (m.angle[:, bar] + 0.2) / math.pi
        assert np.floor(half_turns).max() == np.floor(half_turns[0])


@pytest.mark.also_gpu
@pytest.mark.parametrize("spin", [10.0, 30.0, 50.0])
def test_spinning_rod_strikes_a_ball_and_never_sweeps_through_it(spin: float):
    worlds = []
    for phase in range(PHASES):
        b, bar = rod(phase, spin, density=50)
        ball = b.add_circle(radius=0.05, position=(0.7 * math.cos(-0.2), 0.7 * math.sin(-0.2)))
        worlds.append(b.build())
    for m in trajectories(worlds, 0.5):
        x, y = m.position[:, ball].T
        ahead = (np.unwrap(np.arctan2(y, x)) - m.angle[:, bar]) / math.pi
        gone = np.flatnonzero(np.hypot(x, y) > 1.0)  # past the rod's end
        until = gone[0] if len(gone) else len(x)
        assert np.floor(ahead[:until]).min() == np.floor(ahead[0])


@pytest.mark.also_gpu
@pytest.mark.parametrize("spin", [10.0, 50.0])
def test_flying_rod_never_passes_a_wall(spin: float):
    worlds = []
    for phase in range(PHASES):
        b = builder(gravity=(0, 0))
        b.add_box(width=0.1, height=8, fixed=True)
        bar = b.add_box(
            width=2,
            height=0.05,
            angle=2 * math.pi * phase / PHASES,
            angular_velocity=spin,
            position=(-3, 0),
            velocity=(10, 0),
        )
        worlds.append(b.build())
    for m in trajectories(worlds):
        assert m.position[:, bar, 0].max() < 0
        assert m.speed().max() < 30  # no energy out of nothing: the rod's tips moved at up to 60 m/s
