"""The compiled loop that steps packed worlds and takes samples of them; `recorder.record` is its public face."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.contact_report import ContactReport
from jax2d.engine import Engine, PackedScene
from jax2d.engine_argument import EngineArgument
from jax2d.fields import Array
from jax2d.scene import Controls, Touching


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A batch of packed worlds before its first step, and its controls."""

    scene: PackedScene
    state: Any  # packed
    controls: Controls  # [W, ...] if they stay, [S, W, ...] for each sample after the start


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sampling:
    """Choice of the samples that are taken."""

    num_samples: int  # after the start
    every: int = 1  # physics steps from sample to sample
    per_call: int  # samples that one call of the program takes: so many are on the device at a time
    joint_impulse: bool = False
    contacts: bool = False
    policy: Callable[[Any, Array], Controls] | None = None  # (State, time in s): controls in place of the run's


class Samples(NamedTuple):
    """S samples of W worlds."""

    position: Array  # [S, W, n, 2] m
    angle: Array  # [S, W, n] rad
    velocity: Array  # [S, W, n, 2] m/s
    angular_velocity: Array  # [S, W, n] rad/s
    overflow: Array  # [S, W] int32, contacts without a slot since the sample before
    limited: Array  # [S, W] int32, times a speed limit acted since the sample before
    invalid_controls: Array  # [S, W] int32, controls out of range since the sample before
    motor: Array  # [S, W, J] controls since the sample before, 0 at the start
    thruster: Array  # [S, W, T]
    joint_impulse: Array | None = None  # [S, W, J, 5] as in `State`
    contacts: ContactReport | None = None  # [S, W, K], empty at the start


Observer = Callable[[int, Any], None]  # (samples taken so far, packed state)


def take_samples(
    engine: EngineArgument, run: Run, sampling: Sampling, observe: Observer | None = None
) -> tuple[Samples, Any]:
    """(the start and `num_samples` more, on the host; packed state at the end). `observe` is called after each call of
    the compiled program."""
    packed = run.state
    parts = [jax.device_get(_start(engine.engine(), run, sampling))]
    taken = 0
    while taken < sampling.num_samples:
        count = min(sampling.per_call, sampling.num_samples - taken)
        part = dataclasses.replace(sampling, num_samples=count)
        now = dataclasses.replace(run, state=packed, controls=_part(run.controls, taken, count))
        packed, samples = _advance(engine, now, np.int32(taken), sampling=part)
        parts.append(jax.device_get(samples))
        taken += count
        if observe is not None:
            observe(taken, packed)
    return jax.tree.map(lambda *xs: np.concatenate(xs), *parts), packed


def _vary(controls: Controls) -> bool:
    return np.ndim(controls.motor) == 3


def _part(controls: Controls, taken: int, count: int) -> Controls:
    return jax.tree.map(lambda x: x[taken : taken + count], controls) if _vary(controls) else controls


@functools.partial(jax.jit, static_argnames=("sampling",))
def _advance(engine: EngineArgument, run: Run, taken: Array, *, sampling: Sampling) -> tuple[Any, Samples]:
    """The state after `sampling.num_samples` more samples, and these; `taken` before."""
    stepper = engine.engine()
    interval = stepper.settings.dt * sampling.every

    def one_sample(packed: Any, now: tuple[Array, Controls | None]) -> tuple[Any, Samples]:
        index, controls = now
        if sampling.policy is not None:
            controls = sampling.policy(stepper.unpack_state(packed), index * interval)
        elif controls is None:
            controls = run.controls
        packed, touching = stepper.step_packed(run.scene, packed, controls, sampling.every)
        return packed, _sample(stepper, packed, controls, touching, sampling)

    indices = taken + jnp.arange(sampling.num_samples, dtype=jnp.int32)
    varying = run.controls if _vary(run.controls) else None
    return jax.lax.scan(one_sample, run.state, (indices, varying), length=sampling.num_samples)


def _start(engine: Engine, run: Run, sampling: Sampling) -> Samples:
    """The first sample: as any, with nothing in it that happened before."""
    num_worlds = run.scene.missing.shape[-1]
    no_controls = engine.no_controls(num_worlds)
    _, touching = jax.eval_shape(functools.partial(engine.step_packed, num_steps=1), run.scene, run.state, no_controls)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), touching)
    if nothing.contacts is not None:
        none = jnp.full_like(nothing.contacts.a, -1)
        nothing = dataclasses.replace(nothing, contacts=dataclasses.replace(nothing.contacts, a=none, b=none))
    return jax.tree.map(lambda x: x[None], _sample(engine, run.state, no_controls, nothing, sampling))


def _sample(engine: Engine, packed: Any, controls: Controls, touching: Touching, sampling: Sampling) -> Samples:
    """One of the worlds as they stand, [W, ...]."""
    return Samples(
        *engine.bodies(packed),
        touching.overflow,
        touching.limited,
        touching.invalid_controls,
        controls.motor,
        controls.thruster,
        engine.unpack_state(packed).joint_impulse if sampling.joint_impulse else None,
        touching.contacts if sampling.contacts else None,
    )
