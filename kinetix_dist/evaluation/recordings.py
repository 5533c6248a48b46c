"""Rollouts to record: play levels under jit, keep every state of the first episode, give them as numpy.

    for rollout in record_rollouts(env, player, levels, key, policy_version=v):
        sink.write(rollout)                                 # telemetry/sinks/mcap.py
    recording = read_rollouts("a.mcap")                     # levels decoded, nothing else needed

Attempt `i` samples from the same keys as attempt `i` of `evaluate` with `attempts=1`: what is seen is what is scored.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Sequence
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, index_worlds
from kinetix_dist import prng
from kinetix_dist.env.action_spaces.space import controls_of
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.evaluation.policies import Player, Policy, act, first_memory
from kinetix_dist.level.level import Level
from kinetix_dist.level.schema import LevelInfo, level_as_written, level_to_json
from kinetix_dist.telemetry.mcap_reader import read_recording
from kinetix_dist.telemetry.recording import Recording, Rollout
from kinetix_dist.text_files import loads_json

RANDOM_POLICY_VERSION = -1  # what a rollout of no network is stamped with


def record_rollouts(
    env: Environment,
    player: Player,
    levels: Level,
    key: Array,
    *,
    names: Sequence[str] | None = None,
    policy_version: int = RANDOM_POLICY_VERSION,
    seed: int = 0,
) -> list[Rollout]:
    """One rollout, the first episode, of every level of a batch ([W, ...]).

    The key is consumed; `seed` is only written down. Compiles once for each (env, policy, number of levels); keeps
    `max_steps` states of every world at once: 30 kB a level of size S, 60 kB of L.
    """
    levels = jax.device_get(levels)
    history = jax.device_get(_play(env, *player, env.prepare(levels), key))
    return _rollouts(env, levels, names, history, policy_version=policy_version, seed=seed)


def record_actions(
    env: Environment, levels: Level, actions: Array, *, names: Sequence[str] | None = None
) -> list[Rollout]:
    """The same for actions that are known beforehand, [max_steps, W, ...] of the environment's action space."""
    if len(actions) != env.config.max_steps:
        raise ValueError(f"actions are {len(actions)} steps; an episode has {env.config.max_steps}")
    for step in actions:
        env.action_space.check(step, np.shape(levels.angle)[0])
    levels = jax.device_get(levels)
    history = jax.device_get(_play_actions(env, env.prepare(levels), jnp.asarray(actions)))
    return _rollouts(env, levels, names, history, policy_version=RANDOM_POLICY_VERSION, seed=0)


def play_policy(env: Environment, player: Player, prepared: PreparedLevels, key: Array) -> np.ndarray:
    """[max_steps, W, ...]: the actions of `record_rollouts`, for who needs nothing else. The key is consumed."""
    return np.asarray(_play(env, *player, prepared, key)["actions"])


def _rollouts(
    env: Environment,
    levels: Level,
    names: Sequence[str] | None,
    history: dict[str, np.ndarray],
    *,
    policy_version: int,
    seed: int,
) -> list[Rollout]:
    """One rollout a level out of the history of all."""
    num_levels = np.shape(levels.angle)[0]
    names = [f"level_{i}" for i in range(num_levels)] if names is None else list(names)
    if len(names) != num_levels:
        raise ValueError(f"{len(names)} names were given for {num_levels} levels")
    step_seconds = env.engine.settings.dt * env.config.frame_skip
    rollouts = []
    for i, name in enumerate(names):
        length = int(np.argmax(history["done"][:, i])) + 1  # a time limit ends every episode
        world = {field: values[:length, i] for field, values in history.items()}
        level, level_json = index_worlds(levels, i), encode_level(index_worlds(levels, i), name, env.config.size)
        rollouts.append(
            Rollout(
                level=decode_level(level_json),  # what a reader of the recording will have
                level_json=level_json,
                level_name=name,
                **_trajectory(level, world),
                solved=bool(world["solved"][-1]),
                failed=bool(world["failed"][-1]),
                unstable=bool(world["unstable"][-1]),
                policy_version=policy_version,
                seed=seed,
                step_seconds=float(step_seconds),
                action_names=env.action_space.action_names,
            )
        )
    return rollouts


