"""Discs against discs: without friction nothing turns one, wherever in a step they meet, and spin sinks none."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.fidelity import record_worlds

CAPACITY = Capacity(polygons=1, circles=4, joints=0, thrusters=0)
HIT, SHOT = CAPACITY.polygons, CAPACITY.polygons + 1
PHASES = 32  # of a step in which they meet
RADIUS = 0.1


@functools.cache
def engine(name: str) -> Engine:
    return Engine(CAPACITY, settings=dataclasses.replace(preset(name), restitution_threshold=0.0))


def shots(
    speed: float,
    offset: float,
    restitution: float,
    fixed: bool,
    radius: float = RADIUS,
    phases: int = PHASES,
    capacity: Capacity = CAPACITY,
) -> list[BuiltWorld]:
    """A disc flies past the centre of another by a share `offset` of both radii."""
    worlds = []
    for phase in range(phases):
        b = SceneBuilder(capacity, gravity=(0, 0))
        surface = {"restitution": restitution, "friction": 0.0}
        b.add_circle(radius=radius, position=(0, 0), fixed=fixed, **surface)  # type: ignore[arg-type]
        start = (-0.2 - RADIUS - radius - speed / 60 * phase / phases, offset * (RADIUS + radius))
        b.add_circle(radius=RADIUS, position=start, velocity=(speed, 0), **surface)  # type: ignore[arg-type]
        worlds.append(b.build())
    return worlds


def after(speed: float, offset: float, restitution: float, share: float) -> np.ndarray:
    """[2] m/s of the shot, by the impulse along the line of centres; `share`: of what is hit in the mass of both."""
    normal, velocity = np.array([-math.sqrt(1 - offset**2), offset]), np.array([speed, 0.0])
    return velocity - (1 + restitution) * share * (velocity @ normal) * normal


@pytest.mark.also_gpu
@pytest.mark.parametrize("speed", [2.0, 5.0, 20.0])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_disc_leaves_a_fixed_one_by_the_law_of_impact_and_without_spin(speed: float, restitution: float):
    """A disc at 5 m/s left with 12 to 50 rad/s and three quarters of its speed when impulses were not central."""
    offsets = (0.2, 0.5, 0.8)
    worlds = [world for offset in offsets for world in shots(speed, offset, restitution, fixed=True)]
    trajectories = record_worlds(engine("standard"), worlds, seconds=0.3 + 0.5 / speed)
    for offset, t in zip(np.repeat(offsets, PHASES), trajectories, strict=True):
        assert np.abs(t.angular_velocity[:, SHOT]).max() < 1e-3
        error = np.linalg.norm(t.velocity[-1, SHOT] - after(speed, offset, restitution, 1.0)) / speed
        # Without bounce it goes along the plane on which they meet, which is that of where it is a sub-step before.
        assert error < (0.001 if restitution else 0.02 * speed)


@pytest.mark.also_gpu
@pytest.mark.parametrize(("name", "spin", "error"), [("standard", 1.2, 0.01), ("fine", 0.5, 0.002)])
@pytest.mark.parametrize("radius", [0.1, 0.2])
def test_discs_that_move_leave_each_other_nearly_so(name: str, spin: float, error: float, radius: float):
    """An impulse acts at one point of both (momentum), and they are a part of a sub-step from where they meet: what is
    left of spin, per m/s, was 5 and 4. `error`: of the speed."""
    for speed, offset, restitution in ((2.0, 0.7, 1.0), (5.0, 0.7, 1.0), (5.0, 0.3, 0.5)):
        share = radius**2 / (radius**2 + RADIUS**2)
        worlds = shots(speed, offset, restitution, fixed=False, radius=radius)
        for t in record_worlds(engine(name), worlds, seconds=0.3 + 0.5 / speed):
            assert np.abs(t.angular_velocity[-1, SHOT]) < spin * speed
            assert np.linalg.norm(t.velocity[-1, SHOT] - after(speed, offset, restitution, share)) < error * speed


def spinning_between_two(capacity: Capacity = CAPACITY) -> tuple[list[BuiltWorld], float]:
    """(worlds in which the third disc spins on two that are fixed, its height m)"""
    height, worlds = math.sqrt(0.3**2 - 0.15**2), []
    for spin in (0.0, 10.0, 45.0):
        b = SceneBuilder(capacity)
        for x in (-0.15, 0.15):
            b.add_circle(radius=0.2, position=(x, 0), fixed=True, friction=0.0)
        b.add_circle(radius=RADIUS, position=(0, height), angular_velocity=spin, friction=0.0)
        worlds.append(b.build())
    return worlds, height


@pytest.mark.also_gpu
def test_a_disc_that_spins_between_two_others_stays_where_it_is():
    """Their points of contact turned with it, within each step: at 45 rad/s it sank by 5 mm."""
    worlds, height = spinning_between_two()
    for t in record_worlds(engine("standard"), worlds, seconds=1.0):
        assert np.abs(t.position[:, HIT + 2, 1] - height).max() < 1e-4


@pytest.mark.also_gpu
def test_discs_that_bounce_in_a_box_keep_their_energy():
    """Four elastic discs for 5 s: spin that they have no right to would be energy, and takes it away at its limit."""
    capacity = Capacity(polygons=4, circles=4, joints=0, thrusters=0)
    settings = dataclasses.replace(preset("fine"), restitution_threshold=0.0)
    rng, worlds = np.random.default_rng(3), []
    for _ in range(8):
        b = SceneBuilder(capacity, gravity=(0, 0))
        smooth = {"restitution": 1.0, "friction": 0.0}
        for k in range(4):
            turn = k * math.pi / 2
            at = (1.5 * math.cos(turn), 1.5 * math.sin(turn))
            b.add_box(width=1, height=4, position=at, angle=turn, fixed=True, **smooth)  # type: ignore[arg-type]
        for k in range(4):
            at = (0.45 * (-1) ** k, 0.45 * (-1) ** (k // 2))
            b.add_circle(radius=0.15, position=at, velocity=tuple(rng.uniform(-2, 2, 2)), **smooth)  # type: ignore[arg-type]
        worlds.append(b.build())
    for t in record_worlds(Engine(capacity, settings=settings), worlds, seconds=5.0):
        energy = t.energy()
        assert energy[-1] == pytest.approx(energy[0], rel=0.1)
        assert t.limited is None or t.limited.sum() == 0
