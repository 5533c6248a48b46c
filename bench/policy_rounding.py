"""How far log-probabilities of a rollout are from those that the learner computes before its first step.

    python -m bench.policy_rounding --checkpoint generalist --recipe sfl_m [--device gpu] [--json FILE]

PPO divides the probability of an action after some steps by that of the rollout, and clips the ratio. Both come from
one network by two programs: a step of all worlds inside the rollout's loop, a minibatch of shuffled samples inside the
learner's gradient. They round differently. This program plays the rollout of an update with the trained policy, and
computes the log-probability of every sample again in the minibatches of the learner's first epoch, without a step
between. Then the logarithm of the ratio is rounding alone: quantiles of its size stand beside `ppo.clip`.

A record for each type of activations (float32, bfloat16), with all heads in the log-probability and with those alone
that a level uses (`ppo.mask_unbound_heads`):

    log_ratio        quantiles of |log ratio|; `rms` is the root of the mean square
    above_clip       share of samples whose ratio is clipped by rounding alone
    above_tenth      share of samples with |log ratio| above a tenth of the clip
    again            the same quantiles between two epochs of the learner: two shuffles, one program
    update_clipped   with --check: share of clipped samples as the learner's own update counts it, at a learning rate
                     of 1e-30; null without (another program to compile)

The environment, the batch and PPO are those of the recipe, by default of the checkpoint; the network is always that of
the checkpoint. Levels are random ones of the recipe's generator, or its own where it names some.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from bench.program import exit_code, output_file, parser_of, report_each
from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.config import TrainConfig, from_dict_as_recipe
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.learner.ppo_loss import Samples
from kinetix_dist.learner.sharding import data_mesh, on_devices
from kinetix_dist.learner.step_size import Sizes
from kinetix_dist.learner.update import IN_SPECS, _Program, _shuffled, advantages_of, make_update, minibatch_loss
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.models.policy import DTYPES
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.playing import make_environment
from kinetix_dist.runtime.cores.rollout_core import Batch, Players, RolloutCore
from kinetix_dist.trained_policy import Trained, checkpoint_at

QUANTILES = {"q50": 0.5, "q90": 0.9, "q99": 0.99, "q999": 0.999, "max": 1.0}
COLUMNS = "{:>9} {:>7} {:>8} {:>9} {:>7}" + " {:>9}" * (len(QUANTILES) + 3)
NO_STEP = 1e-30  # a learning rate that changes no parameter


def config_of(trained: Trained, arguments: argparse.Namespace) -> TrainConfig:
    """The recipe with the network of the checkpoint, on levels that need no curator."""
    stored = trained.checkpoint.config
    base = recipe(arguments.recipe) if arguments.recipe else from_dict_as_recipe(stored)
    rollout, ppo = base.rollout, base.ppo
    if arguments.envs:
        rollout = dataclasses.replace(rollout, num_envs=arguments.envs, num_groups=math.gcd(64, arguments.envs))
        ppo = dataclasses.replace(ppo, virtual_shards=rollout.num_groups)
    if arguments.steps:
        rollout = dataclasses.replace(rollout, num_steps=arguments.steps)
    if arguments.minibatches:
        ppo = dataclasses.replace(ppo, minibatches=arguments.minibatches)
    given = base.curriculum
    curriculum = CurriculumConfig(
        name="fixed" if given.levels else "domain_randomization",
        levels=given.levels,
        generator=given.generator,
        sizes=given.sizes,
    )
    config = dataclasses.replace(
        base, policy=trained.config.policy, rollout=rollout, ppo=ppo, curriculum=curriculum, phases=()
    )
    config.check_batch()
    return config


def variant_of(config: TrainConfig, dtype: str, kernels: str, *, is_masked: bool) -> TrainConfig:
    return dataclasses.replace(
        config,
        policy=dataclasses.replace(config.policy, dtype=dtype, kernels=kernels),
        ppo=dataclasses.replace(config.ppo, epochs=1, learning_rate=NO_STEP, max_kl=0.0, mask_unbound_heads=is_masked),
    )


def rounding_of(trained: Trained, config: TrainConfig, *, is_checked: bool) -> dict[str, Any]:
    """The record of one type and mask."""
    mesh = data_mesh(jax.local_devices()[:1])
    env = make_environment(config)
    one_level = generate_levels(prng.key(0), 1, env.capacity, config.curriculum.generator)
    with user_errors(ValueError, prefix=f"checkpoint {trained.checkpoint.path}: "):
        policy, params = load_policy(trained.checkpoint, config.policy, env, one_level)
    params = jax.tree.map(jnp.asarray, params)
    curriculum = make_curriculum(config, env, policy, mesh)
    players = Players(env, policy, curriculum)
    rollout = RolloutCore(config, players, mesh, groups=range(config.rollout.num_groups))
    batch, _, _, _ = rollout.play(params, jax.tree.map(jnp.asarray, curriculum.init()), 0)
    program = _Program(policy, env.observation, env.action_distribution, config.ppo, rollout.division)
    compute = log_ratios_of(program, mesh, *batch.trajectory.rewards.shape)
    first, second = (compute(params, batch, epoch) for epoch in (0, 1))
    update_clipped = None
    if is_checked:
        update = make_update(
            policy, env.observation, env.action_distribution, config.ppo, mesh, division=rollout.division
        )
        _, metrics = update(config.ppo.initial_state(params, prng.key(0)), *batch)
        update_clipped = float(metrics["clip_fraction"])
    found = np.abs(first)
    clip = config.ppo.clip
    return {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "checkpoint": str(trained.checkpoint.path),
        "size": config.env.size,
        "dtype": config.policy.dtype,
        "kernels": config.policy.kernels,
        "mask_unbound_heads": config.ppo.mask_unbound_heads,
        "samples": int(found.size),
        "minibatch": int(found.size // config.ppo.minibatches),
        "clip": clip,
        "log_ratio": quantiles_of(found),
        "above_tenth": float(np.mean(found > clip / 10)),
        "above_clip": float(np.mean(np.abs(np.expm1(first)) > clip)),
        "again": quantiles_of(np.abs(first - second)),
        "update_clipped": update_clipped,
    }


def quantiles_of(sizes: np.ndarray) -> dict[str, float]:
    values = sizes.astype(np.float64)
    named = {name: float(np.quantile(values, level)) for name, level in QUANTILES.items()}
    return named | {"rms": float(np.sqrt(np.mean(values**2)))}


def log_ratios_of(
    program: _Program, mesh: Mesh, num_steps: int, num_worlds: int
) -> Callable[[Any, Batch, int], np.ndarray]:
    """A function of (parameters, batch, epoch): [samples], new minus old log-probability of each sample, in the order
    of the trajectory.

    New ones are a by-product of the gradient, as in an update: a forward pass alone is another program.
    """

    def of_device(
        key: Array, params: Any, static: Any, trajectory: Any, last_value: Array
    ) -> tuple[Array, Array, Array]:
        advantages = advantages_of(trajectory, last_value, program.config)
        given = trajectory, advantages, advantages + trajectory.values
        flat = jax.tree.map(lambda x: x.reshape(num_steps * num_worlds, *x.shape[2:]), given)
        is_first = jnp.roll(trajectory.done_after, 1, axis=0).at[0].set(True).reshape(-1)
        index = _shuffled(prng.wrap_key_data(key), num_steps, num_worlds, program)
        now = Sizes(1.0, program.config.clip, program.config.entropy_coefficient)

        def minibatch(total: Array, index: Array) -> tuple[Array, Array]:
            steps, of_steps, targets = jax.tree.map(lambda x: x[index], flat)
            fixed = jax.tree.map(lambda x: x[index % num_worlds], static)
            samples = Samples(
                actions=steps.actions,
                old_log_probs=steps.log_probs,
                old_values=steps.values,
                advantages=of_steps,
                targets=targets,
                bound_heads=fixed.bound_heads,
            )
            obs = program.observation.join(fixed.obs, steps.dynamic_obs)
            memory = {"is_first": is_first[index].reshape(num_steps, -1)} if program.is_recurrent else {}
            loss = minibatch_loss(program, now, obs, samples, samples.old_values.size, memory)
            gradient, (_, log_probs) = jax.grad(loss, has_aux=True)(params)
            # Used, so that the backward pass is computed.
            total = total + sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(gradient))
            return total, log_probs - steps.log_probs

        total, found = jax.lax.scan(minibatch, jnp.zeros(()), index)
        return total, index.reshape(-1), found.reshape(-1)

    whole = PartitionSpec()
    specs = {"in_specs": (whole, whole, *IN_SPECS[1:]), "out_specs": (whole, whole, whole)}
    on_mesh = jax.jit(on_devices(of_device, mesh, **specs))

    def compute(params: Any, batch: Batch, epoch: int) -> np.ndarray:
        total, index, found = on_mesh(jax.random.key_data(prng.key(epoch)), params, *batch)
        if not np.isfinite(total):
            raise UserError("the gradient is not finite; give a checkpoint that learned with this engine and network")
        ordered = np.empty(found.shape, np.float32)
        ordered[np.asarray(index)] = np.asarray(found)
        return ordered

    return compute


def records(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    trained = checkpoint_at(Path(arguments.checkpoint))
    with user_errors(ValueError):
        config = config_of(trained, arguments)
        variants = [
            variant_of(config, dtype, arguments.kernels, is_masked=is_masked)
            for dtype in arguments.dtypes
            for is_masked in (heads == "masked" for heads in arguments.heads)
        ]
    for variant in variants:
        yield {"recipe": arguments.recipe or "of the checkpoint"} | rounding_of(
            trained, variant, is_checked=arguments.check
        )


def line_of(record: dict[str, Any]) -> str:
    of_sizes = (f"{record['log_ratio'][name]:.2e}" for name in (*QUANTILES, "rms"))
    return COLUMNS.format(
        record["dtype"],
        "masked" if record["mask_unbound_heads"] else "all",
        record["samples"],
        record["minibatch"],
        record["clip"],
        *of_sizes,
        f"{record['above_tenth']:.2%}",
        f"{record['above_clip']:.3%}",
    )


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--checkpoint", required=True, help="a directory, or the name of a pretrained policy")
    parser.add_argument("--recipe", default="", help="environment, batch and PPO; default: those of the checkpoint")
    parser.add_argument("--device", choices=["cpu", "gpu"], help="default: a GPU if there is one")
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=list(DTYPES), help="of activations")
    parser.add_argument("--heads", nargs="+", default=["all", "masked"], choices=["all", "masked"])
    parser.add_argument("--kernels", default="auto", choices=["auto", "xla"], help="as policy.kernels")
    parser.add_argument("--envs", type=int, default=0, help="worlds; 0: as many as the recipe has")
    parser.add_argument("--steps", type=int, default=0, help="of each world; 0: as many as the recipe has")
    parser.add_argument("--minibatches", type=int, default=0, help="of an epoch; 0: as many as the recipe has")
    parser.add_argument("--check", action="store_true", help="also count clipped samples by the learner's own update")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()

    def work() -> int:
        for name in ("envs", "steps", "minibatches"):
            if getattr(arguments, name) < 0:
                raise UserError(f"--{name} is {getattr(arguments, name)}; it must be 0 or more")
        if arguments.device:
            jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[arguments.device])
        columns = ("dtype", "heads", "samples", "of batch", "clip", *QUANTILES, "rms", "> clip/10", "clipped")
        print(COLUMNS.format(*columns))
        report_each(records(arguments), arguments.json, text=line_of)
        return 0

    return exit_code(parser, work)


if __name__ == "__main__":
    sys.exit(main())
