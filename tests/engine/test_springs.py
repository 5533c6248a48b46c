"""Springs, dampers, ropes and rods: motions with a formula, energy, what is refused."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import Any

import jax
import numpy as np
import pytest

from jax2d import (
    BuiltWorld,
    Capacity,
    Engine,
    MissingEffectError,
    SceneBuilder,
    SceneError,
    SceneFullError,
    effects_of,
    preset,
    touch_matrix,
)
from jax2d.draw import draw
from jax2d.effects import Effects
from jax2d.fidelity import Trajectory, record
from jax2d.palette import BACKGROUND
from jax2d.warp.layout import Layout

CAPACITY = Capacity(polygons=2, circles=6, joints=1, thrusters=0, springs=6)
FEW = Capacity(polygons=1, circles=4, joints=0, thrusters=0, springs=2)
G = 9.81
STANDARD = preset("standard")
DISC = 1 / (math.pi * 0.1**2)  # kg/m^2, of a disc of 0.1 m that has 1 kg


@functools.cache
def engine(dt: float = STANDARD.dt) -> Engine:
    return Engine(CAPACITY, settings=STANDARD.replace(dt=dt))


def motion(b: SceneBuilder, seconds: float, dt: float = STANDARD.dt) -> Trajectory:
    world, one = b.build(), engine(dt)
    return record(one, world.scene, one.initial_state(*world), num_samples=round(seconds / dt))[0]


def hung(gravity: float = G, at: tuple[float, float] = (0, -1), **spring: Any) -> tuple[SceneBuilder, int]:
    """A disc of 1 kg that hangs from the origin by a spring of 1 m."""
    b = SceneBuilder(CAPACITY, gravity=(0, -gravity))
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    disc = b.add_circle(radius=0.1, position=at, density=DISC)
    b.add_spring(base, disc, at_a=(0, 0), at_b=at, **({"rest_length": 1.0} | spring))
    return b, disc


def period(x: np.ndarray, interval: float) -> float:
    """s, from its zero crossings, between samples by straight lines."""
    k = np.flatnonzero((x[1:] > 0) != (x[:-1] > 0))
    return float(2 * np.diff(k + x[k] / (x[k] - x[k + 1])).mean() * interval)


def midway_energy(m: Trajectory, substep: float = STANDARD.substep_seconds) -> np.ndarray:
    """J, with velocities half a sub-step later: semi-implicit Euler keeps it in free flight, to rounding."""
    velocity = m.velocity.copy()
    velocity[..., 1] -= np.where(np.asarray(m.scene.shapes.inverse_mass) > 0, G * substep / 2, 0)
    return dataclasses.replace(m, velocity=velocity).energy()


# Formulas


@pytest.mark.parametrize("stiffness", [4.0, 40.0, 400.0])
def test_spring_swings_with_its_period_about_its_sag_and_keeps_its_energy(stiffness: float):
    b, disc = hung(stiffness=stiffness)
    m = motion(b, 10.0)
    sag, y = G / stiffness, m.position[:, disc, 1] + 1
    assert period(y + sag, m.interval) == pytest.approx(2 * math.pi / math.sqrt(stiffness), rel=0.002)
    swing = np.abs(y + sag)
    assert swing[-120:].max() == pytest.approx(sag, rel=0.05)
    # Semi-implicit Euler moves energy to and fro by a share of omega h / 2.
    assert m.energy().max() < m.energy()[0] + G * sag * (0.01 + math.sqrt(stiffness) * STANDARD.substep_seconds)


def test_damped_spring_decays_and_rests_at_its_sag():
    """x = A exp(-c t / 2 m) cos(sqrt(k/m - (c/2m)^2) t)."""
    b, disc = hung(stiffness=60.0, damping=1.2)
    m = motion(b, 20.0)
    y, t = m.position[:, disc, 1] + 1 + G / 60, m.time
    # At rest at t = 0: the phase is that of the decay.
    omega = math.sqrt(60 - 0.36)
    exact = G / 60 * np.exp(-0.6 * t) * (np.cos(omega * t) + 0.6 / omega * np.sin(omega * t))
    np.testing.assert_allclose(y[:300], exact[:300], atol=0.01)
    assert y[-1] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("dt", [1 / 30, 1 / 60])
def test_damper_alone_slows_down_exponentially(dt: float):
    b, disc = hung(gravity=0.0, damping=2.0)
    world = b.build()
    velocity = world.velocity.copy()
    velocity[disc] = (0, -1)
    one = engine(dt)
    m, _ = record(one, world.scene, one.initial_state(*world[:3], velocity), num_samples=round(1 / dt))
    assert m.velocity[-1, disc, 1] == pytest.approx(-math.exp(-2), rel=0.05)


@pytest.mark.parametrize("what", ["rod", "rope"])
def test_pendulum_of_a_rod_or_a_rope_has_its_period(what: str):
    """T = 2 pi sqrt(l/g) / AGM(1, cos(theta / 2)), the disc not turning."""
    b = SceneBuilder(CAPACITY)
    base, at = b.add_box(width=0.2, height=0.2, fixed=True), (math.sin(0.8), -math.cos(0.8))
    disc = b.add_circle(radius=0.1, position=at, density=DISC)
    getattr(b, f"add_{what}")(base, disc, at_a=(0, 0), at_b=at)
    m = motion(b, 20.0)
    x, y = 1.0, math.cos(0.4)
    for _ in range(10):
        x, y = (x + y) / 2, math.sqrt(x * y)
    assert period(m.position[:, disc, 0], m.interval) == pytest.approx(2 * math.pi / math.sqrt(G) / x, rel=0.002)
    assert np.abs(m.spring_lengths()[:, 0] - 1).max() < 1e-3
    assert m.energy().max() < m.energy()[0] + 0.02  # of 3 J; semi-implicit Euler moves as much to and fro


def test_rope_is_slack_below_its_length_and_a_stop_holds_above_its_own():
    b, disc = hung(at=(0, -0.5), max_length=1.0)
    m = motion(b, 3.0)
    fall = m.position[:, disc, 1]
    np.testing.assert_allclose(fall[:19], -0.5 - G / 2 * m.time[:19] ** 2, atol=0.02)
    assert fall[-1] == pytest.approx(-1, abs=2e-3) and fall.min() > -1.01
    b, disc = hung(at=(0, 1), min_length=0.6)
    assert motion(b, 3.0).position[-1, disc, 1] == pytest.approx(0.6, abs=2e-3)


# Hard cases


@pytest.mark.parametrize("dt", [1 / 30, 1 / 60])
@pytest.mark.parametrize("stiffness", [1e4, 1e6, 1e9])
def test_spring_of_any_stiffness_gains_no_energy(stiffness: float, dt: float):
    b, disc = hung(stiffness=stiffness, at=(0, -1.1))
    m = motion(b, 5.0, dt)
    energy = m.energy()
    assert energy.max() <= energy[0] * (1 + 1e-4)
    # The stiffest are as stiff as a joint: at 64 Hz, 32 at this dt, the weight stretches one by 0.06 and 0.24 mm.
    sag = G / min(stiffness, (2 * math.pi * STANDARD.spring_hertz_share * STANDARD.substeps / dt) ** 2)
    assert m.position[-1, disc, 1] == pytest.approx(-1 - sag, abs=1e-5)


def test_net_of_stiff_springs_gains_no_energy():
    """Six discs in a row, each held to the next and the one after: stiff ones between slow ones."""
    b = SceneBuilder(CAPACITY)
    previous = b.add_box(width=0.2, height=0.2, fixed=True)
    at = (0.0, 0.0)
    for k in range(6):
        place = (0.3 * (k + 1), 0.1 * (k % 2))
        disc = b.add_circle(radius=0.1, position=place, density=(1, 30)[k % 2] * DISC)
        b.add_spring(previous, disc, at_a=at, at_b=place, stiffness=10.0 ** (2 + k), damping=0.1 * k)
        previous, at = disc, place
    m = motion(b, 10.0)
    moving = m.energy() - m.elastic_energy()  # no spring is stretched at first
    assert moving.max() < moving[0] + 0.01 * np.ptp(m.kinetic_energy())


@pytest.mark.parametrize("ratio", [1.0, 100.0])
def test_row_of_rods_with_a_heavy_end_gains_no_energy(ratio: float):
    b = SceneBuilder(CAPACITY)
    previous, at = b.add_box(width=0.2, height=0.2, fixed=True), (0.0, 0.0)
    for k in range(6):
        place = (0.3 * (k + 1), 0.0)
        disc = b.add_circle(radius=0.1, position=place, density=(ratio if k == 5 else 1.0) * DISC)
        b.add_rod(previous, disc, at_a=at, at_b=place)
        previous, at = disc, place
    m = motion(b, 10.0)
    energy, fall = midway_energy(m), G * 0.3 * (15 + 6 * ratio)
    assert (energy - energy[0]).max() < 0.005 * fall
    assert np.abs(m.spring_lengths() - 0.3).max() < 0.005


def test_spring_hits_as_hard_as_it_is_tight_and_a_ball_bounces_on_it():
    """Bounces may take the energy that springs gave in the step."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    wall = b.add_box(width=0.2, height=2, position=(2, 0), fixed=True, restitution=1)
    ball = b.add_circle(radius=0.1, position=(1.2, 0), density=DISC, restitution=1, friction=0)
    b.add_spring(wall, ball, at_a=(2, 0), at_b=(1.2, 0), rest_length=0.0, stiffness=30.0)
    m = motion(b, 3.0)
    speed = np.abs(m.velocity[:, ball, 0])
    assert speed.max() == pytest.approx(math.sqrt(30 * (0.8**2 - 0.2**2)), rel=0.03)
    assert m.position[60:, ball, 0].min() == pytest.approx(1.2, abs=0.05)  # back where it came from


