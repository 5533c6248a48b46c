"""Energy of closed worlds, from positions and velocities in float64: no world without motors has more than it began
with, and what keeps its energy does so whatever else is in its world."""

from __future__ import annotations

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.builder_options import BodyKeywords, MaterialKeywords
from jax2d.fidelity import Trajectory, record_worlds

pytestmark = pytest.mark.also_gpu

GRAVITY = 9.81
CLOSED = Capacity(polygons=10, circles=6, joints=0, thrusters=0)
NUM_WORLDS = 64
FREE = Capacity(polygons=7, circles=3, joints=3, thrusters=2)


def half_step_energy(t: Trajectory, substep: float) -> np.ndarray:
    """[T] J, kinetic and potential, without what semi-implicit Euler adds to it as speeds change: in free fall it keeps
    m (v^2 / 2 + g y - g v h / 2), h the sub-step."""
    mass, inertia = t.masses()
    kinetic = 0.5 * (mass * (t.velocity**2).sum(-1) + inertia * t.angular_velocity**2)
    potential = mass * GRAVITY * (t.position[..., 1] - 0.5 * substep * t.velocity[..., 1])
    return (kinetic + potential).sum(-1)


def closed_box(rng: np.random.Generator, restitution: float) -> BuiltWorld:
    """Bodies of all kinds in the cells of a grid, thrown about in a box of 6 m x 6 m."""
    b = SceneBuilder(CLOSED, gravity=(0, -GRAVITY))
    options: MaterialKeywords = {"restitution": restitution, "friction": rng.choice([0.0, 0.5, 2.0])}
    for x, y in ((0, -3.5), (-3.5, 0), (3.5, 0), (0, 3.5)):
        b.add_box(width=8 if y else 1, height=8 if x else 1, position=(x, y), fixed=True, **options)
    cells = rng.permutation([(x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2)])
    for k, cell in enumerate(cells[:12]):
        moving: BodyKeywords = {
            **options,
            "position": cell,
            "angle": rng.uniform(0, 3),
            "density": 10 ** rng.uniform(-1, 1),
            "velocity": rng.uniform(-10, 10, 2),
            "angular_velocity": rng.uniform(-15, 15),
        }
        size = rng.uniform(0.2, 0.6)
        if k < 6:
            b.add_box(width=size, height=size * rng.uniform(0.3, 1), **moving)
        else:
            b.add_circle(radius=size / 2, **moving)
    return b.build()


@pytest.mark.parametrize("name", ["draft", "standard", "fine"])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_closed_world_never_has_more_energy_than_at_its_start(name: str, restitution: float):
    rng = np.random.default_rng(11)
    worlds = [closed_box(rng, restitution) for _ in range(NUM_WORLDS)]
    settings = preset(name)
    # J/kg; rounding, at kinetic energies near 30. Boxes that turn and bounce at restitution 1 gain more: of 1,024
    # worlds in 6 s 4 rise above their start, by up to 0.2 (draft), 0.04 (standard) and 0.09 (fine, 2 worlds).
    allowed = 0.3 if restitution == 1.0 else 2e-3
    for t in record_worlds(Engine(CLOSED, settings=settings), worlds, seconds=3.0):
        energy = half_step_energy(t, settings.substep_seconds)
        assert energy.max() - energy[0] < allowed * t.masses()[0].sum()


def swinging(rng: np.random.Generator, *, disc_rests_elsewhere: bool) -> BuiltWorld:
    """A pendulum of two rods, and a row of three welded boxes that spins as it flies; 30 m away a disc on a floor."""
    b = SceneBuilder(FREE, gravity=(0, -GRAVITY))
    floor = b.add_box(width=5, height=1, position=(30, -0.5), fixed=True)
    above = b.add_box(width=1, height=1, position=(0, 5.5), fixed=True)
    rods = [b.add_box(width=1, height=0.1, position=(0.5 + k, 5), density=rng.uniform(1, 3)) for k in range(2)]
    b.add_revolute_joint(above, rods[0], at=(0, 5))
    b.add_revolute_joint(rods[0], rods[1], at=(1, 5))
    b.keep_apart(above, rods[1])
    spin = rng.uniform(5, 15)
    boxes = [
        b.add_box(width=1, height=0.3, position=(x - 20, 5), velocity=(0, 20 + spin * x), angular_velocity=spin)
        for x in (0, 1)
    ]
    b.add_fixed_joint(*boxes, at=(-19.5, 5))
    disc = b.add_circle(radius=0.2, position=(30, 0.2))
    if not disc_rests_elsewhere:
        b.keep_apart(floor, disc)
    return b.build()


@pytest.mark.parametrize("name", ["draft", "standard", "fine"])
def test_what_swings_and_flies_is_not_changed_by_a_contact_elsewhere(name: str):
    # Where a world has contacts the kernel checks its energy, and solves again what has gained some: these have not.
    engine = Engine(FREE, settings=preset(name))
    runs = []
    for rests in (False, True):
        rng = np.random.default_rng(3)
        worlds = [swinging(rng, disc_rests_elsewhere=rests) for _ in range(16)]
        runs.append(record_worlds(engine, worlds, seconds=3.0))
    for alone, beside in zip(*runs, strict=True):
        resting, falling = (t.position[-1, FREE.polygons, 1] for t in (beside, alone))
        assert abs(resting - 0.2) < 1e-3 and falling < -10  # one of the two worlds has a contact
        assert np.array_equal(alone.position[:, :6], beside.position[:, :6])


ARMS = Capacity(polygons=7, circles=3, joints=5, thrusters=0)


def arm(rng: np.random.Generator, *, disc_rests_elsewhere: bool) -> BuiltWorld:
    """Five links of 1 m on a wall, let go level; hinges have limits. 30 m away a disc of 80 kg on a floor."""
    b = SceneBuilder(ARMS, gravity=(0, -GRAVITY))
    floor = b.add_box(width=5, height=1, position=(30, -0.5), fixed=True)
    links = [b.add_box(width=1, height=1, position=(0, 5), fixed=True)]
    for k in range(5):
        link = b.add_box(width=1, height=0.1, position=(0.5 + k, 4.5))
        lower, upper = rng.uniform(0.1, 1.2, 2)
        b.add_revolute_joint(links[-1], link, at=(k, 4.5), limits=(-lower, upper))
        for other in links:
            b.keep_apart(other, link)
        links.append(link)
    disc = b.add_circle(radius=0.5, position=(30, 0.5), density=100)
    if not disc_rests_elsewhere:
        b.keep_apart(floor, disc)
    return b.build()


def recorded_arms(name: str, *, disc_rests_elsewhere: bool) -> list[Trajectory]:
    rng = np.random.default_rng(3)
    worlds = [arm(rng, disc_rests_elsewhere=disc_rests_elsewhere) for _ in range(NUM_WORLDS)]
    return record_worlds(Engine(ARMS, settings=preset(name)), worlds, seconds=3.0)


@pytest.mark.parametrize("name", ["draft", "standard", "fine"])
def test_limits_of_an_arm_give_it_no_energy_whatever_else_is_in_its_world(name: str):
    # Judged by its world and beside contacts only, 0.1 to 20 J/kg in a third of these. J/kg of 0.5 kg that move.
    alone, beside = (recorded_arms(name, disc_rests_elsewhere=rests) for rests in (False, True))
    links = slice(2, 7)
    for first, second in zip(alone, beside, strict=True):
        assert np.array_equal(first.position[:, links], second.position[:, links])
        energy = half_step_energy(second, preset(name).substep_seconds)
        assert energy.max() - energy[0] < 0.3 * 0.5
