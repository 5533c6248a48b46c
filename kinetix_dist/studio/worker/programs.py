"""Compiled programs of sessions: one step of one world, and the choice of a policy.

Each is compiled once per environment and network, and stored in the compile cache of training.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.effects import names_of_bits
from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces.space import ActionSpace, controls_of
from kinetix_dist.env.action_spaces.truncated_normal import TruncatedNormal
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels, StepInfo
from kinetix_dist.evaluation.policies import NetworkPolicy, Policy, act
from kinetix_dist.level.goal_gap import GoalPairs, goal_gap
from kinetix_dist.level.level import Level
from kinetix_dist.studio.worker.wire import BAD_REQUEST, RequestError

MAX_ENVIRONMENTS = 16


def release_programs() -> None:
    """Frees compiled programs, 20 to 100 MB per size and network. The compile cache still has them."""
    environment.cache_clear()
    jax.clear_caches()
    gc.collect()
    trim_heap()


def trim_heap() -> None:
    """Returns memory that was freed after compiling, 30 to 100 MB, to the system, which glibc does not do itself."""
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)


class Stepped(NamedTuple):
    """Result of one step of W worlds, before any restart. [W, ...] on every field."""

    env_state: EnvState
    obs: Any
    reward: Array  # [W]
    done: Array  # [W] bool
    info: StepInfo
    poses: Array  # [W, n, 3] x, y (m), angle (rad)
    motor: Array  # [W, J] -1..1
    thruster: Array  # [W, T] 0..1
    colours: Array  # [W, 6] value of each colour's control


class PolicyInput(NamedTuple):
    """Input of a policy in one world: its random draws follow from seed and step alone."""

    obs: Any
    memory: Array | None  # before it acts
    seed: Array | int
    step: Array | int


class Choice(NamedTuple):
    """Choice of a policy in a state."""

    actions: Array  # [W, ...] of the environment's action space
    memory: Array | None  # after it
    value: Array  # [W], 0 of a policy that has none
    outputs: Array  # [W, P] see `heads_of`


@functools.lru_cache(maxsize=MAX_ENVIRONMENTS)
def environment(config: EnvConfig) -> Environment:
    """Environment of a configuration, cached: programs are compiled for it."""
    return Environment(config)


@functools.partial(jax.jit, static_argnums=0)
def prepare(env: Environment, levels: Level) -> PreparedLevels:
    """`Environment.prepare` of levels [W, ...] as one program.

    Outside of a program each of the 200 operations that find effects would be compiled on its own: 4 s and 220 MB.
    `check_effects` reads the effects afterwards.
    """
    return env.prepare(levels)


@functools.partial(jax.jit, static_argnums=0)
def reset(env: Environment, prepared: PreparedLevels) -> tuple[EnvState, Any]:
    """`Environment.reset`."""
    return env.reset(prepared)


def check_effects(prepared: PreparedLevels) -> None:
    """Raises RequestError for a level that calls for effects which no environment has."""
    bits = int(np.bitwise_or.reduce(np.asarray(prepared.packed_scene.missing)))
    if bits:
        raise RequestError(BAD_REQUEST, f"the level calls for {', '.join(names_of_bits(bits))}, which no size has")


@functools.partial(jax.jit, static_argnums=0)
def step(env: Environment, prepared: PreparedLevels, env_state: EnvState, actions: Array) -> Stepped:
    """`Environment.step` without its restart: the state that ends an episode is shown."""
    colour_values = env.action_space.colour_values(actions, env.action_space.in_range(actions))
    controls, _ = controls_of(
        env.action_space, actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
    )
    env_state, obs, reward, done, info = env.transition(prepared, env_state, actions)
    return Stepped(
        env_state=env_state,
        obs=obs,
        reward=reward,
        done=done,
        info=info,
        poses=poses(env, prepared, env_state),
        motor=controls.motor,
        thruster=controls.thruster,
        colours=jnp.concatenate(colour_values, axis=-1),
    )


@functools.partial(jax.jit, static_argnums=0)
def poses(env: Environment, prepared: PreparedLevels, env_state: EnvState) -> Array:
    """[W, n, 3] x, y (m), angle (rad) of every shape."""
    position, angle, _, _ = env.engine.bodies(env_state.packed_state)
    return jnp.concatenate([position, angle[..., None]], axis=-1)


@jax.jit
def gap(pairs: GoalPairs, poses: Array) -> Array:
    """`goal_gap` of shapes at poses [n, 3]."""
    return goal_gap(pairs, poses[:, :2], poses[:, 2])


@functools.partial(jax.jit, static_argnums=(0, 1))
def choose(
    env: Environment,
    policy: Policy,
    params: Any,
    prepared: PreparedLevels,
    given: PolicyInput,
) -> Choice:
    """Choice of a policy in one world. Draws as rollout 0 of `record_rollouts` with this seed does."""
    world_key = prng.fold_in(prng.key(given.seed), 0)
    keys = prng.fold_in(world_key, given.step)[None]
    memory = given.memory
    seen = env.observe(prepared, given.obs)
    actions, next_memory = act(policy, params, seen, keys, memory)
    if not isinstance(policy, NetworkPolicy):
        return Choice(actions, next_memory, jnp.zeros(1, jnp.float32), jnp.zeros((1, 0), jnp.float32))
    # The same application of the network as in `act`, which XLA computes once.
    outputs, value, *_ = policy.module.apply(params, seen, *(() if memory is None else (memory,)))
    if isinstance(policy.distribution, TruncatedNormal):
        shown = policy.distribution.mean_and_spread(outputs)
    else:
        shown = tuple(jax.nn.softmax(head.astype(jnp.float32)) for head in outputs)
    return Choice(actions, next_memory, value, jnp.concatenate(shown, axis=-1))


def heads_of(policy: Policy) -> dict[str, Any]:
    """Meaning of `Choice.outputs`: probabilities of the choices of each head, or means and then spreads of numbers."""
    if not isinstance(policy, NetworkPolicy):
        return {"kind": "none", "sizes": []}
    kind = "mean_spread" if isinstance(policy.distribution, TruncatedNormal) else "probabilities"
    return {"kind": kind, "sizes": list(policy.distribution.head_sizes)}


@functools.cache
def controls_of_outputs(space: ActionSpace) -> tuple[tuple[int | None, float | None], ...]:
    """Colour and value of each output of a policy in an action space, read off `colour_values`.

    colour: the index in a frame's `colours`; value: what its choice sets that colour to.
    colour None: a choice that drives none, or several. value None: a number (means, then spreads), no choice.
    """
    dimensions = range(space.num_dimensions)
    if space.is_integer:
        low, high = (np.asarray(ends, int) for ends in (space.low, space.high))
        choices = [(d, value) for d in dimensions for value in range(low[d], high[d] + 1)]
    else:
        choices = [(d, space.high[d]) for d in dimensions]
    actions = np.array(space.noop_actions(len(choices))).reshape(len(choices), space.num_dimensions)
    for row, (dimension, value) in zip(actions, choices, strict=True):
        row[dimension] = value
    given = actions[:, 0] if space.is_flat else actions
    changed = np.concatenate([np.asarray(part) for part in space.colour_values(given, space.in_range(given))], axis=-1)
    driven = [
        [int(c) for c in np.flatnonzero(changed[[d == own for d, _ in choices]].any(axis=0))] for own in dimensions
    ]
    if not space.is_integer:
        return tuple((colours[0] if len(colours) == 1 else None, None) for colours in driven) * 2
    found = []
    for row, (dimension, _) in zip(changed, choices, strict=True):
        colours = driven[dimension] if len(driven[dimension]) == 1 else np.flatnonzero(row).tolist()
        found.append((colours[0], float(row[colours[0]])) if len(colours) == 1 else (None, float(np.abs(row).max())))
    return tuple(found)
