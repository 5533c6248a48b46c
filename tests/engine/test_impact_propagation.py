"""Rows of discs pass an impact on, as discs do that collide one after another (float64, event by event)."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.fidelity import record_worlds
from tests.engine.oracle import speeds_after_collisions

ROW = Capacity(polygons=1, circles=5, joints=5, thrusters=0)
NUM_ROWS = 32


@functools.cache
def engine(name: str, dt: float = 1 / 60, backend: str = "warp") -> Engine:
    return Engine(ROW, settings=preset(name).replace(dt=dt), backend=backend)


def row(
    seed: int,
    *,
    restitution: float,
    gap: float,
    equal: bool,
    num_hitting: int,
    mirror: int = 1,
    backwards: bool = False,
) -> tuple[BuiltWorld, list[int], np.ndarray]:
    """Discs without weight of which the first fly at the others, their shapes, and their speeds at the end [m/s]."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 6))
    radii = np.full(n, 0.2) if equal else rng.uniform(0.12, 0.3, n)
    speed, distance = rng.uniform(4, 12), rng.uniform(0.3, 0.8)
    gaps = np.where(np.arange(1, n) == num_hitting, distance, gap)
    centres = np.concatenate([[0.0], np.cumsum(radii[1:] + radii[:-1] + gaps)])
    speeds = np.where(np.arange(n) < num_hitting, speed, 0.0)
    b = SceneBuilder(ROW, gravity=(0, 0))
    shapes = [0] * n
    for i in reversed(range(n)) if backwards else range(n):
        moves = {"position": (mirror * centres[i], 0.0), "velocity": (mirror * speeds[i], 0.0)}
        shapes[i] = b.add_circle(radius=radii[i], restitution=restitution, friction=0.0, **moves)
    return b.build(), shapes, speeds_after_collisions(centres, speeds, radii**2, radii, restitution)


def speeds_at_end(name: str, rows: list[tuple[BuiltWorld, list[int], np.ndarray]], mirror: int = 1) -> list[np.ndarray]:
    records = record_worlds(engine(name), [world for world, *_ in rows], seconds=1.0)
    return [mirror * np.asarray(m.velocity)[-1, shapes, 0] for m, (_, shapes, _) in zip(records, rows)]


def errors(name: str, **options: Any) -> np.ndarray:
    """[rows] largest error of a speed, in units of the largest there is."""
    rows = [row(seed, **options) for seed in range(NUM_ROWS)]
    return np.array(
        [np.abs(v - right).max() / np.abs(right).max() for v, (*_, right) in zip(speeds_at_end(name, rows), rows)]
    )


@pytest.mark.long
@pytest.mark.also_gpu
@pytest.mark.parametrize("gap", [0.0, 5e-4, 5e-3])
@pytest.mark.parametrize("name", ["standard", "fine"])
def test_equal_elastic_discs_hand_the_whole_impact_on(name: str, gap: float):
    for num_hitting in (1, 2):
        error = errors(name, restitution=1.0, gap=gap, equal=True, num_hitting=num_hitting)
        if name == "standard":
            assert error.max() < 0.005
        assert np.quantile(error, 0.9) < 0.005


@pytest.mark.also_gpu
@pytest.mark.parametrize(("restitution", "equal"), [(0.8, True), (0.5, True), (1.0, False), (0.8, False), (0.5, False)])
def test_other_rows_leave_as_their_collisions_say(restitution: float, equal: bool):
    """Unequal discs that touch collide many times in one instant: the order of these, and with it what comes out, is
    not fixed by mechanics, so that some rows differ; and below 1 m/s nothing bounces. Taken as one body, all differ by
    a third to a half."""
    error = np.concatenate(
        [errors("standard", restitution=restitution, gap=gap, equal=equal, num_hitting=1) for gap in (0.0, 5e-4, 5e-3)]
    )
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.75) < 0.1
    assert error.max() < 0.6


@pytest.mark.also_gpu
def test_no_row_gains_energy_or_loses_momentum():
    rows = [row(seed, restitution=1.0, gap=5e-4, equal=False, num_hitting=2) for seed in range(NUM_ROWS)]
    for m in record_worlds(engine("standard"), [world for world, *_ in rows], seconds=1.0):
        energy, momentum = m.energy(), m.momentum()
        assert energy.max() < energy[0] * (1 + 1e-5)
        np.testing.assert_allclose(momentum[-1], momentum[0], atol=1e-5 * np.abs(momentum[0]).max())


