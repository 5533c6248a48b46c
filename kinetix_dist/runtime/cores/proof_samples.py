"""Samples for imitation from proofs: each is replayed from the start of its level and from slightly different ones.

A search plays a thousand times as many steps a second as a network learns from, so it finds a solution where a policy
never does, and some thousand samples of that solution teach what a policy would need a first success for.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, stack_worlds
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.env_config import describe
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.evaluation.search.worlds import START_NOISE_M_S
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.level import Level
from kinetix_dist.level.proof import Proof, check_proof_is_of, proof_path, read_proof
from kinetix_dist.level.sets import files_of_set, read_level
from kinetix_dist.level.validate import read_document
from kinetix_dist.runtime.cores.imitation import IMITATION_STREAM, Samples

# That replay the proof of a level, half of them from its start, half from those by which searches measure robustness:
# more noise moves the states at which an action changes, and blurs when it does.
WORLDS = 64


def samples_of_proofs(config: TrainConfig, env: Environment) -> Samples:
    """Samples of the proofs of `curriculum.levels`. Raises ValueError for one that does not solve its level
    here, and as `levels_and_proofs`."""
    parts, static, bound = [], [], []
    rng = np.random.default_rng((config.run.seed, IMITATION_STREAM))
    for number, (level, proof) in enumerate(levels_and_proofs(config, env)):
        prepared = env.prepare(_starts(level, rng))
        dynamic, actions, returns = _successful_steps(env, prepared, proof, discount=config.ppo.discount)
        if not len(actions):
            raise ValueError(f"{proof.level}: its proof does not solve it; find it again: `levels solve --again`")
        static.append(jax.tree.map(lambda x: np.asarray(x)[0], prepared.static_obs))
        bound.append(np.asarray(prepared.bound_heads)[0])
        parts.append((dynamic, np.full(len(actions), number, np.int32), actions, returns))
    dynamic_obs, level, actions, returns = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return Samples(
        static_obs=jax.tree.map(lambda *x: np.stack(x), *static),
        dynamic_obs=dynamic_obs,
        level=level,
        actions=actions,
        returns=returns,
        has_return=np.ones(len(returns), np.float32),
        bound_heads=np.stack(bound),
    )


def levels_and_proofs(config: TrainConfig, env: Environment) -> list[tuple[Level, Proof]]:
    """Levels of `curriculum.levels` with their stored proofs. Raises ValueError or OSError, one line, where a level has
    none, or one of another level or of other settings."""
    return [_level_and_proof(file, env) for file in files_of_set(config.curriculum.levels)]


def _level_and_proof(file: Path, env: Environment) -> tuple[Level, Proof]:
    level, _ = read_level(file)
    path = proof_path(file)
    if not path.is_file():
        raise FileNotFoundError(f"run.imitation_steps: {file} has no proof ({path}); `levels solve` searches for one")
    proof = read_proof(path)
    limits = {"frame_skip": env.config.frame_skip, "max_steps": env.config.max_steps}
    check_proof_is_of(proof, path, read_document(file), preset=describe(env.config.physics), **limits)
    return fit_level(level, env.capacity), proof


def _starts(level: Level, rng: np.random.Generator) -> Level:
    """[WORLDS, ...]: the start of a level, and from the middle on with other velocities of all that moves."""
    levels, moves = stack_worlds([level] * WORLDS), level.scene.shapes.active & (level.scene.shapes.inverse_mass > 0)
    noise = rng.normal(0.0, START_NOISE_M_S, levels.velocity.shape) * moves[:, None]
    noise[: WORLDS // 2] = 0.0
    return dataclasses.replace(levels, velocity=(levels.velocity + noise).astype(np.float32))


def _successful_steps(
    env: Environment, prepared: PreparedLevels, proof: Proof, *, discount: float
) -> tuple[Any, np.ndarray, np.ndarray]:
    """(dynamic observations [B, ...], actions [B, 6], returns [B]) of worlds that the proof solves, up to the step that
    does."""
    actions = np.zeros((env.config.max_steps, WORLDS, proof.actions.shape[1]), np.int32)
    actions[: proof.num_steps] = proof.actions[:, None]
    obs, rewards, done, solved = jax.device_get(_replay(env, prepared, jnp.asarray(actions)))
    returns = np.zeros_like(rewards)
    for t in reversed(range(len(returns))):
        later = returns[t + 1] if t + 1 < len(returns) else 0.0
        returns[t] = rewards[t] + discount * np.where(done[t], 0.0, later)
    last = np.argmax(done, axis=0)  # a time limit ends every episode
    is_good = solved[last, np.arange(WORLDS)]
    step, world = np.nonzero((np.arange(len(actions))[:, None] <= last) & is_good)
    return jax.tree.map(lambda x: x[step, world], obs), actions[step, world], returns[step, world]


@functools.partial(jax.jit, static_argnums=0)
def _replay(env: Environment, prepared: PreparedLevels, actions: Array) -> tuple[Any, Array, Array, Array]:
    """[T, W, ...]: what was seen before each action, its reward, and whether it ended or solved the episode."""

    def step(carry: tuple[Any, Any], step_actions: Array) -> tuple[tuple[Any, Any], tuple[Any, Array, Array, Array]]:
        env_state, obs = carry
        env_state, next_obs, reward, done, info = env.step(prepared, env_state, step_actions)
        return (env_state, next_obs), (obs, reward, done, info.solved)

    return jax.lax.scan(step, env.reset(prepared), actions)[1]
