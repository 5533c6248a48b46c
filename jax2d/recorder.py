"""Records how worlds move: `record(engine, scene, state, controls, num_samples=600)` gives a `Trajectory`.

Controls may stay what they are, change from sample to sample, or be what a policy makes of each state. Everything is
stepped and sampled in compiled calls of many samples; what they record comes to the host after each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.checks import check_batches, check_controls, check_fixed, check_type, completed
from jax2d.engine import Engine
from jax2d.engine_argument import FixedEngine
from jax2d.fields import fields_of
from jax2d.sampling import Run, Samples, Sampling, take_samples
from jax2d.scene import Controls, Scene, State, index_worlds
from jax2d.settings import Settings
from jax2d.trajectory import Trajectory
from jax2d.whole_numbers import whole_number

MAX_SAMPLES_PER_CALL = 256  # more save next to nothing
MAX_BYTES_PER_CALL = 2**28  # samples that the device holds at a time, before they come to the host

Policy = Callable[[State, jax.Array], Controls]  # (state, time in s since the start) -> controls until the next sample


class ExtraRecords(TypedDict, total=False):
    """Keywords of `record`, which says what they mean."""

    joint_force: bool
    contacts: bool


def record(
    engine: Engine,
    scene: Scene,
    state: State,
    controls: Controls | Sequence[Controls] | Policy | None = None,
    *,
    num_samples: int,
    every: int = 1,
    **extras: Unpack[ExtraRecords],
) -> tuple[Trajectory, State]:
    """The trajectory of a world, or of a batch of worlds, and the state that it ends in.

    `scene` and `state` are what `engine.step` takes: of one world, or with a leading world axis on every field. The
    trajectory has T = num_samples + 1 samples. The first is `state`, each following one is `every` physics steps of
    `engine.settings.dt` later. `controls` are one of:

    - None: motors and thrusters do nothing.
    - `Controls` as `engine.step` takes them, which stay.
    - a sequence of `num_samples` of them, or `Controls` with an axis more in front, [num_samples, ...]: one for each
      interval between samples.
    - a function of (state, time in s since the start) that gives them, at each sample but the last. It is traced: JAX
      only. It sees the batch as it is given here. What it gives out of range is clamped and counted in
      `Trajectory.invalid_controls`; that of the others is refused.

    `joint_force` records what joints exert, too; `contacts` what contacts did in the last physics step before each
    sample, of an engine that reports them. Recording again from the returned state goes on where the trajectory ends.

    Raises ValueError for counts below 1, for controls of another number or shape, and what `engine.step` raises.
    """
    for name, count in (("num_samples", num_samples), ("every", every)):
        if whole_number(name, count) < 1:
            raise ValueError(f"{name} is {count}; give 1 or more")
    joint_force, contacts = _requested(**extras)
    if contacts and not engine.report_contacts:
        raise ValueError("this engine does not report contacts; build it with report_contacts=True")
    check_batches(scene, state)
    check_fixed(scene, state)
    batch = np.shape(state.angle)[:-1]
    policy = controls if callable(controls) else None
    given, change = _controls(engine, None if callable(controls) else controls, batch, num_samples)
    if not batch:
        scene, state = jax.tree.map(lambda x: x[None], (scene, state))
        given = jax.tree.map(lambda x: jnp.expand_dims(x, 1 if change else 0), given)
    bytes_per_sample = _bytes_per_sample(engine, batch, joint_force=joint_force, contacts=contacts)
    sampling = Sampling(
        num_samples=num_samples,
        every=every,
        per_call=max(1, min(MAX_SAMPLES_PER_CALL, MAX_BYTES_PER_CALL // bytes_per_sample)),
        joint_impulse=joint_force,
        contacts=contacts,
        policy=policy if policy is None or batch else _of_one_world(policy),
    )
    run = Run(scene=engine.pack_scene(scene), state=engine.pack_state(state), controls=given)
    samples, packed = take_samples(FixedEngine(engine), run, sampling)
    trajectory = trajectory_of(samples, jax.tree.map(_in_float64, scene), engine.settings, every)
    last = engine.unpack_state(packed)
    return (trajectory, last) if batch else (trajectory.world(0), index_worlds(last, 0))


def trajectory_of(samples: Samples, scene: Scene, settings: Settings, every: int = 1) -> Trajectory:
    """Trajectory of a batch. `settings` are those that it was stepped with."""
    impulse = samples.joint_impulse
    return Trajectory(
        scene=scene,
        interval=settings.dt * every,
        position=_in_float64(samples.position),
        angle=_counting_turns(samples, settings, settings.dt * every),
        velocity=_in_float64(samples.velocity),
        angular_velocity=_in_float64(samples.angular_velocity),
        motor=_in_float64(samples.motor),
        thruster=_in_float64(samples.thruster),
        joint_force=None if impulse is None else _in_float64(impulse[..., :2]) / settings.substep_seconds,
        overflow=np.asarray(samples.overflow),
        limited=np.asarray(samples.limited),
        invalid_controls=np.asarray(samples.invalid_controls),
        contacts=jax.tree.map(_in_float64, samples.contacts),
    )


def _counting_turns(samples: Samples, settings: Settings, interval: float) -> np.ndarray:
    """[T, ...] rad: of angles within half a turn those nearest to what the speeds at both ends of an interval give."""
    angle, speed = _in_float64(samples.angle), _in_float64(samples.angular_velocity)
    if settings.solver != "soft_step":  # it counts them itself
        return angle
    expected = 0.5 * (speed[1:] + speed[:-1]) * interval
    turns = np.cumsum(np.round((expected - np.diff(angle, axis=0)) / math.tau), axis=0)
    return np.concatenate([angle[:1], angle[1:] + math.tau * turns])


def _controls(
    engine: Engine, controls: Controls | Sequence[Controls] | None, batch: tuple[int, ...], num_samples: int
) -> tuple[Controls, bool]:
    """(checked, whether they change): [*batch, ...] on every field if they stay, else [num_samples, *batch, ...]."""
    if controls is None:
        return engine.no_controls(*batch), False
    if not isinstance(controls, Controls):
        if not isinstance(controls, Sequence):
            check_type("controls", controls, Controls)
        if len(controls) != num_samples:
            raise ValueError(f"{len(controls)} controls for {num_samples} samples; give one for each")
        controls = [completed(one, engine.capacity, engine.dtype, batch=batch) for one in controls]
        for one in controls:
            check_controls(one, engine.capacity, engine.dtype, batch=batch)
        controls = jax.tree.map(lambda *xs: np.stack([np.asarray(x) for x in xs]), *controls)
    given = [(field, x) for field in fields_of(Controls) if (x := field.get(controls)) is not None]
    change = all(np.ndim(x) == 1 + len(batch) + len(field.dims) for field, x in given)
    shape = (num_samples, *batch) if change else batch
    controls = completed(controls, engine.capacity, engine.dtype, batch=shape)
    check_controls(controls, engine.capacity, engine.dtype, batch=shape)
    return jax.tree.map(lambda x: jnp.asarray(x, engine.dtype), controls), change


def _of_one_world(policy: Policy) -> Policy:
    """The policy of a single world for a batch of one."""

    def of_batch(state: State, time: jax.Array) -> Controls:
        controls = policy(index_worlds(state, 0), time)
        check_type("what the policy gave", controls, Controls)
        return jax.tree.map(lambda x: x[None], controls)

    return of_batch


def _requested(*, joint_force: bool = False, contacts: bool = False) -> tuple[bool, bool]:
    return joint_force, contacts


def _bytes_per_sample(engine: Engine, batch: tuple[int, ...], *, joint_force: bool, contacts: bool) -> int:
    capacity = engine.capacity
    numbers = 6 * capacity.shapes + (5 * capacity.joints if joint_force else 0) + 2  # as in `Samples`
    numbers += capacity.joints + capacity.thrusters + 1 + (9 * capacity.contact_slots if contacts else 0)
    return engine.dtype.itemsize * numbers * max(1, math.prod(batch))


def _in_float64(x: Any) -> np.ndarray:
    """A copy as numpy; flags and counts keep their type."""
    x = np.array(x)
    return x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x
