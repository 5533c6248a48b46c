"""The public recorder: controls that change, policies, contacts, files and pictures."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from PIL.GifImagePlugin import GifImageFile

from jax2d import Capacity, Controls, Engine, SceneBuilder, Trajectory, record, stack_worlds
from tests.helpers import present

CAPACITY = Capacity(polygons=2, circles=1, joints=1, thrusters=1)
G = 9.81


@functools.cache
def engine(report_contacts: bool = False) -> Engine:
    return Engine(CAPACITY, report_contacts=report_contacts)


def world(height: float = 0.5):
    """A box with a thruster below it over a floor; a wheel on the box with a motor."""
    b = SceneBuilder(CAPACITY)
    b.add_box(width=6, height=1, position=(0, -0.5), fixed=True)
    box = b.add_box(width=1, height=0.4, position=(0, height), density=1)
    wheel = b.add_circle(radius=0.2, position=(0, height + 0.5))
    b.add_revolute_joint(box, wheel, at=(0, height + 0.5), motor_speed=1.0)
    b.add_thruster(box, at=(0, height), angle=np.pi / 2, power=1.0)
    return b.build()


def start(*heights: float):
    worlds = [world(height) for height in heights]
    scene = stack_worlds([w.scene for w in worlds])
    return scene, stack_worlds([engine().initial_state(*w) for w in worlds])


def controls(motor, thruster) -> Controls:
    return Controls(motor=np.asarray(motor, np.float32), thruster=np.asarray(thruster, np.float32))


def test_a_sequence_of_controls_acts_sample_by_sample():
    scene, state = start(1.0, 2.0)
    rng = np.random.default_rng(0)
    given = controls(rng.uniform(-1, 1, (6, 2, 1)), rng.uniform(0, 1, (6, 2, 1)))
    trajectory, last = record(engine(), scene, state, given, num_samples=6, every=2)
    by_hand = state
    for k in range(6):
        one = jax.tree.map(lambda x, k=k: x[k], given)
        by_hand, _ = engine().step(scene, by_hand, one, num_steps=2)
        np.testing.assert_array_equal(trajectory.position[k + 1], by_hand.position)
    jax.tree.map(np.testing.assert_array_equal, last, by_hand)
    np.testing.assert_array_equal(present(trajectory.motor)[1:], given.motor)
    np.testing.assert_array_equal(present(trajectory.thruster)[1:], given.thruster)
    assert not present(trajectory.motor)[0].any()
    listed = [jax.tree.map(lambda x, k=k: x[k], given) for k in range(6)]
    again, _ = record(engine(), scene, state, listed, num_samples=6, every=2)
    np.testing.assert_array_equal(again.position, trajectory.position)


@pytest.mark.parametrize("single", [True, False])
def test_forces_from_outside_change_from_sample_to_sample(single: bool):
    """m v is the sum of F dt."""
    capacity = Capacity(polygons=0, circles=2, joints=0, thrusters=0, extended_shapes=True)
    b = SceneBuilder(capacity, gravity=(0, 0))
    b.add_circle(radius=0.1, position=(-1, 0), density=1 / (np.pi * 0.01))
    pushed = b.add_circle(radius=0.1, position=(1, 0), density=1 / (np.pi * 0.01))
    built, one = b.build(), Engine(capacity)
    scene, state = built.scene, one.initial_state(*built)
    force = np.zeros((5, 2, 2), np.float32)
    force[:, pushed] = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    given = Controls(motor=np.zeros((5, 0), np.float32), thruster=np.zeros((5, 0), np.float32), force=force)
    if not single:
        scene, state, given = stack_worlds([scene]), stack_worlds([state]), jax.tree.map(lambda x: x[:, None], given)
    m, _ = record(one, scene, state, given, num_samples=5)
    velocity = m.velocity if single else m.velocity[:, 0]
    np.testing.assert_allclose(velocity[1:, pushed], np.cumsum(force[:, pushed], 0) / 60, atol=1e-7)
    assert not velocity[:, 0].any()


@pytest.mark.parametrize("single", [False, True])
def test_a_policy_sees_each_state_and_its_time(single: bool):
    scene, state = start(1.0, 1.3)
    if single:
        scene, state = jax.tree.map(lambda x: x[0], (scene, state))

    def hover(state, time):
        below = state.position[..., 1, 1:2] + 0.1 * state.velocity[..., 1, 1:2] < 1.0
        return Controls(motor=jnp.zeros_like(below, jnp.float32) + 0.1 * time, thruster=below.astype(jnp.float32))

    trajectory, _ = record(engine(), scene, state, hover, num_samples=90)
    height = trajectory.position[..., 1, 1]
    assert height[60:].min() > 0.6  # without thrust the box is on the floor by then
    expected = trajectory.position[:-1, ..., 1, 1] + 0.1 * trajectory.velocity[:-1, ..., 1, 1] < 1.0
    np.testing.assert_array_equal(present(trajectory.thruster)[1:, ..., 0], expected)
    times = 0.1 * trajectory.time[:-1] if single else 0.1 * np.repeat(trajectory.time[:-1, None], 2, 1)
    np.testing.assert_allclose(present(trajectory.motor)[1:, ..., 0], times, rtol=1e-5, atol=1e-7)
    assert not present(trajectory.invalid_controls).any()


def test_what_a_policy_gives_out_of_range_is_counted():
    scene, state = start(1.0)

    def too_much(state, time):
        return Controls(motor=jnp.full((1, 1), 2.0), thruster=jnp.where(time > 0.04, jnp.full((1, 1), -1.0), 0.5))

    trajectory, _ = record(engine(), scene, state, too_much, num_samples=4)
    assert present(trajectory.invalid_controls)[:, 0].tolist() == [0, 1, 1, 1, 2]


def test_contacts_are_recorded_where_they_are_asked_for():
    scene, state = start(0.2)
    trajectory, _ = record(engine(report_contacts=True), scene, state, num_samples=60, contacts=True)
    contacts = present(trajectory.contacts)
    assert contacts.count[0, 0] == 0 and (contacts.a[0] == -1).all()
    # The floor bears the box and, by the joint, the wheel.
    mass = (1 / np.asarray(scene.shapes.inverse_mass[0, 1:])).sum()
    given = np.asarray(contacts.impulse_on(CAPACITY.shapes))[-1, 0, 1]
    assert given == pytest.approx([0, mass * G / 60], abs=2e-3)
    assert present(trajectory.world(0).contacts).normal.shape == (61, CAPACITY.contact_slots, 2)
    assert present(trajectory.until(0.5).contacts).a.shape[0] == 31
    quiet, _ = record(engine(), scene, state, num_samples=2)
    assert quiet.contacts is None
    with pytest.raises(ValueError, match="does not report contacts; build it with report_contacts=True"):
        record(engine(), scene, state, num_samples=2, contacts=True)


def test_a_saved_trajectory_comes_back_to_the_last_bit(tmp_path):
    scene, state = start(0.2, 0.7)
    saved, _ = record(
        engine(report_contacts=True), scene, state, num_samples=5, contacts=True, joint_force=True, every=3
    )
    for one in (saved, saved.world(1)):
        path = tmp_path / "run.npz"
        one.save(path)
        loaded = Trajectory.load(path)
        assert loaded.interval == one.interval == 0.05
        for name in ("position", "velocity", "motor", "joint_force", "limited", "invalid_controls"):
            got, expected = getattr(loaded, name), getattr(one, name)
            assert got.dtype == expected.dtype
            np.testing.assert_array_equal(got, expected)
        jax.tree.map(np.testing.assert_array_equal, (loaded.scene, loaded.contacts), (one.scene, one.contacts))
        np.testing.assert_array_equal(loaded.energy(), one.energy())


def test_files_of_another_kind_are_refused(tmp_path):
    scene, state = start(0.2)
    trajectory, _ = record(engine(), scene, state, num_samples=2)
    with pytest.raises(ValueError, match=r"'run.txt' has another ending than .npz"):
        trajectory.save(tmp_path / "run.txt")
    for name, content in (("text.npz", b"no archive"), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name} is no file that Trajectory.save wrote"):
            Trajectory.load(tmp_path / name)
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match=r"other.npz is no file"):
        Trajectory.load(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        Trajectory.load(tmp_path / "none.npz")


def test_pictures_show_what_moved(tmp_path):
    scene, state = start(2.0)
    trajectory, _ = record(engine(), scene, state, num_samples=60)
    with pytest.raises(ValueError, match=r"1 worlds; draw one of them: trajectory.world\(0\).draw"):
        trajectory.draw(tmp_path / "run.gif")
    one = trajectory.world(0)
    one.draw(tmp_path / "run.gif", width=100)
    with Image.open(tmp_path / "run.gif") as film:
        assert film.size[0] == 100
        assert isinstance(film, GifImageFile) and film.n_frames >= 20
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(film.n_frames - 1)
        assert np.abs(np.asarray(film.convert("RGB")) - first).max() > 50
    one.draw(tmp_path / "run.png", width=200, view=(-2, -1, 2, 3))
    with Image.open(tmp_path / "run.png") as picture:
        assert picture.size == (200, 200)
    with pytest.raises(ValueError, match=r"has another ending than .png or .gif"):
        one.draw(tmp_path / "run.mp4")
    with pytest.raises(ValueError, match="speed is 0; give more than 0"):
        one.draw(tmp_path / "run.gif", speed=0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (controls(np.zeros((3, 1, 1)), np.zeros((3, 1, 1))), r"controls.motor has shape \(3, 1, 1\)"),
        ([controls(np.zeros((1, 1)), np.zeros((1, 1)))] * 3, "3 controls for 4 samples; give one for each"),
        (controls(np.full((4, 1, 1), 3.0), np.zeros((4, 1, 1))), r"controls.motor\[0, 0, 0\] is 3.0; it must be from"),
        (np.zeros((1, 1)), "controls is of type ndarray, not Controls"),
        (lambda state, time: 1.0, "controls is of type float, not Controls"),
    ],
)
def test_wrong_controls_are_one_line(given, message: str):
    scene, state = start(1.0)
    with pytest.raises((ValueError, TypeError), match=message) as error:
        record(engine(), scene, state, given, num_samples=4)
    assert "\n" not in str(error.value)
