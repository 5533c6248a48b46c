"""Policy that gives chunks of actions by flow matching: settings, network, units, checkpoint.

    policy = ChunkPolicy(network=..., space=env.action_space, num_steps=5)
    flow = policy.flow(params, obs, bound)                 embeds observations once
    chunk = integrate(flow, policy.noise(keys, bound), policy.num_steps)
    actions = policy.actions(chunk)                        in the units of the action space

Inside, an action is in -1..1 in every dimension. Dimensions that nothing in a level obeys (`ActionSpace.bound_heads`)
are 0 throughout: policies that act there at random would otherwise fill data, guidance and distances with noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.checkpoint import (
    Checkpoint,
    CheckpointError,
    flatten_arrays,
    load_checkpoint,
    newest_good,
    save_checkpoint,
    select_arrays,
    unflatten_arrays,
)
from kinetix_dist.config.plain import build, to_dict
from kinetix_dist.delay.flow_matching import Velocity
from kinetix_dist.delay.history import begun, seen
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.walls import empty_level
from kinetix_dist.models.flow_network import FlowNetwork
from kinetix_dist.models.policy import PolicyConfig, make_encoder
from kinetix_dist.setting import MAX_LAYERS, MAX_WIDTH, ConfigError, check_settings, setting
from kinetix_dist.trained_policy import CHUNK_POLICY

PARAMS_PREFIX = "flow/params"  # of the arrays of a checkpoint


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlowConfig:
    """Settings of a chunk policy; widths and steps are those of the public benchmark (models/flow_network.py)."""

    horizon: int = setting(16, minimum=1, maximum=1000)  # actions of a chunk
    integration_steps: int = setting(5, minimum=1, maximum=1000)  # K, Euler steps from noise to a chunk
    history: int = setting(
        0, minimum=0, maximum=1000
    )  # steps before the present one whose observation and action it sees
    max_delay: int = setting(0, minimum=0)  # training-time RTC: longest delay that training simulates; 0: none
    width: int = setting(256, minimum=2, maximum=MAX_WIDTH)  # channels of an action's token
    token_width: int = setting(64, minimum=1, maximum=MAX_WIDTH)
    num_layers: int = setting(4, minimum=1, maximum=MAX_LAYERS)
    # Network that reads observations; its actor and critic are left out.
    encoder: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.width % 2:
            raise ConfigError(f"FlowConfig.width is {self.width}; it must be even")
        if self.max_delay >= self.horizon:
            raise ConfigError(
                f"FlowConfig.max_delay is {self.max_delay}, but a chunk has {self.horizon} actions; it must be less"
            )


@dataclasses.dataclass(frozen=True)
class ChunkPolicy:
    """A network and the units of its actions. Hashable: static under jit."""

    network: FlowNetwork
    space: ActionSpace
    num_steps: int  # K
    history: int = 0

    @property
    def horizon(self) -> int:
        return self.network.horizon

    def flow(self, params: Any, obs: Any, bound: Array) -> Velocity:
        """Velocity of chunks given observations [B, ...]. bound [B, A] bool."""
        embedding = self.network.apply(params, obs, method="encode")
        return self.flow_of(params, embedding, bound)

    def flow_of(self, params: Any, embedding: Array, bound: Array) -> Velocity:
        mask = bound[:, None]

        def velocity(chunk: Array, time: Array) -> Array:
            return mask * self.network.apply(params, embedding, chunk * mask, time, method="velocity")

        return velocity

    def noise(self, keys: Array, bound: Array) -> Array:
        """[B, H, A] of the keys [B] of worlds: a world's chunk does not depend on the others."""
        shape = (self.horizon, self.space.num_dimensions)
        return jax.vmap(lambda key: prng.normal(key, shape))(keys) * bound[:, None]

    def actions(self, chunk: Array) -> Array:
        """Actions [..., A] of chunks in -1..1; what lies beyond acts as the end."""
        low, high = np.asarray(self.space.low, np.float32), np.asarray(self.space.high, np.float32)
        return jnp.clip(low + 0.5 * (chunk + 1.0) * (high - low), low, high)

    def units(self, actions: Array) -> Array:
        """The inverse: actions [..., A] in -1..1."""
        low, high = np.asarray(self.space.low, np.float32), np.asarray(self.space.high, np.float32)
        return 2.0 * (actions - low) / (high - low) - 1.0


