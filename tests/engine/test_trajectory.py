"""The recorder against the engine stepped by hand, and what is measured of a trajectory against worked-out values."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import (
    BuiltWorld,
    Capacity,
    Engine,
    Scene,
    SceneBuilder,
    State,
    effects_of,
    index_worlds,
    measure,
    preset,
    recorder,
    stack_worlds,
)
from jax2d.engine_argument import FixedEngine, VariantEngine
from jax2d.fidelity import Trajectory, record, record_worlds
from jax2d.fidelity.trajectory import start_of
from jax2d.sampling import Run, Sampling, take_samples
from tests.engine.worlds import CAPACITY, builder, engine

BOX, PENDULUM = 1, CAPACITY.polygons + 1


def worlds() -> list[BuiltWorld]:
    """A box that falls on a floor, a pendulum with a motor and a cart on a falling rail, at three speeds."""
    built = []
    for speed in (0.0, 1.0, 4.0):
        b = builder()
        b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
        b.add_box(width=0.4, height=0.4, position=(-2, 0.5), velocity=(speed, 0), angular_velocity=speed)
        pivot = b.add_circle(radius=0.05, position=(2, 2), fixed=True)
        bob = b.add_circle(radius=0.2, position=(3, 2))
        b.add_revolute_joint(pivot, bob, at=(2, 2), motor_speed=speed + 0.5, motor_power=0.1)
        rail = b.add_box(width=0.8, height=0.1, position=(5, 3), angle=0.3, angular_velocity=speed)
        cart = b.add_box(width=0.2, height=0.2, position=(5, 3.2), velocity=(-speed, 0))
        b.add_prismatic_joint(rail, cart, at=(5, 3.2), axis_angle=0.3)
        built.append(b.build())
    return built


def stepped_by_hand(scene: Scene, state: State, num_samples: int, every: int) -> list[State]:
    """States of a batch, by `Engine.step`."""
    states = [state]
    for _ in range(num_samples):
        for _ in range(every):
            state, _ = engine().step(scene, state)
        states.append(state)
    return states


# The recorder


@pytest.mark.also_gpu
@pytest.mark.parametrize("every", [1, 3])
def test_a_batch_is_recorded_as_the_engine_steps_it(every: int):
    one = engine()
    scene, start = start_of(one, worlds())
    trajectory, last = record(one, scene, start, num_samples=12, every=every)
    states = stepped_by_hand(scene, start, 12, every)
    for name in ("position", "angle", "velocity", "angular_velocity"):
        recorded = getattr(trajectory, name)
        assert recorded.dtype == np.float64
        np.testing.assert_array_equal(recorded, np.stack([getattr(state, name) for state in states]))
    for ended, expected in zip(jax.tree.leaves(last), jax.tree.leaves(states[-1])):
        np.testing.assert_array_equal(ended, expected)
    assert trajectory.time == pytest.approx(every / 60 * np.arange(13))


def test_one_world_is_recorded_as_in_a_batch_and_goes_on_where_it_ended():
    one = engine()
    scene, start = start_of(one, worlds())
    batch, _ = record(one, scene, start, num_samples=9)
    alone = [index_worlds(x, 2) for x in (scene, start)]
    first, middle = record(one, *alone, num_samples=4)
    second, _ = record(one, alone[0], middle, num_samples=5)
    assert first.position.shape == (5, CAPACITY.shapes, 2)
    np.testing.assert_array_equal(np.concatenate([first.position, second.position[1:]]), batch.world(2).position)


def test_controls_act_and_none_do_nothing():
    one = engine()
    scene, start = start_of(one, worlds())
    controls = jax.tree.map(lambda x: jnp.ones_like(x), one.no_controls(3))
    driven, _ = record(one, scene, start, controls, num_samples=20)
    free, _ = record(one, scene, start, num_samples=20)
    idle, _ = record(one, scene, start, one.no_controls(3), num_samples=20)
    np.testing.assert_array_equal(free.position, idle.position)
    assert np.abs(driven.angle - free.angle)[-1, :, PENDULUM].min() > 0.01


def test_calls_of_any_size_record_the_same():
    one = engine()
    scene, state = start_of(one, worlds())
    run = Run(scene=one.pack_scene(scene), state=one.pack_state(state), controls=one.no_controls(3))
    seen: list[int] = []
    whole, _ = take_samples(FixedEngine(one), run, Sampling(num_samples=10, per_call=10))
    parts, _ = take_samples(
        FixedEngine(one), run, Sampling(num_samples=10, per_call=4), lambda taken, packed: seen.append(taken)
    )
    np.testing.assert_array_equal(whole.position, parts.position)
    assert seen == [4, 8, 10]


def test_a_batch_too_large_for_the_device_is_recorded_in_parts(monkeypatch):
    """Each world keeps 6 numbers a shape, its controls and three counts: a limit of 4 samples of three worlds."""
    one = engine()
    scene, start = start_of(one, worlds())
    whole, _ = record(one, scene, start, num_samples=10)
    numbers = 6 * CAPACITY.shapes + CAPACITY.joints + CAPACITY.thrusters + 3
    monkeypatch.setattr(recorder, "MAX_BYTES_PER_CALL", 4 * 3 * 4 * numbers)
    seen: list[int] = []

    def counted(argument, run, sampling, observe=None):
        return take_samples(argument, run, sampling, lambda taken, packed: seen.append(taken))

    monkeypatch.setattr(recorder, "take_samples", counted)
    parts, _ = record(one, scene, start, num_samples=10)
    assert seen == [4, 8, 10]
    np.testing.assert_array_equal(whole.position, parts.position)


def test_overflow_and_limits_are_counted_where_they_happen():
    b = builder(gravity=(0, 0))
    b.add_circle(radius=0.1, velocity=(150, 0))
    (trajectory,) = record_worlds(engine(), [b.build()], seconds=0.1)
    assert trajectory.limited is not None and trajectory.overflow is not None
    assert trajectory.limited[0] == 0 and trajectory.limited[1] > 0  # 100 m/s is the limit
    assert trajectory.limited[2:].sum() == 0
    assert trajectory.overflow.sum() == 0


def test_joint_force_is_the_weight_of_what_hangs():
    b = builder()
    post = b.add_circle(radius=0.05, fixed=True)
    weight = b.add_box(width=1, height=0.5, position=(0, -0.5), density=4)  # 2 kg
    b.add_revolute_joint(post, weight, at=(0, -0.25))
    world = b.build()
    one = engine()
    trajectory, _ = record(one, world.scene, one.initial_state(*world), num_samples=10, every=30, joint_force=True)
    assert trajectory.joint_force is not None
    assert trajectory.joint_force.shape == (11, CAPACITY.joints, 2)
    assert trajectory.joint_force[0].tolist() == np.zeros((CAPACITY.joints, 2)).tolist()
    assert np.linalg.norm(trajectory.joint_force[-1, 0]) == pytest.approx(2 * 9.81, rel=1e-3)
    assert record(one, world.scene, one.initial_state(*world), num_samples=1)[0].joint_force is None


def test_a_trajectory_keeps_its_scene_when_the_given_one_is_changed():
    (world, *_) = worlds()
    one = engine()
    trajectory, _ = record(one, world.scene, one.initial_state(*world), num_samples=1)
    world.scene.shapes.active[BOX] = False
    assert trajectory.is_movable[BOX]


@pytest.mark.parametrize(
    ("counts", "says"),
    [
        ({"num_samples": 0}, "num_samples is 0; give 1 or more"),
        ({"num_samples": 2.5}, "num_samples is 2.5; it must be a whole number"),
        ({"num_samples": 2, "every": 0}, "every is 0; give 1 or more"),
    ],
)
def test_counts_that_are_none_are_refused(counts: dict, says: str):
    world = worlds()[0]
    with pytest.raises(ValueError, match=says):
        record(engine(), world.scene, engine().initial_state(*world), **counts)


def test_a_batch_of_other_length_is_refused():
    scene, start = start_of(engine(), worlds())
    with pytest.raises(ValueError, match="scene has 3 worlds, state 2"):
        record(engine(), scene, index_worlds(start, slice(0, 2)), num_samples=1)


# One program for many settings


def test_an_engine_of_a_variant_steps_as_the_engine_of_the_settings():
    """dt, sub-steps, stiffness, friction and warm starting differ; the variant, and so the program, is one."""
    base = preset("standard")
    changes = [
        {},
        {"dt": 1 / 120, "substeps": 2},
        {"contact_hertz": 1000.0, "base_friction": 1.0},
        {"warm_start": False},
    ]
    variants = set()
    for change in changes:
        own = Engine(CAPACITY, settings=base.replace(**change))
        scene, state = start_of(own, worlds())
        run = Run(scene=own.pack_scene(scene), state=own.pack_state(state), controls=own.no_controls(3))
        shared = VariantEngine.of(own, "warp")
        variants.add(shared.variant)
        samples, _ = take_samples(shared, run, Sampling(num_samples=40, per_call=40))
        expected, _ = take_samples(FixedEngine(own), run, Sampling(num_samples=40, per_call=40))
        np.testing.assert_array_equal(samples.position, expected.position)
        np.testing.assert_array_equal(samples.angular_velocity, expected.angular_velocity)
    assert len(variants) == 1
    assert VariantEngine.of(Engine(CAPACITY, settings=preset("paper")), "warp").variant not in variants


def test_loop_counts_are_compiled_into_the_reference_alone():
    capacity = Capacity(polygons=1, circles=1, joints=0, thrusters=0)
    base = preset("standard")
    of = [
        VariantEngine.of(Engine(capacity, settings=settings, backend="xla"), "xla").variant
        for settings in (base, base.replace(dt=1 / 30), base.replace(substeps=8), base.replace(solver_batch_size=1))
    ]
    assert of[0] == of[1] == of[3]
    assert of[0] != of[2]


def test_an_engine_of_some_effects_is_no_variant():
    scene = worlds()[0].scene
    with pytest.raises(ValueError, match="use FixedEngine"):
        VariantEngine.of(Engine(CAPACITY, effects=effects_of(scene)), "warp")


# Measures


@pytest.fixture(scope="module")
def batch() -> Trajectory:
    scene, start = start_of(engine(), worlds())
    return record(engine(), scene, start, num_samples=40)[0]


def test_measures_are_those_of_the_states(batch: Trajectory):
    scene, _ = start_of(engine(), worlds())
    gap, energy = batch.joint_gaps(), batch.energy()
    momentum, spin = batch.momentum(), batch.angular_momentum()
    for k in (0, 17, 40):
        for i in range(3):
            one = index_worlds(scene, i)
            state = State(
                **{name: getattr(batch, name)[k, i] for name in ("position", "angle", "velocity", "angular_velocity")},
                joint_impulse=None,
                spring_impulse=None,
                contact_key=None,
                contact_impulse=None,
                rolling_impulse=None,
            )
            assert energy[k, i] == pytest.approx(float(measure.energy(one, state)), rel=1e-5)
            assert momentum[k, i] == pytest.approx(np.asarray(measure.momentum(one, state)), rel=1e-5)
            assert spin[k, i] == pytest.approx(float(measure.angular_momentum(one, state)), rel=1e-5)
            assert gap[k, i] == pytest.approx(np.asarray(measure.joint_gaps(one, state)), abs=1e-6)


def test_measures_of_a_batch_are_those_of_its_worlds(batch: Trajectory):
    for i in range(3):
        one = batch.world(i)
        for name in ("speed", "kinetic_energy", "energy", "momentum", "angular_momentum", "joint_gaps"):
            np.testing.assert_array_equal(getattr(batch, name)()[:, i], getattr(one, name)())
        assert batch.drift()[i] == one.drift()
        assert batch.depth(30)[i] == one.depth(30)
        for of_batch, of_one in zip(batch.anchors(), one.anchors()):
            np.testing.assert_array_equal(of_batch[:, i], of_one)


def still(world: BuiltWorld, position: np.ndarray) -> Trajectory:
    """Positions [T, n, 2], nothing turned."""
    rest = np.zeros(position.shape[:2])
    return Trajectory(
        scene=world.scene,
        interval=0.1,
        position=position,
        angle=rest,
        velocity=np.zeros_like(position),
        angular_velocity=rest,
    )


def test_energy_and_drift_of_a_body_that_is_lifted():
    b = builder()
    box = b.add_box(width=1, height=2)  # 2 kg
    world = b.build()
    position = np.tile(world.position, (3, 1, 1)).astype(float)
    position[:, box] = [(0, 1), (0, 1.5), (3, 5)]
    lifted = still(world, position)
    assert lifted.energy() == pytest.approx(2 * 9.81 * np.array([1, 1.5, 5]))
    assert lifted.energy(zero_at=position[0]) == pytest.approx(2 * 9.81 * np.array([0, 0.5, 4]))
    assert lifted.drift() == pytest.approx(5.0)
    assert lifted.until(0.1).num_intervals == 1
    assert (lifted.index_at(0.1), lifted.index_at(0.11)) == (1, 2)


def test_gaps_keep_their_digits_far_from_the_origin():
    b = SceneBuilder(CAPACITY)
    a, c = b.add_box(width=1, height=1), b.add_box(width=1, height=1, position=(1, 0))
    b.add_revolute_joint(a, c, at=(0.5, 0))
    world = b.build()
    position = np.tile(world.position, (1, 1, 1)).astype(float) + 1e9
    position[:, c, 0] += 1e-6
    expected = position[0, c, 0] - position[0, a, 0] - 1
    assert still(world, position).joint_gaps()[0, 0] == expected
    assert expected == pytest.approx(1e-6, abs=2e-7)  # doubles lie 1.2e-7 apart there


def test_start_of_a_batch_is_that_of_its_worlds():
    built = worlds()
    scene, state = start_of(engine(), built)
    for leaf, expected in zip(jax.tree.leaves(scene), jax.tree.leaves(stack_worlds([w.scene for w in built]))):
        np.testing.assert_array_equal(leaf, expected)
    np.testing.assert_array_equal(state.velocity[:, BOX, 0], [0.0, 1.0, 4.0])