def encode_level(level: Level, name: str, size: str) -> str:
    """A level as the text that a recording holds: a document of the level format on one line."""
    return json.dumps(level_to_json(level, LevelInfo(name=name, size=size)), allow_nan=False, separators=(",", ":"))


def decode_level(text: str) -> Level:
    """The level of a recording, its motors as they were when actions were recorded. Raises LevelFormatError."""
    return level_as_written(loads_json(text))


def read_rollouts(path: str | os.PathLike[str]) -> Recording:
    """The rollouts of an MCAP recording, whole, cut or damaged: see telemetry/mcap_reader.py."""
    return read_recording(path, decode_level)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(env: Environment, policy: Policy, params: Any, prepared: PreparedLevels, key: Array) -> dict[str, Array]:
    """`max_steps` steps of every world: [T, W, ...] of the state each step led to, commands, reward, outcome."""
    env_state, obs = env.reset(prepared)
    num_worlds = env_state.num_steps.shape[0]
    keys = jax.vmap(prng.fold_in, in_axes=(None, 0))(key, jnp.arange(num_worlds))

    def play(carry: tuple, step: Array) -> tuple[tuple, dict[str, Array]]:
        env_state, obs, memory = carry
        step_keys = jax.vmap(prng.fold_in, in_axes=(0, None))(keys, step)
        actions, memory = act(policy, params, env.observe(prepared, obs), step_keys, memory)
        env_state, obs, seen = _step_seen(env, prepared, env_state, actions)
        return (env_state, obs, memory), seen

    return jax.lax.scan(play, (env_state, obs, first_memory(policy, num_worlds)), jnp.arange(env.config.max_steps))[1]


@functools.partial(jax.jit, static_argnums=0)
def _play_actions(env: Environment, prepared: PreparedLevels, actions: Array) -> dict[str, Array]:
    """Result of `_play` for actions [T, W, ...]."""

    def play(env_state: Any, step_actions: Array) -> tuple[Any, dict[str, Array]]:
        env_state, _, seen = _step_seen(env, prepared, env_state, step_actions)
        return env_state, seen

    return jax.lax.scan(play, env.reset(prepared)[0], actions)[1]


def _step_seen(
    env: Environment, prepared: PreparedLevels, env_state: EnvState, actions: Array
) -> tuple[EnvState, Any, dict[str, Array]]:
    """One step of every world: (env_state, obs, what is recorded of it)."""
    controls, _ = controls_of(
        env.action_space, actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
    )
    # The environment restarts a finished episode at once: its last state is only seen by stepping the engine alone.
    bodies = env.bodies_after(prepared, env_state, controls)
    env_state, obs, reward, done, info = env.step(prepared, env_state, actions)
    commands = {"actions": actions, "motor": controls.motor, "thruster": controls.thruster}
    ended = {"done": done, "solved": info.solved, "failed": info.failed, "unstable": info.unstable}
    return env_state, obs, {**bodies, **commands, **ended, "reward": reward}


class _Arrays(TypedDict):
    """The arrays of a Rollout."""

    position: np.ndarray
    angle: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    actions: np.ndarray
    motor: np.ndarray
    thruster: np.ndarray
    reward: np.ndarray


def _trajectory(level: Level, world: dict[str, np.ndarray]) -> _Arrays:
    """The arrays of a Rollout, slots in the order of the level format: what is not there comes last of its kind."""
    active = np.asarray(level.scene.shapes.active)
    num_polygons = np.shape(level.scene.shapes.vertices)[0]
    shapes = np.concatenate([_active_first(active[:num_polygons]), num_polygons + _active_first(active[num_polygons:])])
    joints = _active_first(np.asarray(level.scene.joints.active))
    thrusters = _active_first(np.asarray(level.scene.thrusters.active))

    def states(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(getattr(level, name), np.float32)[None], world[name]])[:, shapes]

    return {
        "position": states("position"),
        "angle": states("angle"),
        "velocity": states("velocity"),
        "angular_velocity": states("angular_velocity"),
        "actions": world["actions"].reshape(len(world["actions"]), -1).astype(np.float32),
        "motor": world["motor"][:, joints],
        "thruster": world["thruster"][:, thrusters],
        "reward": world["reward"],
    }


def _active_first(active: np.ndarray) -> np.ndarray:
    return np.argsort(~active, kind="stable")
