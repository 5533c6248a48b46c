"""Worlds between two updates, where they go on from one to the next (`rollout.reset_every`).

    begun(env, policy, proposal)            at a reset: the first state of each level
    stored(worlds, mesh, division)          arrays of a checkpoint: worlds of this process, each once
    restored(arrays, like, mesh, division)  the same on the devices, however many there are now

What is computed from levels alone (`PreparedLevels`) is not stored: the program of an update computes it again, so that
it has the same bits after a resume. A checkpoint with which worlds are reset anyway holds none of this.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist.actors.outcomes import no_outcomes
from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.curator.curriculum import Proposal
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import own_worlds, spread_worlds
from kinetix_dist.level.level import Level
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.models.gru import initial_memory
from kinetix_dist.runtime.cores.run_names import WORLDS


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Episodes:
    """Part of the worlds that changes in an update."""

    env_state: EnvState  # [W, ...], the packed state worlds first too: all arrays are sharded alike
    obs: Any  # [W, ...], what the policy sees next
    memory: Array | None  # [W, size] of the policy; None: it has none
    outcome: LevelOutcome  # [W] since the reset


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class OngoingWorlds:
    """All that worlds take into the next update."""

    levels: Level  # [W, ...]
    source: Array  # [W] int32, see `Proposal.source`
    copy_of: Array | None  # [W] int32, see `Proposal.copy_of`
    episodes: Episodes


def begun(env: Environment, policy: Any, proposal: Proposal) -> OngoingWorlds:
    """Worlds at the start of the proposed levels. Works inside jit and shard_map."""
    env_state, obs = env.reset(env.prepare(proposal.levels))
    num_worlds = env_state.num_steps.shape[0]
    return OngoingWorlds(
        levels=proposal.levels,
        source=source_of(proposal),
        copy_of=proposal.copy_of,
        episodes=Episodes(
            env_state=with_worlds_first(env_state),
            obs=obs,
            memory=initial_memory(policy, num_worlds),
            outcome=no_outcomes(num_worlds),
        ),
    )


def source_of(proposal: Proposal) -> Array:
    """[W] int32."""
    if proposal.source is not None:
        return proposal.source
    return jnp.zeros(proposal.levels.position.shape[0], jnp.int32)


def with_worlds_first(env_state: EnvState) -> EnvState:
    """`env_state` of an environment with its packed state [W, ...]."""
    return _with_axis_moved(env_state, -1, 0)


def with_worlds_last(env_state: EnvState) -> EnvState:
    """The inverse."""
    return _with_axis_moved(env_state, 0, -1)


def _with_axis_moved(env_state: EnvState, axis: int, to: int) -> EnvState:
    packed = jax.tree.map(lambda x: jnp.moveaxis(x, axis, to), env_state.packed_state)
    return dataclasses.replace(env_state, packed_state=packed)


def stored(worlds: OngoingWorlds, mesh: Mesh, division: Division) -> dict[str, np.ndarray]:
    """Arrays of a checkpoint by name. Those of several processes, one behind the other in the order of processes, are
    all worlds."""
    return flatten_arrays({WORLDS: own_worlds(worlds, mesh, division)})


def restored(arrays: Mapping[str, np.ndarray], like: Any, mesh: Mesh, division: Division) -> OngoingWorlds:
    """Worlds from arrays of a checkpoint, without `WORLDS` in their names. like: shapes of `begun` of any number."""
    num_worlds = arrays["source"].shape[0]
    # Checkpoints of versions without pairs have none, whatever the curriculum draws now.
    like = dataclasses.replace(like, copy_of=like.source if "copy_of" in arrays else None)
    template = jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_worlds, *x.shape[1:]), x.dtype), like)
    return spread_worlds(unflatten_arrays(template, arrays), mesh, division)
