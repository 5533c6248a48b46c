"""Offline data of the public Kinetix package (in its own environment): a sample of its states, and what it reads.

    python kinetix_offline.py write FOLDER SIZE NUM_TRAJECTORIES NUM_STEPS [continuous]
    python kinetix_offline.py read FOLDER OUT.npz

`write` plays random levels of the package by random actions, so many steps each, again and again from the start of the
level, and stores them as `kinetix.data` loads them: a zarr group of two arrays of records [trajectories, steps], each
field with an axis of length 1 before its own. The package has loaders and no writer. `read` loads the group by the
package's own `ZarrTrajDataSource`, and gives, in the order of the sorted names of the arrays:

    action, action_mask, done    [N, T, ...]
    state.*                      [N, T, ...] leaves of the package's EnvState, by their paths
    obs.*                        [N * T, ...] fields of its EntityObservation of these states

This file uses nothing of the project.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import zarr
from kinetix.data.bc_utils import get_valid_action_mask
from kinetix.data.data_utils import ZarrTrajDataSource
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.env_state import EnvParams, StaticEnvParams
from kinetix.environment.spaces import ActionType, EntityObservations, ObservationType
from kinetix.environment.ued.distributions import sample_kinetix_level
from kinetix.environment.ued.ued_state import UEDParams
from kinetix.environment.utils import static_env_params_from_size

from jax2d.engine import PhysicsEngine

SEED = 0
CHOICES = (3, 3, 3, 3, 2, 2)


def main() -> int:
    command, folder, *rest = sys.argv[1:]
    if command == "write":
        write(folder, rest[0], int(rest[1]), int(rest[2]), "continuous" in rest)
    else:
        np.savez_compressed(rest[0], **read(folder))
    return 0


def write(folder: str, size: str, number: int, num_steps: int, is_continuous: bool) -> None:
    static, params = static_env_params_from_size(size), EnvParams()
    sample = functools.partial(
        sample_kinetix_level,
        engine=PhysicsEngine(static),
        env_params=params,
        static_env_params=static,
        ued_params=UEDParams(),
    )
    levels = jax.jit(jax.vmap(sample))(jax.random.split(jax.random.PRNGKey(SEED), number))
    kind = ActionType.CONTINUOUS if is_continuous else ActionType.MULTI_DISCRETE
    env = make_kinetix_env(kind, ObservationType.SYMBOLIC_ENTITY, None, params, static)
    rng = np.random.default_rng(SEED)
    if is_continuous:
        actions = rng.uniform(np.array([-1.0] * 4 + [0.0] * 2), 1.0, (num_steps, number, 6)).astype(np.float32)
    else:
        actions = rng.integers(0, CHOICES, (num_steps, number, 6)).astype(np.int32)
    states, done = jax.jit(functools.partial(play, env, params))(levels, actions)
    states, done, actions = (
        jax.tree.map(lambda x: np.asarray(x).swapaxes(0, 1), part) for part in (states, done, actions)
    )
    flat = jax.tree.map(lambda x: x.reshape(number * num_steps, *x.shape[2:]), states)
    masks = get_valid_action_mask(flat, static, actions.reshape(number * num_steps, 6))
    fields = {f"env_state/{name}": leaf for name, leaf in leaves(states).items()}
    fields |= {"action": actions, "done": done, "action_mask": np.asarray(masks).reshape(number, num_steps, 6)}
    record = np.dtype([(name, field.dtype, (1, *field.shape[2:])) for name, field in fields.items()])
    records = np.zeros((number, num_steps), record)
    for name, field in fields.items():
        records[name] = field[:, :, None]
    group, half = zarr.open_group(folder, mode="w"), number // 2
    for name, part in (("shard_00000", records[:half]), ("shard_00001", records[half:])):
        group.create_dataset(name, data=part, chunks=(4, num_steps))


def play(env: Any, params: EnvParams, levels: Any, actions: Any) -> tuple[Any, Any]:
    """(states [T, N, ...] before each action, done [T, N] with it). A finished episode restarts on its level."""
    key = jax.random.key(0)  # steps draw nothing

    def step(states: Any, action: Any) -> tuple[Any, tuple[Any, Any]]:
        one = jax.vmap(lambda state, act, level: env.step(key, state, act, params, level)[1:4])
        following, _, done = one(states, action, levels)
        return following, (states, done)

    return jax.lax.scan(step, levels, actions)[1]


def read(folder: str) -> dict[str, np.ndarray]:
    names = sorted(zarr.open_group(folder, mode="r").array_keys())
    parts = [zarr.open_group(folder, mode="r")[name].shape[0] for name in names]
    source = ZarrTrajDataSource(folder, sum(parts), seed=0)
    loaded = source[0]
    lengths = dict(zip(names, parts, strict=True))
    starts = dict(
        zip(source.shard_names, np.cumsum([0] + [lengths[name] for name in source.shard_names]), strict=False)
    )
    order = np.concatenate([starts[name] + np.arange(lengths[name]) for name in names])
    loaded = jax.tree.map(lambda x: np.asarray(x)[order], loaded)
    states = loaded.env_state
    static = StaticEnvParams(
        num_polygons=states.polygon.position.shape[-2],
        num_circles=states.circle.position.shape[-2],
        num_joints=states.joint.active.shape[-1],
        num_thrusters=states.thruster.active.shape[-1],
    )
    flat = jax.tree.map(lambda x: jnp.asarray(x.reshape(-1, *x.shape[2:])), states)
    obs = jax.jit(jax.vmap(EntityObservations(EnvParams(), static).get_obs))(flat)
    answer = {f"state.{name}": leaf for name, leaf in leaves(states).items()}
    answer |= {f"obs.{name}": np.asarray(getattr(obs, name)) for name in obs.__dataclass_fields__}
    return answer | {"action": loaded.action, "action_mask": loaded.action_mask, "done": loaded.done}


def leaves(part: Any, path: str = "") -> dict[str, np.ndarray]:
    """Leaves of nested dataclasses by their paths: polygon/position."""
    found = {}
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        name = f"{path}{field.name}"
        found |= leaves(value, f"{name}/") if dataclasses.is_dataclass(value) else {name: np.asarray(value)}
    return found


if __name__ == "__main__":
    sys.exit(main())