def ball_before_a_platform(capacity: Capacity = FEW) -> tuple[BuiltWorld, int, int]:
    """A platform pushes a disc on a rod into a ball: (world, disc, ball)."""
    b = SceneBuilder(capacity, gravity=(0, 0))
    platform = b.add_box(width=0.2, height=0.2, kinematic=True, velocity=(3, 0))
    disc = b.add_circle(radius=0.1, position=(1, 0), velocity=(3, 0), density=DISC, restitution=1)
    ball = b.add_circle(radius=0.1, position=(2, 0), density=DISC, restitution=1)
    b.add_rod(platform, disc, at_a=(0, 0), at_b=(1, 0))
    return b.build(), disc, ball


def test_ball_leaves_what_a_platform_pushes_on_a_rod_with_twice_its_speed():
    """The platform has no mass of its own: what it does through the rod is its to give."""
    world, disc, ball = ball_before_a_platform()
    one = Engine(FEW)
    state, touching = one.step(world.scene, one.initial_state(*world), num_steps=30)
    assert touch_matrix(touching.during, FEW.shapes)[disc, ball]
    assert state.velocity[ball, 0] == pytest.approx(6.0, rel=0.02)
    assert state.velocity[disc, 0] == pytest.approx(3.0, rel=0.01)


@pytest.mark.parametrize("backend", ["warp", pytest.param("xla", marks=pytest.mark.slow)])
def test_blow_is_shared_out_along_rods_in_the_step_in_which_it_falls(backend: str):
    # The reference compiles for as long as there are kinds of shapes.
    capacity = FEW if backend == "warp" else dataclasses.replace(FEW, polygons=0)
    b = SceneBuilder(capacity, gravity=(0, 0))
    ball = b.add_circle(radius=0.1, velocity=(10, 0), density=DISC, friction=0)
    discs = [b.add_circle(radius=0.1, position=(0.5 * k, 0), density=DISC, friction=0) for k in (1, 2, 3)]
    for k, (one, other) in enumerate(itertools.pairwise(discs), start=1):
        b.add_rod(one, other, at_a=(0.5 * k, 0), at_b=(0.5 * k + 0.5, 0))
    shared = preset("standard").replace(impact_passes=16)
    world, one = b.build(), Engine(capacity, settings=shared, backend=backend)
    state, _ = one.step(world.scene, one.initial_state(*world), num_steps=2)
    speed = np.asarray(state.velocity[np.array([ball, *discs]), 0])
    np.testing.assert_allclose(speed, 10 / 4, rtol=0.02)