def test_a_row_and_its_mirror_image_and_other_slots_leave_alike():
    options = {"restitution": 1.0, "gap": 5e-4, "equal": True, "num_hitting": 1}
    plain = speeds_at_end("standard", [row(seed, **options) for seed in range(NUM_ROWS)])
    mirrored = speeds_at_end("standard", [row(seed, mirror=-1, **options) for seed in range(NUM_ROWS)], mirror=-1)
    backwards = speeds_at_end("standard", [row(seed, backwards=True, **options) for seed in range(NUM_ROWS)])
    for one, other, third in zip(plain, mirrored, backwards):
        np.testing.assert_allclose(one, other, atol=0.05)
        np.testing.assert_allclose(one, third, atol=0.05)


@pytest.mark.also_gpu
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("name", ["standard", "fine"])
def test_a_disc_that_meets_two_alike_pushes_both_alike(name: str, backwards: bool):
    """A cue hits a ball that touches two, all of one mass and e = 1. The ball would hand on all that it has: straight
    back comes a fifth of it, and the two leave along their normals, at 30 degrees, with 2 sqrt(3) / 5."""
    radius, speed, turn = 0.1, 5.0, math.radians(20)
    along, across = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    places = [(-1.0, 0.0), (0.0, 0.0), (radius * math.sqrt(3), radius), (radius * math.sqrt(3), -radius)]
    b, discs = SceneBuilder(ROW, gravity=(0, 0)), [0] * 4
    for i in reversed(range(4)) if backwards else range(4):
        x, y = places[i]
        velocity = along * speed if i == 0 else np.zeros(2)
        discs[i] = b.add_circle(
            radius=radius,
            position=tuple(x * along + y * across),
            velocity=tuple(velocity),
            restitution=1.0,
            friction=0.0,
        )
    (m,) = record_worlds(engine(name), [b.build()], seconds=0.5)
    v = np.asarray(m.velocity)[-1, discs] / speed
    share = 2 * math.sqrt(3) / 5 * np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    right = np.array(
        [-0.2 * along, 0 * along, share[0] * along + share[1] * across, share[0] * along - share[1] * across]
    )
    np.testing.assert_allclose(v, right, atol=0.005)


@pytest.mark.slow  # test_reference.py compares levels that bounce
def test_reference_passes_impacts_on_alike():
    rows = [row(seed, restitution=1.0, gap=5e-4, equal=True, num_hitting=1) for seed in range(NUM_ROWS)]
    worlds = [world for world, *_ in rows]
    ours, theirs = (record_worlds(engine("standard", backend=name), worlds, seconds=0.25) for name in ("warp", "xla"))
    for m, other, (_, shapes, _) in zip(ours, theirs, rows):
        np.testing.assert_allclose(m.velocity[-1, shapes], other.velocity[-1, shapes], atol=0.03)


@pytest.mark.also_gpu
@pytest.mark.parametrize("num_hitting", [1, 2])
@pytest.mark.parametrize("name", ["standard", "fine"])
def test_newtons_cradle(name: str, num_hitting: int):
    """The same number of balls leaves as comes, to the height that the first came from; the others stay."""
    swing, radius = 0.5, 0.1
    for dt in (1 / 60, 1 / 120):
        for gap in (0.0, 5e-4, 2e-3):
            b = SceneBuilder(ROW)
            ceiling = b.add_box(width=5, height=0.2, position=(0, 0.1), fixed=True)
            balls = []
            for i in range(5):
                x, angle = i * (2 * radius + gap), -swing if i < num_hitting else 0.0
                at = (x + math.sin(angle), -math.cos(angle))
                balls.append(b.add_circle(radius=radius, position=at, restitution=1.0, friction=0.0))
                b.add_revolute_joint(ceiling, balls[-1], at=(x, 0))
            (m,) = record_worlds(engine(name, dt), [b.build()], seconds=1.1)
            heights = 1 - np.cos(np.asarray(m.angle)[:, balls].max(0))
            assert heights[-num_hitting:] == pytest.approx(1 - math.cos(swing), rel=0.05)
            assert heights[num_hitting:-num_hitting].max(initial=0) < 0.05 * (1 - math.cos(swing))
