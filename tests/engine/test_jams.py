"""Bodies that start deep inside fixed things, held there by friction: when they slip free they are not thrown."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset, stack_worlds
from jax2d.fidelity import record_worlds

pytestmark = pytest.mark.also_gpu

CAPACITY = Capacity(polygons=3, circles=3, joints=1, thrusters=0)
NUM_WORLDS = 64
SECONDS = 1.5


@functools.cache
def jams(num_worlds: int = NUM_WORLDS, *, beside: float = 0.0) -> list[BuiltWorld]:
    """A disc deep in a wall and in a fixed disc beside it, hinged at its centre to a box that lies on the latter.
    Nothing moves and nothing pulls: all that they get is from being pushed out of what they overlap. `beside`: m/s, of
    a disc of 300 kg that flies 50 m away, if there is one."""
    rng, worlds = np.random.default_rng(7), []
    for _ in range(num_worlds):
        b = SceneBuilder(CAPACITY, gravity=(0, 0))
        b.add_box(width=5.0, height=10.0, position=(2.5, 0), friction=1.0, fixed=True)
        radius, fixed_radius = rng.uniform(0.25, 0.4), rng.uniform(0.2, 0.4)
        centre = np.array([rng.uniform(0.4, 0.8) - radius, 0])
        away = np.pi + rng.uniform(-1.2, 1.2)
        gap = radius + fixed_radius - rng.uniform(0.02, 0.2)
        fixed_at = centre + gap * np.array([np.cos(away), np.sin(away)])
        b.add_circle(radius=fixed_radius, position=fixed_at, friction=1.0, fixed=True)
        disc = b.add_circle(radius=radius, position=centre, friction=1.0)
        box = b.add_box(
            width=rng.uniform(0.3, 0.8),
            height=rng.uniform(0.3, 0.8),
            position=centre + rng.uniform(-0.4, 0.4, 2),
            angle=rng.uniform(0, 3),
            friction=1.0,
        )
        b.add_revolute_joint(box, disc, at=tuple(centre))
        if beside:
            b.add_circle(radius=1.0, position=(50, 0), velocity=(0, beside), density=100)
        worlds.append(b.build())
    return worlds


def most_energy(settings: str, backend: str = "warp", num_worlds: int = NUM_WORLDS) -> np.ndarray:
    """[W] J/kg, the most kinetic energy that a world had."""
    worlds = jams(num_worlds)
    engine = Engine(CAPACITY, settings=preset(settings), backend=backend)
    most = []
    for world, t in zip(worlds, record_worlds(engine, worlds, seconds=SECONDS), strict=True):
        inverses = np.asarray(world.scene.shapes.inverse_mass), np.asarray(world.scene.shapes.inverse_inertia)
        mass, inertia = (np.divide(1, x, where=x > 0, out=np.zeros_like(x)) for x in inverses)
        energy = 0.5 * (mass * (t.velocity**2).sum(-1) + inertia * t.angular_velocity**2).sum(-1)
        most.append(energy.max() / mass.sum())
    return np.array(most)


@pytest.mark.long
@pytest.mark.parametrize(
    ("settings", "backend"),
    [
        ("standard", "warp"),
        ("draft", "warp"),
        ("fine", "warp"),
        pytest.param("standard", "xla", marks=pytest.mark.slow),
    ],
)
def test_what_slips_free_is_not_thrown(settings: str, backend: str) -> None:
    # J/kg. Without relax passes that are repeated where energy is gained: 370, more than 10 in half of these worlds.
    # How a jam comes free hangs on the last bit, so that another processor draws other numbers from one distribution:
    # of 512 worlds the last reaches 0.51, 0.50, 0.28 (draft, standard, fine).
    energy = most_energy(settings, backend)
    assert np.percentile(energy, 95) < 0.5 and energy.max() < 1.5


CORNER = Capacity(polygons=5, circles=1, joints=3, thrusters=0)
# Of the hinges of `arm_in_a_corner`, two steps each.
DRIVEN = [(0, 1, 0), (-1, 0, -1), (0, 1, 0), (-1, -1, -1), (0, 0, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0)]


def arm_in_a_corner() -> BuiltWorld:
    """Two links and a wheel, driven, that run into the corner of floor and wall at 6 m/s. The soak found it."""
    b = SceneBuilder(CORNER)
    b.add_box(width=5, height=10.4, position=(2.5, -4.8), friction=1.0, fixed=True)
    b.add_box(width=5, height=5, position=(-2.5, 2.5), friction=1.0, fixed=True)

    def box(width: float, height: float, x: float, y: float, angle: float, **motion: Any) -> int:
        options = motion | {"friction": 1.0, "category": 2, "mask": 1}  # parts do not touch each other
        return b.add_box(width=width, height=height, position=(x, y), angle=angle, **options)

    held = box(0.538, 0.196, 0.41233, 1.11577, 5.8273, fixed=True)
    upper = box(0.53282, 0.61389, 0.585106, 0.820872, 0.493512, velocity=(0.74832, -0.20031), angular_velocity=3.12083)
    lower = box(0.28223, 0.67147, 0.790997, 0.571631, 1.639713, velocity=(1.6362, 0.05502), angular_velocity=1.56983)
    at_hand = (0.994132, 0.700377)
    hand = b.add_circle(
        radius=0.245855,
        position=at_hand,
        velocity=(1.43481, 0.37458),
        angular_velocity=6.35686,
        friction=1.0,
        category=2,
        mask=1,
    )
    b.add_revolute_joint(held, upper, at=(0.647741, 1.061151), motor_speed=2.38752, motor_power=2.1065)
    b.add_revolute_joint(upper, lower, at=(0.545261, 0.500614), motor_speed=1.87492, motor_power=1.38088)
    b.add_revolute_joint(lower, hand, at=at_hand, motor_speed=0.79784)
    return b.build()


@pytest.mark.parametrize("backend", ["warp", "xla"])
def test_an_arm_that_jams_in_a_corner_is_not_thrown(backend: str) -> None:
    """Friction in the corner asks for more impulse with each pass: before energy had a bound each of these worlds got
    5,057 J/kg. Gravity and motors give 18."""
    world, count = arm_in_a_corner(), 64
    scene = stack_worlds([world.scene] * count)
    engine = Engine(CORNER, settings=preset("standard"), backend=backend)
    start = stack_worlds([engine.initial_state(*world)] * count)
    rng, moves = np.random.default_rng(0), (scene.shapes.inverse_mass > 0)[..., None]
    state = dataclasses.replace(
        start, velocity=start.velocity + moves * rng.normal(0, 1e-4, start.velocity.shape).astype(np.float32)
    )
    inverses = scene.shapes.inverse_mass, scene.shapes.inverse_inertia
    mass, inertia = (np.divide(1, x, where=x > 0, out=np.zeros_like(x)) for x in inverses)
    most = np.zeros(count)
    for driven in DRIVEN:
        controls = dataclasses.replace(
            engine.no_controls(count), motor=np.tile(np.array(driven, np.float32), (count, 1))
        )
        for _ in range(2):
            state, _ = engine.step(scene, state, controls)
            v, w = np.asarray(state.velocity), np.asarray(state.angular_velocity)
            most = np.maximum(most, 0.5 * (mass * (v**2).sum(-1) + inertia * w**2).sum(-1) / mass.sum(-1))
    assert most.min() > 5 and most.max() < 25


def test_a_heavy_body_elsewhere_hides_no_jam() -> None:
    engine = Engine(CAPACITY, settings=preset("standard"))
    alone, beside = (record_worlds(engine, jams(beside=speed), seconds=SECONDS) for speed in (0.0, 30.0))
    jammed = [2, 4]  # the box and the disc
    for first, second in zip(alone, beside, strict=True):
        assert second.position[-1, 5, 1] > 40  # it has flown
        np.testing.assert_array_equal(first.position[:, jammed], second.position[:, jammed])
