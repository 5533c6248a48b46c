"""Runs two updates and saves what comes out; a program, so that tests can run it on other devices and processes.

    python tests/learner/update_program.py OUT.npz [COORDINATOR_ADDRESS NUM_PROCESSES PROCESS_ID]
    python tests/learner/update_program.py OUT.npz recurrent       # a policy with a memory, minibatches of whole worlds
    EXPORTED_UPDATE=1 python ...                                   # by the program that a compile cache would keep

The second update contains a sample that is not a number. Saved: all parameters and metrics after each update, and the
measures of plasticity before them.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from jax2d.scene import Capacity
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS, synthetic_static_obs, synthetic_trajectory
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.plasticity import make_measure
from kinetix_dist.learner.sharding import data_mesh, local_values, replicate, spread_worlds
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.learner.update import Update, exported_update, make_update
from kinetix_dist.messages import StaticInput
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy

CAPACITY = Capacity(polygons=2, circles=1, joints=1, thrusters=1)
STEPS, WORLDS = 6, 8
POLICY = PolicyConfig(encoder_size=8, attention_features=4, num_heads=4, num_layers=1, hidden_size=8, hidden_layers=1)
PPO = PpoConfig(epochs=2, minibatches=3, virtual_shards=8, learning_rate=1e-2, clip=0.2)
RECURRENT_POLICY = dataclasses.replace(POLICY, recurrent="gru", memory_size=4)
RECURRENT_PPO = dataclasses.replace(PPO, minibatches=2, virtual_shards=4)


def make_problem(
    mesh: jax.sharding.Mesh,
    config: PpoConfig = PPO,
    policy_config: PolicyConfig = POLICY,
    *,
    make: Callable[..., Update] = make_update,
) -> tuple[Update, LearnerState, tuple]:
    """(update, first state, its numpy arguments for all worlds)."""
    static = StaticInput(obs=synthetic_static_obs(WORLDS, CAPACITY))
    trajectory = synthetic_trajectory(STEPS, WORLDS, CAPACITY)
    last_value = np.linspace(-1.0, 1.0, WORLDS, dtype=np.float32)
    policy = make_policy(policy_config, ACTIONS.head_sizes)
    observation = OBSERVATIONS["entity"]
    obs = observation.join(static.obs, jax.tree.map(lambda x: x[0], trajectory.dynamic_obs))
    params = init_params(policy, obs, jax.random.key(0))
    state = replicate(config.initial_state(params, jax.random.key(7)), mesh)
    return make(policy, observation, ACTIONS, config, mesh), state, (static, trajectory, last_value)


def place(arguments: tuple, mesh: jax.sharding.Mesh, config: PpoConfig = PPO) -> tuple:
    """Each process hands in the worlds of all."""
    static, trajectory, last_value = arguments
    division = Division(config.virtual_shards, mesh.devices.size)
    return (
        spread_worlds(static, mesh, division),
        spread_worlds(trajectory, mesh, division, axis=1),
        spread_worlds(last_value, mesh, division),
    )


def poisoned(arguments: tuple) -> tuple:
    """One sample, of the last world, has a log-probability that is not a number."""
    static, trajectory, last_value = arguments
    trajectory = jax.tree.map(np.copy, trajectory)
    trajectory.log_probs[2, WORLDS - 1] = np.nan
    return static, trajectory, last_value


def main() -> None:
    out = sys.argv[1]
    config, policy_config = PPO, POLICY
    if sys.argv[2:] == ["recurrent"]:
        config, policy_config = RECURRENT_PPO, RECURRENT_POLICY
    elif len(sys.argv) > 2:
        address, num_processes, process_id = sys.argv[2:]
        jax.distributed.initialize(address, int(num_processes), int(process_id), cluster_detection_method="deactivate")
    mesh = data_mesh()
    make = exported_update if os.environ.get("EXPORTED_UPDATE") else make_update
    update, state, arguments = make_problem(mesh, config, policy_config, make=make)
    saved: dict[str, np.ndarray] = {"devices": np.asarray(mesh.devices.size)}
    policy, division = (
        make_policy(policy_config, ACTIONS.head_sizes),
        Division(config.virtual_shards, mesh.devices.size),
    )
    measure = make_measure(policy, OBSERVATIONS["entity"], mesh, division=division)
    static, trajectory, _ = place(arguments, mesh, config)
    saved |= local_values(measure(state.params, static, trajectory))
    for number, batch in enumerate((arguments, poisoned(arguments))):
        state, metrics = update(state, *place(batch, mesh, config))
        saved[f"params_{number}"] = np.asarray(ravel_pytree(local_values(state.params))[0])
        saved |= {f"{name}_{number}": value for name, value in local_values(metrics).items()}
    np.savez(out, allow_pickle=False, **saved)


if __name__ == "__main__":
    main()
