"""Imitation before training: behaviour cloning (Pomerleau 1991) of samples, whatever they come from.

    proofs of curriculum.levels (`proof_samples.py`) --+
                                                       +--> samples: observations, actions, returns
    transitions of a data set (`dataset_samples.py`) --+

    loss = -mean log p(action | observation) + c / 2 mean (value - return)^2, linearly decaying Adam
                                                                             --> parameters that training goes on from

Samples of levels that are held out tell loss and accuracy there, and may say when to stop (`imitation.patience`): where
no more of their actions were alike for so many evaluations, with the parameters of the most. By default they do not:
what a policy solves still grows where loss and accuracy there no longer do (docs/data.md).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.config import ImitationConfig
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.environment import Environment

MAX_GRAD_NORM = 0.5
VALUE_COEFFICIENT = 0.5
IMITATION_STREAM = 0x494D4954  # "IMIT": key of noise, of what is held out and of batches
LIKE = 0.1  # of the range of a dimension: so near is a most likely action like the one that was taken


class DivergedError(Exception):
    """Imitation reached a loss that is not finite."""


class Samples(NamedTuple):
    """B observations and the actions taken there."""

    static_obs: Any  # [L, ...] of each level
    dynamic_obs: Any  # [B, ...]
    level: Array  # [B] int32, index into static_obs
    actions: Array  # [B, 6] or [B]
    returns: Array  # [B] float32, discounted, to the end of the episode
    has_return: Array  # [B] float32, 1; 0 where that end was not seen
    bound_heads: Array  # [L, heads] bool, of each level


class Source(NamedTuple):
    """Samples to imitate, as many at a time as fit into memory."""

    pools: Iterator[tuple[Samples, int]]  # without end: samples of one shape, and how many of the first ones count
    steps_per_pool: int  # gradient steps until the next one; 0: there is one
    held_out: Samples | None = None  # by which it is scored, and may stop early
    about: Callable[[], dict[str, Any]] = dict  # for the event of the run


class Imitated(NamedTuple):
    """Result of `imitate`."""

    params: Any
    steps: int  # gradient steps that led to them
    loss: float  # mean of the last tenth of the steps that were taken
    curve: list[dict[str, float]]  # of the samples held out: step, loss, accuracy


def one_pool(samples: Samples) -> Source:
    """Source of so few samples that they fit into memory."""

    def pools() -> Iterator[tuple[Samples, int]]:
        while True:
            yield samples, len(samples.actions)

    return Source(pools(), steps_per_pool=0)


def imitate(
    env: Environment, policy: Any, params: Any, source: Source, config: ImitationConfig, *, steps: int, seed: int
) -> Imitated:
    """At most so many gradient steps. Raises DivergedError for a loss that is not finite, after at most
    `config.every` more steps."""
    programs = _programs(env, policy, config.batch_size, config.learning_rate, steps)
    samples, count = next(source.pools)
    samples, weights = jax.tree.map(jnp.asarray, samples), class_weights(env.action_space, samples, count, config)
    held_out = None if source.held_out is None else jax.tree.map(jnp.asarray, source.held_out)
    state, key, losses = programs.optimizer.init(params), prng.fold_in(prng.key(seed), IMITATION_STREAM), []
    best, curve = Best(config.patience), []
    for number in range(steps):
        if source.steps_per_pool and number and number % source.steps_per_pool == 0:
            samples, count = next(source.pools)
            samples = jax.tree.map(jnp.asarray, samples)
        pool = samples, jnp.int32(count), weights
        params, state, loss = programs.step(params, state, pool, prng.fold_in(key, number))
        losses.append(loss)
        if (number + 1) % config.every and number + 1 < steps:
            continue
        _check_finite(losses[-config.every :], params, number + 1)
        if held_out is None:
            continue
        loss, accuracy = programs.score(params, held_out)
        curve.append({"step": number + 1, "loss": round(float(loss), 5), "accuracy": round(float(accuracy), 5)})
        if config.patience and best.is_enough(float(accuracy), (number + 1, params)):
            break
    at, params = best.kept or (len(losses), params)
    return Imitated(params, at, float(np.mean(jax.device_get(losses[-max(len(losses) // 10, 1) :]))), curve)


def _check_finite(losses: Sequence[Array], params: Any, steps: int) -> None:
    """Raise DivergedError for a loss or a parameter that is not finite.

    Args:
        losses: Those of the last gradient steps.
        params: Parameters after them.
        steps: Gradient steps so far.
    """
    is_finite = np.isfinite(np.array(jax.device_get([*losses, *map(jnp.sum, jax.tree.leaves(params))])))
    if not is_finite.all():
        step = min(steps - len(losses) + int(np.argmin(is_finite)) + 1, steps)
        raise DivergedError(
            f"imitation has diverged at gradient step {step:,}: its loss is not finite; lower imitation.learning_rate"
        )


class Best:
    """Candidate with the highest score, the first of equals."""

    def __init__(self, patience: int) -> None:
        self.kept: Any = None
        self._patience = patience
        self._score = -math.inf
        self._waited = 0

    def is_enough(self, score: float, kept: Any) -> bool:
        """True where `patience` scores in a row were no higher. A score that is no number is none."""
        self._waited += 1
        if score > self._score:
            self._score, self.kept, self._waited = score, kept, 0
        return self._waited >= self._patience


def class_weights(space: ActionSpace, samples: Samples, count: int, config: ImitationConfig) -> Array | None:
    """[dimensions, choices] float32, weight of each choice: (mean frequency / its own)^`class_balance`, 1 on average
    over the samples of its dimension. None: all weigh the same."""
    if not config.class_balance:
        return None
    bound = np.asarray(samples.bound_heads)[np.asarray(samples.level[:count])]
    actions, num_choices = np.asarray(samples.actions[:count]), int(max(space.high)) + 1
    weights = np.ones((space.num_dimensions, num_choices), np.float32)
    for dimension in range(space.num_dimensions):
        found = np.bincount(actions[bound[:, dimension], dimension], minlength=num_choices)
        if found.any():
            raw = np.where(found, found.sum() / np.maximum(found, 1), 0.0) ** config.class_balance
            weights[dimension] = raw * found.sum() / (raw * found).sum()
    return jnp.asarray(weights)


@dataclasses.dataclass(frozen=True)
class _Programs:
    step: Callable[..., Any]
    score: Callable[..., Any]
    optimizer: optax.GradientTransformation


@functools.lru_cache(maxsize=2)
def _programs(env: Environment, policy: Any, batch_size: int, learning_rate: float, steps: int) -> _Programs:
    rate = optax.linear_schedule(learning_rate, 0.0, steps)
    optimizer = optax.chain(optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adam(rate, eps=1e-5))

    def played(params: Any, samples: Samples, index: Array) -> tuple[Any, Array, dict[str, Array]]:
        """Outputs and values of the policy at some samples, and which dimensions count there."""
        level = samples.level[index]
        static, bound = jax.tree.map(lambda x: x[level], (samples.static_obs, samples.bound_heads))
        obs = env.observation.join(static, jax.tree.map(lambda x: x[index], samples.dynamic_obs))
        outputs, values = policy.apply(params, obs)
        return outputs, values, {"bound": bound} if env.action_space.has_bound_heads else {}

    @jax.jit
    def step(params: Any, state: Any, pool: tuple[Samples, Array, Array | None], key: Array) -> tuple[Any, Any, Array]:
        samples, count, weights = pool
        index = jnp.minimum((prng.uniform(key, (batch_size,)) * count).astype(jnp.int32), count - 1)

        def loss(params: Any) -> Array:
            outputs, values, bound = played(params, samples, index)
            actions = samples.actions[index]
            errors = jnp.square(values - samples.returns[index]) * samples.has_return[index]
            return -jnp.mean(_log_probs(env, outputs, actions, bound, weights)) + 0.5 * VALUE_COEFFICIENT * jnp.mean(
                errors
            )

        value, gradient = jax.value_and_grad(loss)(params)
        change, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, change), state, value

    @jax.jit
    def score(params: Any, samples: Samples) -> tuple[Array, Array]:
        """(mean of -log p, share of the dimensions that count whose most likely action is like that taken)."""
        number = samples.actions.shape[0]

        def of_batch(start: Array) -> tuple[Array, Array, Array]:
            index = start + jnp.arange(batch_size)
            is_there = index < number
            index = jnp.minimum(index, number - 1)
            outputs, _, bound = played(params, samples, index)
            actions = samples.actions[index]
            log_probs = _log_probs(env, outputs, actions, bound, None)
            is_like = _is_like(env, env.action_distribution.mode(outputs), actions)
            counts = is_there[:, None] & bound.get("bound", jnp.ones_like(is_like))
            return jnp.sum(log_probs * is_there), jnp.sum(is_like & counts), jnp.sum(counts)

        sums = jax.lax.map(of_batch, jnp.arange(0, number, batch_size))
        log_prob, num_like, num_counted = jax.tree.map(jnp.sum, sums)
        return -log_prob / number, num_like / jnp.maximum(num_counted, 1)

    return _Programs(step, score, optimizer)


def _log_probs(env: Environment, outputs: Any, actions: Array, bound: dict[str, Array], weights: Array | None) -> Array:
    """[B] log-probability, summed over the dimensions that count, each with the weight of its choice."""
    distribution = env.action_distribution
    if weights is None:
        return distribution.log_prob_and_entropy(outputs, actions, **bound)[0]

    def of_dimension(only: Array) -> Array:
        return distribution.log_prob_and_entropy(outputs, actions, bound=bound["bound"] & only)[0]

    each = jax.vmap(of_dimension)(jnp.eye(env.action_space.num_dimensions, dtype=bool))  # [dimensions, B]
    chosen = jax.vmap(lambda of_choices, taken: of_choices[taken])(weights, actions.T.astype(jnp.int32))
    return jnp.sum(each * chosen, axis=0)


def _is_like(env: Environment, modes: Array, actions: Array) -> Array:
    """[B, dimensions] bool; numbers of choices are like themselves alone."""
    space = env.action_space
    reach = LIKE * (np.asarray(space.high, np.float32) - np.asarray(space.low, np.float32))
    shape = (len(actions), space.num_dimensions)
    distance = jnp.abs(modes.astype(jnp.float32) - actions.astype(jnp.float32)).reshape(shape)
    return distance <= jnp.where(space.is_integer, 0.0, reach)