# Effects, drawing


def flying(capacity: Capacity = CAPACITY) -> SceneBuilder:
    b = SceneBuilder(capacity, gravity=(0, 0))
    box = b.add_box(width=0.6, height=0.2, angular_velocity=6.0, density=8)
    one = b.add_circle(radius=0.2, position=(1, 0.3), velocity=(0, 2), angular_velocity=-5, density=10)
    other = b.add_circle(radius=0.15, position=(1, 1.3), velocity=(-2, 1), density=20)
    b.add_spring(box, one, at_a=(0.3, 0.05), at_b=(0.9, 0.4), stiffness=300, damping=0.5)
    b.add_rod(one, other, at_a=(1, 0.4), at_b=(1.05, 1.3))
    b.add_spring(box, other, at_a=(-0.3, 0), at_b=(1, 1.2), stiffness=50, rest_length=1.4, max_length=1.9)
    b.add_rope(box, one, at_a=(-0.3, 0), at_b=(1.1, 0.3), length=1.6)
    return b


def test_state_goes_on_where_it_was_saved():
    world = flying().build()
    one = engine()
    state = one.initial_state(*world)
    half, _ = one.step(world.scene, state, num_steps=30)
    assert np.abs(half.spring_impulse[:4, 0]).max() > 0
    straight, _ = one.step(world.scene, state, num_steps=60)
    for x, y in zip(jax.tree.leaves(one.step(world.scene, half, num_steps=30)[0]), jax.tree.leaves(straight)):
        np.testing.assert_array_equal(x, y)


