"""Contact reports against mechanics: momentum, weights, bounces, friction; both backends."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, ContactReport, Engine, SceneBuilder, effects_of, preset, stack_worlds
from jax2d.xla import reports
from tests.helpers import present

pytestmark = pytest.mark.also_gpu

CAPACITY = Capacity(polygons=5, circles=3, joints=1, thrusters=0)
G, STANDARD = 9.81, preset("standard")
DT = STANDARD.dt
WORLDS = 24  # always: the reference is compiled once
SLOW = pytest.mark.slow
FALL = np.array([0.0, -G * DT])  # m/s in a step


@functools.cache
def engine(backend: str = "warp", settings: str = "standard", report_contacts: bool = True) -> Engine:
    return Engine(CAPACITY, settings=preset(settings), backend=backend, report_contacts=report_contacts)


@functools.cache
def stepper(one: Engine, steps: int = 1) -> Callable:
    return jax.jit(functools.partial(one.step, num_steps=steps))


def after(world: BuiltWorld, seconds: float, *, settings: str = "standard"):
    """(state, report) as numpy at the end."""
    one = engine("warp", settings)
    state, touching = one.initial_state(*world), None
    for _ in range(round(seconds / DT)):
        state, touching = stepper(one)(world.scene, state)
    return jax.tree.map(np.asarray, (state, present(touching).contacts))


def mass_of(world: BuiltWorld, shape: int) -> float:
    return 1.0 / float(world.scene.shapes.inverse_mass[shape])


def resting_stack() -> tuple[BuiltWorld, list[int]]:
    b = SceneBuilder(CAPACITY)
    b.add_box(width=6, height=1, position=(0, -0.5), fixed=True)
    boxes = [b.add_box(width=1, height=0.5, position=(0, 0.25 + 0.5 * i), density=1 + i) for i in range(3)]
    return b.build(), boxes


def mess(seed: int) -> BuiltWorld:
    """Bodies that are thrown at each other between fixed ones, with friction and restitution, some very fast."""
    rng = np.random.default_rng(seed)
    b = SceneBuilder(CAPACITY)
    b.add_box(width=8, height=0.3, position=(0, -0.15), fixed=True, restitution=0.4)
    for _ in range(3):
        b.add_box(
            width=rng.uniform(0.2, 0.8),
            height=rng.uniform(0.2, 0.8),
            position=rng.uniform((-1.5, 0.5), (1.5, 2)),
            velocity=tuple(rng.uniform(-1, 1, 2) * rng.choice([2, 10, 50])),
            angular_velocity=rng.uniform(-10, 10),
            restitution=rng.choice([0.0, 0.8]),
        )
    for _ in range(3):
        at, velocity = rng.uniform((-2, 0.5), (2, 2.5)), tuple(rng.uniform(-1, 1, 2) * rng.choice([2, 10, 50]))
        b.add_circle(radius=rng.uniform(0.1, 0.3), position=at, velocity=velocity, restitution=rng.choice([0.0, 0.8]))
    return b.build()


def momentum(scene, state) -> np.ndarray:
    """[W, n, 2] N s of what can move."""
    inverse = np.asarray(scene.shapes.inverse_mass, np.float64)
    mass = np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1), 0)
    return mass[..., None] * np.asarray(state.velocity, np.float64)


@pytest.mark.parametrize(
    ("backend", "settings"),
    [("warp", "standard"), ("warp", "paper"), ("xla", "paper"), pytest.param("xla", "standard", marks=SLOW)],
)
def test_impulses_are_the_momentum_that_contacts_gave(backend: str, settings: str):
    worlds = [mess(seed) for seed in range(WORLDS)]
    scene = stack_worlds([w.scene for w in worlds])
    one = engine(backend, settings)
    state = stack_worlds([one.initial_state(*w) for w in worlds])
    movable = np.asarray(scene.shapes.inverse_mass) > 0
    largest = 0.0
    for _ in range(30 if backend == "warp" else 8):
        before, (state, touching) = state, stepper(one)(scene, state)
        report = touching.contacts
        given = np.asarray(report.impulse_on(CAPACITY.shapes))
        fallen = dataclasses.replace(before, velocity=np.asarray(before.velocity, np.float64) + FALL)
        gained = np.where(movable[..., None], momentum(scene, state) - momentum(scene, fallen), given)
        is_free = np.asarray(touching.limited) == 0  # a speed limit takes momentum
        scale = 1e-5 * (1 + np.abs(momentum(scene, before)).max(axis=(1, 2)))
        wrong = np.abs(gained - given).max(axis=(1, 2)) > scale
        assert not (wrong & is_free).any()
        assert not np.asarray(report.dropped).any()
        assert is_free.mean() > 0.5
        largest = max(largest, np.abs(given).max())
    assert largest > 2.0


@pytest.mark.parametrize("settings", ["standard", "paper"])
def test_floor_bears_the_weight_of_a_stack_and_every_box_what_is_above_it(settings: str):
    world, boxes = resting_stack()
    _, report = after(world, 2.0, settings=settings)
    masses = [mass_of(world, box) for box in boxes]
    assert report.count == 6
    for level, box in enumerate(boxes):
        below = report.b == box
        assert below.sum() == 2
        bears = report.normal_impulse[below].sum()
        assert bears == pytest.approx(sum(masses[level:]) * G * DT, rel=2e-3)
        np.testing.assert_allclose(report.normal[below], [[0, 1]] * 2, atol=3e-3)
        np.testing.assert_allclose(np.sort(report.point[below, 0]), [-0.5, 0.5], atol=2e-3)
        np.testing.assert_allclose(report.point[below, 1], 0.5 * level, atol=3e-3 if settings == "standard" else 0.02)
        np.testing.assert_allclose(report.separation[below], 0, atol=2e-3 if settings == "standard" else 0.02)
    assert (report.a[report.count :] == -1).all() and (report.b[report.count :] == -1).all()
    for x in (report.point, report.normal, report.separation, report.normal_impulse, report.tangent_impulse):
        assert not x[report.count :].any()


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_bounce_gives_mass_times_one_plus_e_times_the_speed(restitution: float):
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    wall = b.add_box(width=1, height=4, position=(2, 0), fixed=True, restitution=1)
    ball = b.add_circle(radius=0.2, density=3, velocity=(4, 0), restitution=restitution)
    world = b.build()
    one, state, total, pushes = engine(), engine().initial_state(*world), 0.0, 0
    for _ in range(40):
        state, touching = stepper(one)(world.scene, state)
        report = touching.contacts
        given = np.asarray(report.normal_impulse).sum()
        if given > 0:
            assert (int(report.a[0]), int(report.b[0])) == (wall, ball)
            np.testing.assert_allclose(report.normal[0], [-1, 0], atol=1e-6)  # from the wall to the ball
        total, pushes = total + given, pushes + (given > 0)
    assert total == pytest.approx(mass_of(world, ball) * (1 + restitution) * 4.0, rel=1e-3)
    assert pushes == (1 if restitution > 0 else pushes)


def test_two_free_bodies_exchange_one_impulse():
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    one = b.add_circle(radius=0.2, position=(-1, 0), density=2, velocity=(3, 0), restitution=0.6)
    other = b.add_circle(radius=0.3, position=(1, 0), density=1, velocity=(-1, 0), restitution=0.6)
    world = b.build()
    state, total = engine().initial_state(*world), np.zeros((CAPACITY.shapes, 2))
    for _ in range(40):
        state, touching = stepper(engine())(world.scene, state)
        total += np.asarray(touching.contacts.impulse_on(CAPACITY.shapes))
    reduced = 1 / (1 / mass_of(world, one) + 1 / mass_of(world, other))
    assert total[other] == pytest.approx([reduced * 1.6 * 4.0, 0], rel=2e-3, abs=1e-5)
    np.testing.assert_array_equal(total[one], -total[other])


@pytest.mark.parametrize("slope", [0.15, -0.15, 0.9])
def test_friction_on_an_incline_holds_or_slides(slope: float):
    b = SceneBuilder(CAPACITY, gravity=(G * math.sin(slope), -G * math.cos(slope)))
    b.add_box(width=60, height=1, position=(0, -0.5), fixed=True)
    box = b.add_box(width=1, height=0.4, position=(0, 0.2))
    world = b.build()
    _, report = after(world, 1.0)
    mass, mu = mass_of(world, box), STANDARD.base_friction
    on_box = np.asarray(report.impulse_on(CAPACITY.shapes))[box]
    pull, weight = mass * G * DT * math.sin(slope), mass * G * DT * math.cos(slope)
    assert on_box[1] == pytest.approx(weight, rel=1e-3)
    assert on_box[0] == pytest.approx(-math.copysign(min(abs(pull), mu * weight), slope), rel=2e-3)
    right = np.stack([report.normal[:2, 1], -report.normal[:2, 0]], -1)
    along = (report.tangent_impulse[:2, None] * right).sum(0)[0]
    assert along == pytest.approx(on_box[0], rel=1e-3)


def test_report_is_of_the_last_step_of_a_call():
    world, _ = resting_stack()
    one = engine()
    start, _ = after(world, 0.5)
    state, first = stepper(one)(world.scene, start)
    state, second = stepper(one)(world.scene, state)
    both, touching = stepper(one, 2)(world.scene, start)
    jax.tree.map(np.testing.assert_array_equal, touching.contacts, second.contacts)
    jax.tree.map(np.testing.assert_array_equal, both, state)
    assert (np.asarray(first.contacts.normal_impulse) != np.asarray(second.contacts.normal_impulse)).any()


@pytest.mark.parametrize("backend", ["warp", pytest.param("xla", marks=SLOW)])
def test_states_have_the_same_bits_with_and_without_a_report(backend: str):
    worlds = [mess(seed) for seed in range(WORLDS)]
    scene = stack_worlds([w.scene for w in worlds])
    one, other = engine(backend), engine(backend, report_contacts=False)
    state = same = stack_worlds([one.initial_state(*w) for w in worlds])
    for _ in range(20):
        state, touching = stepper(one)(scene, state)
        same, quiet = stepper(other)(scene, same)
        jax.tree.map(np.testing.assert_array_equal, state, same)
        assert quiet.contacts is None
        assert isinstance(touching.contacts, ContactReport)


@pytest.mark.parametrize("settings", ["paper", pytest.param("standard", marks=SLOW)])
def test_kernel_and_reference_report_alike(settings: str):
    worlds = [mess(seed) for seed in range(WORLDS)]
    scene = stack_worlds([w.scene for w in worlds])
    kernel, reference = engine("warp", settings), engine("xla", settings)
    state = stack_worlds([kernel.initial_state(*w) for w in worlds])
    alike = []
    for _ in range(10):
        after_kernel, one = stepper(kernel)(scene, state)
        after_reference, other = stepper(reference)(scene, state)
        one, other = jax.tree.map(np.asarray, (one.contacts, other.contacts))
        for w in range(len(worlds)):
            same = np.array_equal(one.a[w], other.a[w]) and np.array_equal(one.b[w], other.b[w])
            for name, atol in (("point", 2e-5), ("normal", 2e-5), ("separation", 2e-5), ("impulse", 2e-4)):
                same &= np.allclose(getattr(one, name)[w], getattr(other, name)[w], atol=atol, rtol=1e-4)
            agree = np.allclose(after_kernel.velocity[w], after_reference.velocity[w], atol=1e-4, rtol=1e-4)
            alike.append((agree, same))
        state = after_kernel
    agree, same = np.array(alike).T
    assert agree.mean() > 0.95  # at 50 m/s a contact within rounding of another shows at once (test_reference.py)
    assert same[agree].mean() > 0.985


def test_engine_for_the_effects_of_a_scene_reports_the_same():
    world, _ = resting_stack()
    small = Engine(CAPACITY, effects=effects_of(world.scene), report_contacts=True)
    state, report = after(world, 0.2)
    _, touching = stepper(small)(world.scene, state)
    _, full = stepper(engine())(world.scene, state)
    jax.tree.map(np.testing.assert_array_equal, touching.contacts, full.contacts)
    assert touching.contacts.a.shape == (CAPACITY.contact_slots,)
    assert report.count == 6


def test_contacts_beyond_the_slots_are_counted():
    tally = reports.nothing(Capacity(polygons=0, circles=2, joints=0, thrusters=0), jnp.dtype("float32"))
    slots = tally.key.shape[0]
    full = tally._replace(key=jnp.arange(slots, dtype=jnp.int32))

    class Found:
        key = jnp.arange(slots, dtype=jnp.int32) + slots
        impulse_normal = impulse_tangent = jnp.zeros(slots)

    after = reports.begin(full, Found)  # type: ignore[arg-type]
    assert int(after.dropped) == slots
    np.testing.assert_array_equal(after.key, full.key)


def test_what_is_no_flag_is_refused():
    with pytest.raises(ValueError, match="report_contacts is 1; give True or False"):
        Engine(CAPACITY, report_contacts=1)  # type: ignore[arg-type]
