"""Motors and limits of one articulation: each has its speed, or the largest impulse it may have, whatever the others
do. Seen from outside, by what a step says of its joints."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Controls, Engine, SceneBuilder, State, preset
from jax2d.xla import axial_rows

LINKS = 6
CAPACITY = Capacity(polygons=LINKS + 1, circles=1, joints=LINKS, thrusters=1)
WORLDS, STEPS = 32, 90
LIMIT = 0.6  # rad
TARGET, NEAR = 3.0, 0.02  # rad/s
FREE = 1e9  # rad/s
STANDARD = preset("standard")
DISAGREEING = 3e-3  # of links that lash about: their articulation's rows do not agree in time


def arm(seed: int) -> tuple[BuiltWorld, np.ndarray]:
    """A chain of links of unlike mass, whose hinges have motors of unlike strength, every other one limits; largest
    impulses of the motors in a sub-step, N m s."""
    random = np.random.default_rng(seed)
    torques = 10 ** random.uniform(-1.5, 1.5, LINKS)
    b = SceneBuilder(CAPACITY, gravity=(0, -9.81))
    one = b.add_box(width=0.2, height=0.2, fixed=True)
    for k in range(LINKS):
        density = 10 ** random.uniform(-0.5, 0.7)
        other = b.add_box(width=0.5, height=0.1, position=(0.5 * k + 0.25, 0), density=density, mask=0)
        limits = (-LIMIT, LIMIT) if k % 2 else None
        b.add_revolute_joint(one, other, at=(0.5 * k, 0), speed=TARGET, max_torque=torques[k], limits=limits)
        one = other
    return b.build(), torques * STANDARD.dt / STANDARD.substeps


@pytest.mark.parametrize("backend", ["warp", pytest.param("xla", marks=pytest.mark.long)])
def test_each_motor_has_its_speed_or_its_largest_impulse(backend: str):
    engine = Engine(CAPACITY, settings=STANDARD, backend=backend)
    built = [arm(seed) for seed in range(WORLDS)]
    largest = np.stack([impulses for _, impulses in built])
    scene = jax.tree.map(lambda *x: np.stack(x), *(world.scene for world, _ in built))
    state: State = jax.tree.map(lambda *x: np.stack(x), *(engine.initial_state(*world) for world, _ in built))
    controls = np.random.default_rng(0).choice([-1.0, 1.0], (STEPS // 15, WORLDS, LINKS)).astype(np.float32)
    step = jax.jit(engine.step)
    seen = []
    for k in range(STEPS):
        motor = controls[k // 15]
        state = step(scene, state, Controls(motor=motor, thruster=np.zeros((WORLDS, 1), np.float32)))[0]
        omega, ends = np.asarray(state.angular_velocity), (scene.joints.b, scene.joints.a)
        at_b, at_a = (np.take_along_axis(omega, np.asarray(end), 1) for end in ends)
        impulses = np.moveaxis(np.asarray(state.joint_impulse)[..., 2:], -1, 0)
        at_limit = np.maximum(np.abs(at_a), np.abs(at_b)) >= 0.999 * STANDARD.max_angular_speed
        seen.append((motor * TARGET - (at_b - at_a), *impulses, at_limit))
    missing, motor, lower, upper, at_limit = (np.stack(x) for x in zip(*seen, strict=True))
    assert np.isfinite(missing).all() and (np.abs(motor) <= 1.00001 * largest).all()
    unlimited = (lower == 0) & (upper == 0)
    at_limit = at_limit.any(axis=-1, keepdims=True)  # of what turns at the limit of speed nothing decides but that
    free = unlimited & ~at_limit
    driven, late = free & (np.abs(motor) < 0.999 * largest), free & (np.abs(missing) > NEAR)
    assert driven.mean() > 0.2 and late.mean() > 0.2
    assert np.mean(np.abs(missing[driven]) > NEAR) < DISAGREEING  # what is within its bound has its speed
    assert np.mean(missing[late] * motor[late] <= 0) < DISAGREEING  # what has not its speed pushes towards it
    # Limits push, and in one direction.
    assert (lower >= 0).all() and (upper >= 0).all() and not ((lower > 0) & (upper > 0)).any()
    assert not unlimited[..., 1::2].all() and unlimited[..., ::2].all()


@pytest.mark.parametrize(
    ("change", "highest", "holds"),
    [
        (0.3, FREE, axial_rows.NOTHING),  # 2.8 of 3 rad/s: its largest impulse
        (0.7, FREE, axial_rows.MOTOR),
        (0.3, 2.7, axial_rows.UPPER),  # the limit comes first
        (-9.0, 2.7, axial_rows.NOTHING),  # slower than the motor would have it, at its largest impulse
    ],
)
def test_a_round_begins_with_what_will_hold_if_the_speed_changes_as_it_did(change: float, highest: float, holds: int):
    rows = axial_rows.AxialRows.of(jnp.full(1, axial_rows.NOTHING), jnp.zeros(1))
    ones = jnp.ones(1)
    rows = rows._replace(lowest=-FREE * ones, highest=highest * ones, target=TARGET * ones, least=-ones, most=ones)
    begun = axial_rows.begin(rows, 2.5 * ones, change * ones)
    assert int(begun.holds[0]) == holds and float(begun.impulse[0]) == 1.0
    # What came of it is what the next round is begun with.
    free = begun._replace(holds=jnp.full(1, axial_rows.NOTHING))
    after, _ = axial_rows.choose(free, 2.6 * ones, begun.impulse)
    assert float(after.gain[0]) == pytest.approx(0.1, abs=1e-6)
