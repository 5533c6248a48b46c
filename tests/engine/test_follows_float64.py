"""The kernel against the reference in float64, with all that the engine has: one program of the reference for all.

Compiling it takes most of a minute. So every test here steps worlds of one capacity, in batches of one size, by calls
of one length. Scenes are those of the tests of each part.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Controls, Engine, SceneBuilder, State, stack_worlds
from jax2d.fidelity import Trajectory, record
from jax2d.fidelity.trajectory import start_of
from tests.engine.test_angles import wheel
from tests.engine.test_discs import after, shots, spinning_between_two
from tests.engine.test_extended_shapes import everything
from tests.engine.test_joined_trees import KINDS, gain, tree
from tests.engine.test_momentum import FAMILIES, errors, unlimited, worlds_of
from tests.engine.test_prismatic import all_kinds
from tests.engine.test_springs import ball_before_a_platform, flying

pytestmark = pytest.mark.long

OPTIMISED = True  # steps by the hundred: see tests/conftest.py

CAPACITY = Capacity(polygons=6, circles=6, joints=5, thrusters=1, springs=6, extended_shapes=True)
BATCH = 16  # worlds a call; what is missing is filled with the last one
CALL = 30  # steps, and samples


class Motion(NamedTuple):
    """Motion of one world."""

    trajectory: Trajectory
    end: State


@functools.cache
def engine(is_exact: bool) -> Engine:
    """The reference in float64, made inside `jax.enable_x64`, or the kernel."""
    return Engine(CAPACITY, backend="xla", dtype=jnp.float64) if is_exact else Engine(CAPACITY)


def follow(worlds: Sequence[BuiltWorld], is_exact: bool, steps: int = CALL, **acts: Any) -> list[Motion]:
    """Motion of at most BATCH worlds in `steps`, whole calls. `acts`: of `Controls`, held for all of them."""
    with jax.enable_x64(is_exact):
        one = engine(is_exact)
        scene, state = start_of(one, [*worlds, *[worlds[-1]] * (BATCH - len(worlds))])
        controls = stack_worlds([controls_of(**acts)] * BATCH)
        assert steps % CALL == 0
        parts = []
        for _ in range(steps // CALL):
            part, state = record(one, scene, state, controls, num_samples=CALL)
            parts.append(part)
        ends = jax.tree.map(np.asarray, state)
    trajectory = functools.reduce(joined, parts)
    return [Motion(trajectory.world(i), jax.tree.map(lambda x, i=i: x[i], ends)) for i in range(len(worlds))]


def controls_of(motor: float = 0.0, push: tuple[int, tuple[float, float], float] | None = None) -> Controls:
    """`push`: (shape, force N, torque N m)."""
    n = CAPACITY.shapes
    force, torque = np.zeros((n, 2), np.float32), np.zeros(n, np.float32)
    if push is not None:
        force[push[0]], torque[push[0]] = push[1:]
    motors = np.full(CAPACITY.joints, motor, np.float32)
    return Controls(motor=motors, thruster=np.zeros(CAPACITY.thrusters, np.float32), force=force, torque=torque)


def joined(one: Trajectory, other: Trajectory) -> Trajectory:
    """One that goes on where the other ended, of what turns by less than half a turn in all."""
    assert one.limited is not None and other.limited is not None
    return dataclasses.replace(
        one,
        position=np.concatenate([one.position, other.position[1:]]),
        angle=np.concatenate([one.angle, other.angle[1:]]),
        velocity=np.concatenate([one.velocity, other.velocity[1:]]),
        angular_velocity=np.concatenate([one.angular_velocity, other.angular_velocity[1:]]),
        limited=np.concatenate([one.limited, other.limited]),
    )


def both(world: BuiltWorld, steps: int = CALL, **acts: Any) -> tuple[Motion, Motion]:
    """(kernel, reference)."""
    (kernel,), (exact,) = (follow([world], is_exact, steps, **acts) for is_exact in (False, True))
    assert exact.end.position.dtype == np.float64
    return kernel, exact


def two_links(drive: str) -> BuiltWorld:
    """A lift that carries an arm, in free flight of the whole."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    base = b.add_box(width=0.6, height=0.4, density=2, angular_velocity=1.0, velocity=(0.3, 0))
    cart = b.add_box(width=0.3, height=0.3, position=(0.5, 0.1), angle=0.4)
    bar = b.add_box(width=0.8, height=0.1, position=(0.9, 0.1), density=3)
    b.add_prismatic_joint(
        base, cart, at=(0.45, 0.1), axis_angle=0.3, speed=0.7, max_force=3, drive=drive, limits=(-0.3, 0.5)
    )
    b.add_revolute_joint(cart, bar, at=(0.55, 0.1), speed=-1.5, max_torque=0.4, drive=drive, limits=(-1, 1))
    return b.build()


@pytest.mark.parametrize(("drive", "control"), [("servo", 0.8), ("brake", 0.0), ("brake", 0.3)])
def test_drives(drive: str, control: float):
    """Momentum too."""
    m, exact = (motion.trajectory for motion in both(two_links(drive), steps=60, motor=control))
    np.testing.assert_allclose(m.position, exact.position, atol=2e-5)
    np.testing.assert_allclose(m.angle, exact.angle, atol=5e-5)
    for trajectory, tolerance in ((m, 1e-5), (exact, 1e-9)):
        np.testing.assert_allclose(trajectory.momentum()[-1], trajectory.momentum()[0], atol=tolerance)
        np.testing.assert_allclose(trajectory.angular_momentum()[-1], trajectory.angular_momentum()[0], atol=tolerance)
    moved = exact.angle[-1] - exact.angle[0] - (exact.angle[-1, 0] - exact.angle[0, 0])
    assert (abs(moved[2]) > 0.1) == (control != 0)


