"""Training of a chunk policy on a data set: flow matching on windows of its episodes.

    rows, drawn uniformly -> observations, windows -> flow_loss -> AdamW with a warm-up, then a constant rate

Optimiser and defaults are those of the public benchmark of RTC (512 windows, 3e-4, decay 0.01, gradients of norm 10).
Some episodes are held out; their loss, on the same random numbers each time, says whether more steps still help. All
samples lie in the memory of the device (L: 0.6 GB for a million), and a program does many steps.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.delay.chunk_policy import ChunkPolicy, init_params
from kinetix_dist.delay.flow_matching import draw, flow_loss
from kinetix_dist.delay.windows import Samples, observations, windows
from kinetix_dist.env.environment import Environment
from kinetix_dist.setting import ConfigError, check_settings, setting

CLONING_STREAM = 0x464C4F57  # "FLOW"


@dataclasses.dataclass(frozen=True, kw_only=True)
class CloningConfig:
    """Settings of the training of a chunk policy."""

    steps: int = setting(50_000, minimum=1)  # gradient steps
    batch: int = setting(512, minimum=1)  # windows of a step
    learning_rate: float = setting(3e-4, above=0)
    warmup_steps: int = setting(1_000, minimum=0)  # in which it rises from 0
    weight_decay: float = setting(1e-2, minimum=0)
    max_grad_norm: float = setting(10.0, above=0)
    held_out: float = setting(0.05, above=0, below=1)  # share of episodes
    held_out_batch: int = setting(4096, minimum=1)  # windows of them, at most, of which the loss is taken
    report_every: int = setting(500, minimum=1)  # steps, in one program
    seed: int = setting(0, minimum=0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.steps % self.report_every:
            raise ConfigError(
                f"CloningConfig.steps is {self.steps}; it must be a multiple of report_every, {self.report_every}"
            )


class Learned(NamedTuple):
    """Training after some steps: all that the next ones follow from, with the settings and the samples."""

    steps: int
    params: Any
    state: Any  # of the optimiser


class Progress(NamedTuple):
    """After a report's steps."""

    learned: Learned
    loss: float  # mean over the steps since the last report
    held_out_loss: float

    @property
    def steps(self) -> int:
        return self.learned.steps

    @property
    def params(self) -> Any:
        return self.learned.params


