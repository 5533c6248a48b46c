"""`bench learner`: milliseconds of a PPO gradient step on made-up observations: the learner without the rest.

Times a whole update (`steps` steps of `worlds` worlds, all local devices), divides it by its gradient steps, and
times the forward passes of its minibatches. `env_steps_per_second_bound` is what training with 8 epochs, as in the
paper, could reach if rollouts were free.
"""

from __future__ import annotations

import dataclasses
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from kinetix_dist import prng
from kinetix_dist.benchmarks.measuring import BenchmarkOptions, Record, Results, median_seconds
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS, synthetic_static_obs, synthetic_trajectory
from kinetix_dist.env.observations import OBSERVATIONS, Observation
from kinetix_dist.errors import user_errors
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import data_mesh, replicate, spread_worlds
from kinetix_dist.learner.update import make_update
from kinetix_dist.level.level import SIZES
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.kernels.support import KernelError
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy, num_parameters

PAPER_EPOCHS = 8

Size = Literal["s", "m", "l"]
Network = Literal["transformer", "transformer_lean", "flat"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(BenchmarkOptions):
    """Milliseconds of a PPO gradient step, on made-up observations."""

    size: Size = "m"
    """Level size."""
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    """Type of activations."""
    network: Network = "transformer"
    """Policy network."""
    kernels: Literal["auto", "xla", "fused"] = "xla"
    """Kernels of the layers, see policy.kernels."""
    encoder_size: int = 128
    """Width of tokens and of hidden layers."""
    minibatch: int = 16_384
    """Samples, over all devices together."""
    worlds: int = 2_048
    """Worlds of an update."""
    steps: int = 256
    """Environment steps of each world in an update."""
    epochs: int = 1
    """Epochs of the update; the bound is given for 8, as in the paper."""
    repeats: int = 5
    """Timed updates of which the median counts, after one that is not timed."""
    profile: Path | None = None
    """Write a trace of the benchmark into this folder."""

    def __post_init__(self) -> None:
        for name in ("encoder_size", "minibatch", "worlds", "steps", "epochs", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name)}; give 1 or more")
        if self.num_samples % self.minibatch:
            raise ValueError(
                f"{self.steps} steps of {self.worlds} worlds are {self.num_samples} samples, no multiple of "
                f"--minibatch {self.minibatch}; change one of them"
            )

    @property
    def num_samples(self) -> int:
        return self.steps * self.worlds


def measure(options: Options, results: Results) -> None:
    """One record."""
    with user_errors(ValueError):
        config = PpoConfig(
            epochs=options.epochs, minibatches=options.num_samples // options.minibatch, virtual_shards=8
        )
        config.check_batch(num_steps=options.steps, num_worlds=options.worlds)
        Division(config.virtual_shards, len(jax.devices()))
    profile = nullcontext() if options.profile is None else jax.profiler.trace(str(options.profile))
    with profile, user_errors(KernelError):
        record = _timed(options, config)
    results.add(record)
    results.report(
        f"{record['device']} x {record['devices']}, {options.network} of {record['parameters']:,} parameters, "
        f"size {options.size.upper()}, {options.dtype}, kernels {options.kernels}, {options.minibatch} samples: "
        f"{record['milliseconds_a_gradient_step']:.4g} ms a gradient step, "
        f"{record['milliseconds_forward']:.4g} ms forward; "
        f"at most {record['env_steps_per_second_bound']:,} env steps/s with {PAPER_EPOCHS} epochs"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnerProgram:
    """Parts of an update of the benchmark."""

    policy: nn.Module
    observation: Observation
    static: StaticInput  # [worlds, ...], on the host
    trajectory: Trajectory  # [steps, worlds, ...], on the host

    def first_obs(self) -> Any:
        """The observation of one world, for `init_params`."""
        return self.observation.join(
            jax.tree.map(lambda x: x[:1], self.static.obs),
            jax.tree.map(lambda x: x[0, :1], self.trajectory.dynamic_obs),
        )


def learner_program(options: Options) -> LearnerProgram:
    """Policy and made-up batch of the options."""
    capacity = SIZES[options.size]
    config = PolicyConfig(
        network=options.network,
        dtype=options.dtype,
        kernels=options.kernels,
        encoder_size=options.encoder_size,
        hidden_size=options.encoder_size,
    )
    return LearnerProgram(
        policy=make_policy(config, ACTIONS.head_sizes),
        observation=OBSERVATIONS["flat" if options.network == "flat" else "entity"],
        static=StaticInput(obs=synthetic_static_obs(options.worlds, capacity)),
        trajectory=synthetic_trajectory(options.steps, options.worlds, capacity),
    )


def _timed(options: Options, config: PpoConfig) -> Record:
    mesh, program = data_mesh(), learner_program(options)
    policy, observation = program.policy, program.observation
    static, trajectory = program.static, program.trajectory
    params = init_params(policy, program.first_obs(), prng.key(0))
    state = replicate(config.initial_state(params, prng.key(1)), mesh)
    division = Division(config.virtual_shards, mesh.devices.size)
    inputs = (
        spread_worlds(static, mesh, division),
        spread_worlds(trajectory, mesh, division, axis=1),
        spread_worlds(np.zeros(options.worlds, np.float32), mesh, division),
    )
    # Forward passes of all minibatches, on one device, one after another in a loop, as rollouts have them: a pass that
    # is a call of its own takes as long as its hundred launches.
    samples = np.arange(options.num_samples).reshape(-1, options.minibatch)
    world_of, step_of = samples % options.worlds, samples // options.worlds
    forward_inputs = jax.tree.map(
        jnp.asarray,
        (
            jax.tree.map(lambda x: x[world_of[0]], static.obs),
            jax.tree.map(lambda x: x[step_of, world_of], trajectory.dynamic_obs),
        ),
    )

    @jax.jit
    def forward(params: Any, static: Any, dynamic: Any) -> Any:
        return jax.lax.map(lambda of_one: policy.apply(params, observation.join(static, of_one)), dynamic)

    started = time.perf_counter()
    update = make_update(policy, observation, ACTIONS, config, mesh).lower(state, *inputs).compile()
    compile_seconds = time.perf_counter() - started
    update_seconds = median_seconds(lambda: update(state, *inputs), options.repeats)
    forward_seconds = median_seconds(lambda: forward(params, *forward_inputs), options.repeats)
    gradient_steps = config.epochs * config.minibatches
    return {
        "benchmark": "learner_step",
        "device": jax.devices()[0].device_kind,
        "devices": mesh.devices.size,
        "jax": jax.__version__,
        "network": options.network,
        "parameters": num_parameters(params),
        "size": options.size,
        "dtype": options.dtype,
        "kernels": options.kernels,
        "minibatch": options.minibatch,
        "gradient_steps": gradient_steps,
        "compile_seconds": round(compile_seconds, 2),
        "milliseconds_a_gradient_step": round(1e3 * update_seconds / gradient_steps, 4),
        "milliseconds_forward": round(1e3 * forward_seconds / len(samples), 4),
        "env_steps_per_second_bound": round(options.num_samples / (update_seconds * PAPER_EPOCHS / config.epochs)),
    }