@pytest.mark.also_gpu
def test_joints_of_every_kind():
    m, exact = (motion.trajectory for motion in both(all_kinds(CAPACITY), motor=1.0))
    np.testing.assert_allclose(m.position[:21], exact.position[:21], atol=2e-4)
    np.testing.assert_allclose(m.angle[:21], exact.angle[:21], atol=1e-3)


@pytest.mark.also_gpu
def test_extended_shapes_and_a_kinematic_body():
    """A step is as long as rounding does not grow."""
    end, expected = (motion.end for motion in both(everything(CAPACITY), push=(2, (0.3, 0.1), 0.02)))
    np.testing.assert_allclose(end.position, expected.position, atol=2e-4)
    np.testing.assert_allclose(end.angle, expected.angle, atol=1e-3)
    np.testing.assert_array_equal(end.contact_key, expected.contact_key)
    assert (expected.contact_key >= 0).any()
    np.testing.assert_allclose(end.rolling_impulse, expected.rolling_impulse, atol=1e-6)
    assert np.abs(expected.rolling_impulse).max() > 1e-5


def test_springs():
    """Momentum too."""
    m, exact = (motion.trajectory for motion in both(flying(CAPACITY).build(), steps=60))
    assert m.limited is not None and m.limited.sum() == 0
    np.testing.assert_allclose(m.position[:31], exact.position[:31], atol=2e-4)
    np.testing.assert_allclose(m.angle[:31], exact.angle[:31], atol=2e-3)
    exchanged = np.ptp(exact.velocity, axis=0).max()
    for trajectory, tolerance in ((m, 2e-5), (exact, 1e-11)):
        assert np.ptp(trajectory.momentum(), axis=0).max() < tolerance * exchanged
        assert np.ptp(trajectory.angular_momentum()) < tolerance * exchanged


def test_ball_leaves_what_a_platform_pushes_on_a_rod_with_twice_its_speed():
    """The law holds in float64 too; test_springs.py has the kernel. Nothing but the disc can have moved the ball."""
    world, disc, ball = ball_before_a_platform(CAPACITY)
    ((_, end),) = follow([world], is_exact=True)
    assert end.velocity[ball, 0] == pytest.approx(6.0, rel=0.02)
    assert end.velocity[disc, 0] == pytest.approx(3.0, rel=0.01)


def test_disc_leaves_a_fixed_one_by_the_law_of_impact_and_without_spin():
    """The law holds in float64 too; test_discs.py has the kernel."""
    offsets, phases, speed, shot = (0.2, 0.5, 0.8), 5, 5.0, CAPACITY.polygons + 1
    worlds = [w for offset in offsets for w in shots(speed, offset, 1.0, True, phases=phases, capacity=CAPACITY)]
    for offset, motion in zip(np.repeat(offsets, phases), follow(worlds, is_exact=True), strict=True):
        t = motion.trajectory
        assert np.abs(t.angular_velocity[:, shot]).max() < 1e-3
        assert np.linalg.norm(t.velocity[-1, shot] - after(speed, offset, 1.0, 1.0)) / speed < 0.001


def test_a_disc_that_spins_between_two_others_stays_where_it_is():
    """The disc stays in float64 too."""
    worlds, height = spinning_between_two(CAPACITY)
    for motion in follow(worlds, is_exact=True):
        assert np.abs(motion.trajectory.position[:, CAPACITY.polygons + 2, 1] - height).max() < 1e-4


def test_momentum_of_isolated_worlds_is_kept_to_the_rounding_of_float64():
    """The rest in float32 is rounding: with twice the digits it is 1e-9 of it."""
    worlds = [world for family in FAMILIES for world in worlds_of(family, CAPACITY)[:4]]
    batches = [worlds[i : i + BATCH] for i in range(0, len(worlds), BATCH)]
    trajectories = [motion.trajectory for batch in batches for motion in follow(batch, is_exact=True)]
    assert trajectories[0].position.dtype == np.float64
    for i in unlimited(trajectories):
        linear, angular = errors(trajectories[i], worlds[i])
        assert linear < 1e-10 and angular < 1e-10, i


def test_trees_that_are_welded_gain_no_energy():
    worlds = [tree(seed, **KINDS["welded"], hangs=False, capacity=CAPACITY) for seed in range(2 * BATCH)]
    motions = [motion for half in (worlds[:BATCH], worlds[BATCH:]) for motion in follow(half, is_exact=True)]
    assert max(gain(world, motion.trajectory) for world, motion in zip(worlds, motions, strict=True)) < 0.005


def test_angles_wrap_alike_and_float64_loses_nothing():
    disc, seconds = CAPACITY.polygons, 4
    world = wheel(45.0, -100.0, CAPACITY)
    start = float(world.angle[disc])
    assert math.remainder(start + 100.0, math.tau) == pytest.approx(0, abs=6e-8)  # float32, within half a turn
    kernel, exact = both(world, 60 * seconds)
    angle = float(exact.end.angle[disc])
    assert abs(angle) <= math.pi
    assert math.remainder(angle - (45.0 * seconds + start), math.tau) == pytest.approx(0, abs=1e-10)
    assert math.remainder(float(kernel.end.angle[disc]) - angle, math.tau) == pytest.approx(0, abs=3e-5)