def test_springs_are_an_effect_and_cost_nothing_where_there_is_no_room_for_them():
    world = flying().build()
    effects = effects_of(world.scene)
    assert effects.springs
    special = Engine(CAPACITY, effects=effects)
    for x, y in zip(
        jax.tree.leaves(special.step(world.scene, special.initial_state(*world), num_steps=30)),
        jax.tree.leaves(engine().step(world.scene, engine().initial_state(*world), num_steps=30)),
        strict=True,
    ):
        np.testing.assert_array_equal(x, y)
    for lacking in (
        Engine(CAPACITY, settings=preset("paper")),
        Engine(CAPACITY, effects=Effects.full(CAPACITY).without("springs")),
    ):
        with pytest.raises(MissingEffectError, match="springs"):
            lacking.step(world.scene, lacking.initial_state(*world))
    rows = Layout(Capacity(polygons=1, circles=1, joints=1, thrusters=1)).rows()
    with_springs = Layout(Capacity(polygons=1, circles=1, joints=1, thrusters=1, springs=2)).rows()
    grown = {table: with_springs[table]["ROWS"] - rows[table]["ROWS"] for table in rows}
    assert grown == {"SCENE": 18, "INTS": 2, "CONTROLS": 0, "STATE": 0, "IMPULSE": 6, "OUT": 0}