def make_chunk_policy(config: FlowConfig, env: Environment) -> ChunkPolicy:
    """Raises ConfigError for an action space that a flow cannot act in."""
    space = env.action_space
    if space.is_integer or space.is_flat:
        raise ConfigError(
            f"actions are {space.name!r}, but a flow makes numbers of noise: data and policy need env.action_space "
            "'continuous'"
        )
    network = FlowNetwork(
        encoder=make_encoder(config.encoder),
        horizon=config.horizon,
        num_dimensions=space.num_dimensions,
        width=config.width,
        token_width=config.token_width,
        num_layers=config.num_layers,
    )
    return ChunkPolicy(network, space, config.integration_steps, config.history)


def bound_dimensions(env: Environment, bound_heads: Array | None, num_worlds: int) -> Array:
    """[W, A] bool of `PreparedLevels.bound_heads`; a space that does not say counts every dimension."""
    return jnp.ones((num_worlds, env.action_space.num_dimensions), bool) if bound_heads is None else bound_heads


def init_params(policy: ChunkPolicy, obs: Any, key: Array) -> Any:
    """Parameters, float32, drawn for one world of `obs`. Consumes the key."""
    one = jax.tree.map(lambda x: x[:1], obs)
    chunk = jnp.zeros((1, policy.horizon, policy.space.num_dimensions), jnp.float32)
    with prng.pinned():
        return jax.jit(policy.network.init)(key, one, chunk, jnp.zeros(chunk.shape[:2]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainedChunks:
    """Chunk policy of a checkpoint with the environment that its data came from."""

    path: Path
    config: FlowConfig
    env: EnvConfig
    num_updates: int
    arrays: Mapping[str, np.ndarray]

    def player(self, env: Environment) -> tuple[ChunkPolicy, Any]:
        """(policy, parameters) for levels of `env`. Raises ValueError where the network does not fit them."""
        policy = make_chunk_policy(self.config, env)
        level = jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(env.capacity))

        def init(key: Array) -> Any:
            prepared = env.prepare(level)
            none = begun(prepared.initial_obs, policy.history, policy.space.num_dimensions)
            return init_params(policy, seen(env, prepared, prepared.initial_obs, none), key)

        template = jax.eval_shape(init, prng.key(0))
        return policy, jax.tree.map(jnp.asarray, unflatten_arrays(template, self.arrays))


def save_chunk_policy(
    directory: Path, num_updates: int, params: Any, config: FlowConfig, env: EnvConfig, *, notes: Mapping[str, Any]
) -> Path:
    """Checkpoint in the directory of a run's checkpoints; returns its path. notes: JSON, such as the data it learned.
    All of them are kept: bidirectional decoding compares a policy with an earlier one. Raises as `save_checkpoint`."""
    arrays = {f"{PARAMS_PREFIX}/{name}": array for name, array in flatten_arrays(params).items()}
    content = {"flow": to_dict(config), "env": to_dict(env), "notes": dict(notes)}
    return save_checkpoint(directory, num_updates, arrays, {CHUNK_POLICY: content}, keep=1 << 30)


def is_chunk_policy(description: Mapping[str, Any]) -> bool:
    """Description of a checkpoint that holds one."""
    return CHUNK_POLICY in description


def load_chunk_policy(path: Path) -> TrainedChunks:
    """The policy of a checkpoint, or of a run, whose newest checkpoint is taken. Raises CheckpointError for none."""
    checkpoint = stored_checkpoint(path)
    if checkpoint is None:
        raise CheckpointError(f"{path} has no checkpoint that can be used")
    if not is_chunk_policy(checkpoint.description):
        raise CheckpointError(f"{checkpoint.path} is no policy of action chunks")
    return chunk_policy_of(checkpoint)


def stored_checkpoint(path: Path) -> Checkpoint | None:
    """Checkpoint of a directory or of a bundled name, or the newest good one of a run; None where a run has none.
    Raises CheckpointError."""
    return newest_good(path / "checkpoints")[0] if (path / "checkpoints").is_dir() else load_checkpoint(path)


def chunk_policy_of(checkpoint: Checkpoint) -> TrainedChunks:
    """Return the policy that a checkpoint of one holds. Raise CheckpointError for settings that cannot be."""
    content = checkpoint.description[CHUNK_POLICY]
    try:
        config, env = build(FlowConfig, content["flow"]), build(EnvConfig, content["env"])
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {checkpoint.path}: {error}") from error
    return TrainedChunks(
        path=checkpoint.path,
        config=config,
        env=env,
        num_updates=checkpoint.description["num_updates"],
        arrays=select_arrays(checkpoint.arrays, PARAMS_PREFIX),
    )