def split_episodes(left: np.ndarray, held_out: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(rows to train on, rows held out), whole episodes each. left: `Samples.left`. Raises ValueError for fewer than
    two episodes."""
    starts = np.flatnonzero(np.r_[True, left[1:] >= left[:-1]]) if len(left) else np.zeros(0, int)
    if len(starts) < 2:
        raise ValueError(f"the data set has {len(starts)} episodes; cloning holds some out, so it takes 2 or more")
    order = np.random.default_rng((seed, CLONING_STREAM)).permutation(len(starts))
    is_out = np.zeros(len(starts), bool)
    is_out[order[: min(max(round(held_out * len(starts)), 1), len(starts) - 1)]] = True
    of_row = np.repeat(is_out, left[starts])
    return np.flatnonzero(~of_row), np.flatnonzero(of_row)


def untrained(policy: ChunkPolicy, env: Environment, samples: Samples, config: CloningConfig) -> Learned:
    """Training before its first step."""
    of_params, _, _ = _keys(config)
    first = samples._replace(dynamic_obs=jax.tree.map(lambda x: x[:1], samples.dynamic_obs), level=samples.level[:1])
    obs, _ = observations(env, jax.tree.map(jnp.asarray, first), jnp.zeros(1, jnp.int32), policy.history)
    params = init_params(policy, obs, of_params)
    return Learned(0, params, _optimizer(config).init(params))


def clone(
    policy: ChunkPolicy,
    env: Environment,
    samples: Samples,
    config: CloningConfig,
    *,
    max_delay: int = 0,
    begun: Learned | None = None,
    on_report: Callable[[Progress], None] = lambda progress: None,
) -> Any:
    """Parameters after `config.steps`. max_delay: `FlowConfig.max_delay`; begun: from which it goes on, after a
    multiple of `config.report_every` steps; on_report: gets each report. Raises ValueError for too few episodes, and at
    the first loss that is not finite, which no report has."""
    train, held_out = split_episodes(np.asarray(samples.left), config.held_out, config.seed)
    _, of_batches, of_held_out = _keys(config)
    chosen = np.random.default_rng((config.seed, CLONING_STREAM, 1)).permutation(held_out)[: config.held_out_batch]
    samples, train, chosen = jax.tree.map(jnp.asarray, (samples, train.astype(np.int32), chosen.astype(np.int32)))
    learned = untrained(policy, env, samples, config) if begun is None else begun
    while learned.steps < config.steps:
        drawing = _Drawing(of_batches, jnp.uint32(learned.steps), max_delay)
        params, state, loss = _many_steps(policy, env, config, learned[1:], samples, train, drawing)
        learned = Learned(learned.steps + config.report_every, params, state)
        out = _loss(policy, env, params, samples, chosen, of_held_out, max_delay)
        progress = Progress(learned, float(loss), float(out))
        if not math.isfinite(progress.loss) or not math.isfinite(progress.held_out_loss):
            raise ValueError(
                f"training has diverged by step {learned.steps:,} (loss {progress.loss:g}, held out "
                f"{progress.held_out_loss:g}); lower --learning-rate (checkpoints and state from before stay)"
            )
        on_report(progress)
    return learned.params


def _keys(config: CloningConfig) -> Array:
    """Keys of parameters, batches and held-out samples."""
    return prng.split(prng.fold_in(prng.key(config.seed), CLONING_STREAM), 3)


class _Drawing(NamedTuple):
    key: Array  # of batches
    first: Array  # number of the first step
    max_delay: int  # traced: policies that differ in it alone share a program


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _many_steps(
    policy: ChunkPolicy,
    env: Environment,
    config: CloningConfig,
    learned: tuple[Any, Any],
    samples: Samples,
    train: Array,
    drawing: _Drawing,
) -> tuple[Any, Any, Array]:
    """(parameters, state, mean loss) after `report_every` steps. learned: parameters and state before."""
    optimizer, (key, first, max_delay) = _optimizer(config), drawing

    def step(now: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        params, state = now
        of_rows, of_loss = prng.split(prng.fold_in(key, number))
        rows = train[prng.randint(of_rows, (config.batch,), 0, train.shape[0])]
        learn = jax.value_and_grad(_loss, argnums=2)
        loss, gradient = learn(policy, env, params, samples, rows, of_loss, max_delay)
        change, state = optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), loss

    (params, state), losses = jax.lax.scan(step, learned, first + jnp.arange(config.report_every, dtype=jnp.uint32))
    return params, state, jnp.mean(losses)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _loss(
    policy: ChunkPolicy,
    env: Environment,
    params: Any,
    samples: Samples,
    rows: Array,
    key: Array,
    max_delay: Array | int,
) -> Array:
    """Flow loss of windows that begin with rows [B]. The key is consumed."""
    obs, bound = observations(env, samples, rows, policy.history)
    chunk = windows(samples, rows, policy.horizon)
    actions = chunk.actions * bound[:, None]
    drawn = draw(key, actions.shape, max_delay)
    drawn = drawn._replace(noise=drawn.noise * bound[:, None])
    weight = chunk.counts[..., None] * bound[:, None].astype(jnp.float32)
    return flow_loss(policy.flow(params, obs, bound), actions, drawn, weight)


def _optimizer(config: CloningConfig) -> optax.GradientTransformation:
    rate = optax.join_schedules(
        [
            optax.linear_schedule(0.0, config.learning_rate, max(config.warmup_steps, 1)),
            optax.constant_schedule(config.learning_rate),
        ],
        [config.warmup_steps],
    )
    return optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.adamw(rate, weight_decay=config.weight_decay)
    )
