"""Rollouts to record: play levels under jit, keep every state of the first episode, give them as numpy.

    for rollout in record_rollouts(env, policy, params, levels, key, policy_version=v):
        sink.write(rollout)                                 # telemetry/sinks/mcap.py
    recording = read_rollouts("a.mcap")                     # levels decoded, nothing else needed

Attempt `i` samples from the same keys as attempt `i` of `evaluate` with `attempts=1`: what is seen is what is scored.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Controls, index_worlds
from kinetix_dist.env.actions import controls_of
from kinetix_dist.env.environment import Environment, PreparedLevels
from kinetix_dist.env.observations.entities import observe
from kinetix_dist.evaluation.policies import Policy
from kinetix_dist.level.level import Level
from kinetix_dist.telemetry.mcap_reader import read_recording
from kinetix_dist.telemetry.recording import Recording, Rollout

RANDOM_POLICY_VERSION = -1  # what a rollout of no network is stamped with


def record_rollouts(
    env: Environment,
    policy: Policy,
    params: Any,
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
    num_levels = np.shape(levels.angle)[0]
    names = [f"level_{i}" for i in range(num_levels)] if names is None else list(names)
    if len(names) != num_levels:
        raise ValueError(f"{len(names)} names were given for {num_levels} levels")
    prepared = env.prepare(levels)
    history = jax.device_get(_play(env, policy, params, prepared, key))
    step_seconds = env.engine.settings.dt * env.config.frame_skip
    rollouts = []
    for i, name in enumerate(names):
        level = index_worlds(levels, i)
        length = int(np.argmax(history["done"][:, i])) + 1  # a time limit ends every episode
        world = {name: history[name][:length, i] for name in history}
        start = {
            "position": level.position,
            "angle": level.angle,
            "velocity": level.velocity,
            "angular_velocity": level.angular_velocity,
        }
        states = {
            name: np.concatenate([np.asarray(first, np.float32)[None], world[name]]) for name, first in start.items()
        }
        rollouts.append(
            Rollout(
                level=level,
                level_json=encode_level(level, name),
                level_name=name,
                **states,
                actions=world["actions"].reshape(length, -1).astype(np.float32),
                motor=world["motor"],
                thruster=world["thruster"],
                reward=world["reward"],
                solved=bool(world["solved"][-1]),
                failed=bool(world["failed"][-1]),
                policy_version=policy_version,
                seed=seed,
                step_seconds=float(step_seconds),
            )
        )
    return rollouts


def read_rollouts(path: str | os.PathLike[str]) -> Recording:
    """The rollouts of an MCAP recording, whole, cut or damaged: see telemetry/mcap_reader.py."""
    return read_recording(path, decode_level)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(env: Environment, policy: Policy, params: Any, prepared: PreparedLevels, key: Array) -> dict[str, Array]:
    """`max_steps` steps of every world: [T, W, ...] of the state each step led to, commands, reward, outcome."""
    env_state, obs = env.reset(prepared)
    num_worlds = env_state.num_steps.shape[0]
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num_worlds))

    def play(carry: tuple, step: Array) -> tuple[tuple, dict[str, Array]]:
        env_state, obs = carry
        step_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, step)
        actions = policy(params, observe(prepared.static_obs, obs), step_keys)
        controls, _ = controls_of(
            env.action_space, actions, prepared.motor_colour, prepared.motor_auto, prepared.thruster_colour
        )
        # The environment restarts a finished episode at once: its last state is only seen by stepping beside it.
        bodies = _bodies_after(env, prepared, env_state.packed_state, controls)
        env_state, obs, reward, done, info = env.step(prepared, env_state, actions)
        commands = {"actions": actions, "motor": controls.motor, "thruster": controls.thruster}
        outcome = {"reward": reward, "done": done, "solved": info.solved, "failed": info.failed}
        return (env_state, obs), {**bodies, **commands, **outcome}

    return jax.lax.scan(play, (env_state, obs), jnp.arange(env.config.max_steps))[1]


def _bodies_after(
    env: Environment, prepared: PreparedLevels, packed_state: Any, controls: Controls
) -> dict[str, Array]:
    after, _ = env.engine.step_packed(prepared.packed_scene, packed_state, controls, num_steps=env.config.frame_skip)
    return dict(zip(("position", "angle", "velocity", "angular_velocity"), env.engine.bodies(after)))
