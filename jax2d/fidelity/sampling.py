"""The compiled loop that steps packed worlds and takes samples of them; `trajectory.record` is its public face."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.engine import Engine, PackedScene
from jax2d.fidelity.engine_argument import EngineArgument
from jax2d.fields import Array
from jax2d.scene import Controls


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A batch of packed worlds before its first step, and its constant controls."""

    scene: PackedScene
    state: Any  # packed
    controls: Controls  # [W, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sampling:
    """Which samples are taken."""

    num_samples: int  # after the start
    every: int = 1  # physics steps from sample to sample
    per_call: int  # samples that one call of the program takes: so many are on the device at a time
    joint_impulse: bool = False


class Samples(NamedTuple):
    """S samples of W worlds."""

    position: Array  # [S, W, n, 2] m
    angle: Array  # [S, W, n] rad
    velocity: Array  # [S, W, n, 2] m/s
    angular_velocity: Array  # [S, W, n] rad/s
    overflow: Array  # [S, W] int32, contacts without a slot since the sample before
    limited: Array  # [S, W] int32, times a speed limit acted since the sample before
    joint_impulse: Array | None  # [S, W, J, 5] as in `State`


Observer = Callable[[int, Any], None]  # (samples taken so far, packed state)


def take_samples(
    engine: EngineArgument, run: Run, sampling: Sampling, observe: Observer | None = None
) -> tuple[Samples, Any]:
    """(the start and `num_samples` more, on the host; packed state at the end). `observe` is called after each call of
    the compiled program."""
    packed = run.state
    parts = [jax.device_get(_start(engine.engine(), packed, sampling))]
    taken = 0
    while taken < sampling.num_samples:
        count = min(sampling.per_call, sampling.num_samples - taken)
        packed, samples = _advance(
            engine, run, packed, every=sampling.every, num_samples=count, joint_impulse=sampling.joint_impulse
        )
        parts.append(jax.device_get(samples))
        taken += count
        if observe is not None:
            observe(taken, packed)
    return jax.tree.map(lambda *xs: np.concatenate(xs), *parts), packed


@functools.partial(jax.jit, static_argnames=("every", "num_samples", "joint_impulse"))
def _advance(
    engine: EngineArgument, run: Run, packed: Any, *, every: int, num_samples: int, joint_impulse: bool
) -> tuple[Any, Samples]:
    stepper = engine.engine()

    def one_sample(packed: Any, _: None) -> tuple[Any, Samples]:
        packed, touching = stepper.step_packed(run.scene, packed, run.controls, every)
        return packed, _sample(stepper, packed, touching.overflow, touching.limited, joint_impulse)

    return jax.lax.scan(one_sample, packed, length=num_samples)


def _start(engine: Engine, packed: Any, sampling: Sampling) -> Samples:
    none = jnp.zeros(jax.tree.leaves(packed)[0].shape[-1], jnp.int32)
    return jax.tree.map(lambda x: x[None], _sample(engine, packed, none, none, sampling.joint_impulse))


def _sample(engine: Engine, packed: Any, overflow: Array, limited: Array, joint_impulse: bool) -> Samples:
    """One of the worlds as they stand, [W, ...]."""
    impulse = engine.unpack_state(packed).joint_impulse if joint_impulse else None
    return Samples(*engine.bodies(packed), overflow, limited, impulse)
