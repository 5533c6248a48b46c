"""Playing a shard: worlds that each play one level again and again, one compiled scan.

    policy --> with probability `noise` a uniform action instead --> with probability `sticky` the action before instead
                                                                                            --> environment, transition

Sticky actions are those of Machado et al. (2018, section 5.2): they do not reach over the start of an episode.
Random numbers depend on the key, on the number of a world and on the step alone.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors import invariants
from kinetix_dist.actors.unroll import keys_of_worlds
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.evaluation.policies import NetworkPolicy, NoopPolicy, Player, Policy, first_memory
from kinetix_dist.models.gru import act, reset_memory

NOISE_STREAM, STICKY_STREAM, UNIFORM_STREAM = 1, 2, 3  # folded into the key of a world and step; the policy has 0


class ChosenBy(enum.IntEnum):
    """Source of an executed action: what a clone of the policy may learn from is `POLICY` alone."""

    POLICY = 0
    NOISE = 1
    STICKY = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Probabilities of a step that another action than the policy's is executed."""

    noise: float = 0.0  # a uniform one
    sticky: float = 0.0  # the one before

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not 0 <= value < 1:
                raise ValueError(f"Disturbance.{name} is {value}; it is a probability, from 0 to below 1")


class Played(NamedTuple):
    """T steps of W worlds, [W, T, ...] each."""

    dynamic_obs: Any
    actions: Array
    rewards: Array
    done: Array
    solved: Array
    timed_out: Array
    log_prob: Array
    chosen_by: Array


@functools.partial(jax.jit, static_argnames=("env", "policy", "disturbance", "num_steps"))
def play(
    env: Environment,
    policy: Policy,
    disturbance: Disturbance,
    num_steps: int,
    params: Any,
    prepared: PreparedLevels,
    key: Array,
) -> Played:
    """`num_steps` steps of every world from the start of its level. The key is consumed."""
    env_state, obs = env.reset(prepared)
    num_worlds = env_state.num_steps.shape[0]
    world_keys = keys_of_worlds(key, jnp.arange(num_worlds))
    space = env.action_space

    def step(carry: tuple, number: Array) -> tuple[tuple, Played]:
        env_state, obs, memory, before, is_first = carry
        keys = jax.vmap(prng.fold_in, (0, None))(world_keys, number)
        decided = _decide(Player(policy, params), env, prepared, obs, keys, memory)
        actions, chosen_by = _disturb(disturbance, space, decided.actions, before, is_first, keys)
        env_state, next_obs, reward, done, info = env.step(prepared, env_state, actions)
        taken = Played(
            dynamic_obs=obs,
            actions=actions.astype(space.stored_dtype),
            rewards=reward,
            done=done,
            solved=info.solved,
            timed_out=info.timed_out,
            log_prob=decided.log_prob(actions),
            chosen_by=chosen_by,
        )
        return (env_state, next_obs, reset_memory(decided.memory, done), actions, done), taken

    carry = (
        env_state,
        obs,
        first_memory(policy, num_worlds),
        space.noop_actions(num_worlds),
        jnp.ones(num_worlds, bool),
    )
    _, played = invariants.scan(step, carry, jnp.arange(num_steps, dtype=jnp.uint32))
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), played)


class _Decision(NamedTuple):
    actions: Array  # [W, ...], before any disturbance
    memory: Array | None
    log_prob: Callable[[Array], Array]  # [W] of any actions


def _decide(
    player: Player, env: Environment, prepared: PreparedLevels, obs: Any, keys: Array, memory: Array | None
) -> _Decision:
    policy, params = player
    seen = env.observe(prepared, obs)
    bound = prepared.bound_heads
    if isinstance(policy, NetworkPolicy):
        outputs, _, memory = act(policy.module, params, seen, memory)
        distribution, counted = policy.distribution, {} if bound is None else {"bound": bound}
        return _Decision(
            policy.choose(outputs, keys),
            memory,
            lambda actions: distribution.log_prob_and_entropy(outputs, actions, **counted)[0],
        )
    actions = policy(params, seen, keys)
    if isinstance(policy, NoopPolicy):  # it is certain of what it does
        return _Decision(actions, None, lambda other: jnp.where(_same(actions, other), 0.0, -jnp.inf))
    return _Decision(actions, None, lambda other: _uniform_log_prob(env.action_space, bound, len(keys)))


def _same(actions: Array, other: Array) -> Array:
    return (actions == other).reshape(len(actions), -1).all(axis=1)


def _uniform_log_prob(space: ActionSpace, bound: Array | None, num_worlds: int) -> Array:
    """[W]: logarithm of the probability, or of the density, of any action of the space."""
    each = [-math.log(high - low + space.is_integer) for low, high in zip(space.low, space.high)]
    counted = np.ones((num_worlds, len(each)), bool) if bound is None else bound
    return jnp.sum(jnp.where(counted, np.asarray(each, np.float32), 0.0), axis=-1)


def _disturb(
    disturbance: Disturbance, space: ActionSpace, actions: Array, before: Array, is_first: Array, keys: Array
) -> tuple[Array, Array]:
    """(actions that are executed, [W] int8 `ChosenBy`)."""
    chosen_by = jnp.full(len(keys), ChosenBy.POLICY, jnp.int8)

    def is_drawn(stream: int, probability: float) -> Array:
        return jax.vmap(lambda key: prng.uniform(prng.fold_in(key, stream)))(keys) < probability

    def put(mask: Array, other: Array, source: ChosenBy) -> tuple[Array, Array]:
        at = mask.reshape(-1, *(1,) * (actions.ndim - 1))
        return jnp.where(at, other, actions), jnp.where(mask, jnp.int8(source), chosen_by)

    if disturbance.noise:
        other = jax.vmap(lambda key: space.sample(prng.fold_in(key, UNIFORM_STREAM), 1)[0])(keys)
        actions, chosen_by = put(is_drawn(NOISE_STREAM, disturbance.noise), other, ChosenBy.NOISE)
    if disturbance.sticky:
        repeats = is_drawn(STICKY_STREAM, disturbance.sticky) & ~is_first
        actions, chosen_by = put(repeats, before, ChosenBy.STICKY)
    return actions, chosen_by