def test_spring_of_an_inactive_shape_does_nothing():
    b, disc = hung(stiffness=100.0)
    scene, *start = b.build()
    active = scene.shapes.active.copy()
    active[0] = False
    end, _ = engine().step(
        scene.replace(shapes={"active": active}), engine().initial_state(scene, *start), num_steps=60
    )
    assert float(end.velocity[disc, 1]) == pytest.approx(-G, rel=1e-4)


def test_springs_are_drawn():
    b, _ = hung(stiffness=100.0)
    world = b.build()
    view = (-0.5, -1.5, 0.5, 0.5)
    with_spring = draw(world.scene, world, view=view)
    without = draw(world.scene.replace(springs={"active": np.zeros(6, bool)}), world, view=view)
    changed = (with_spring != without).any(-1)
    rows, columns = np.nonzero(changed)
    assert len(rows) > 100
    assert (without[rows, columns] == BACKGROUND).all(-1).any()
    assert 2 * 5 < np.ptp(columns) < 2 * 5 + 6  # a zigzag 0.1 m wide at 100 pixels a metre


# What is refused


def pair() -> tuple[SceneBuilder, int, int]:
    b = SceneBuilder(CAPACITY)
    return b, b.add_circle(radius=0.1), b.add_circle(radius=0.1, position=(1, 0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stiffness": -1.0}, "stiffness is -1; it must be 0 or more"),
        ({"damping": -1.0}, "damping is -1; it must be 0 or more"),
        ({"stiffness": math.inf}, "stiffness is inf; give a finite number"),
        ({"rest_length": -0.5, "stiffness": 1.0}, "rest_length is -0.5"),
        ({}, "the spring does nothing; give stiffness"),
        ({"max_length": 0.0}, "max_length is 0; anchors that stay in one place are a joint"),
        ({"min_length": 2.0, "max_length": 1.0}, "min_length 2 and max_length 1 leave no length"),
    ],
)
def test_spring_that_cannot_be_is_refused(options: dict[str, float], message: str):
    b, one, other = pair()
    with pytest.raises(SceneError, match=message):
        b.add_spring(one, other, at_a=(0, 0), at_b=(1, 0), **options)  # type: ignore[arg-type]


def test_spring_on_nothing_on_itself_or_between_fixed_shapes_is_refused():
    b, one, other = pair()
    walls = [b.add_box(width=1, height=1, fixed=True) for _ in range(2)]
    for ends, message in (
        ((one, 4), "b is 4, which is no shape"),
        ((one, one), "spring from shape 2 to itself"),
        (walls, "spring of shapes 0 and 1, which are both fixed"),
    ):
        with pytest.raises(SceneError, match=message):
            b.add_spring(*ends, at_a=(0, 0), at_b=(1, 0), stiffness=1)
    with pytest.raises(SceneError, match="max_length is 0"):
        b.add_rod(one, other, at_a=(0, 0), at_b=(0, 0))
    full = SceneBuilder(Capacity(polygons=0, circles=2, joints=0, thrusters=0))
    ends = full.add_circle(radius=0.1), full.add_circle(radius=0.1)
    with pytest.raises(SceneFullError, match=r"0 of 0 springs used; build with Capacity\(springs=1\)"):
        full.add_rope(*ends, at_a=(0, 0), at_b=(1, 0))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("stiffness", -1.0, "be 0 or more"),
        ("damping", -1.0, "be 0 or more"),
        ("max_length", 0.0, "be positive"),
        ("min_length", 1e20, "be at most max_length"),
        ("b", 8, "be the index of a shape"),
        ("b", 0, "be another shape than springs.a"),
    ],
)
def test_scene_of_a_wrong_spring_is_refused(field: str, value: float, message: str):
    b, _ = hung(stiffness=100.0)
    world = b.build()
    values = getattr(world.scene.springs, field).copy()
    values[0] = value
    with pytest.raises(ValueError, match=rf"scene.springs.{field}\[0\] is .*; it must {message}"):
        engine().step(world.scene.replace(springs={field: values}), engine().initial_state(*world))
