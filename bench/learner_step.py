"""Milliseconds a PPO gradient step takes, on made-up observations of the real shapes: the learner without the rest.

    python bench/learner_step.py --size m --minibatch 16384 --dtype bfloat16 [--json FILE]

Times a whole update (`--steps` steps of `--worlds` worlds, all local devices), divides it by its gradient steps, and
times the forward pass of one minibatch. Prints one JSON record; `env_steps_per_second_bound` is what training could
reach if rollouts were free.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity
from kinetix_dist.env.observations.entities import DynamicObs, StaticObs, observe
from kinetix_dist.learner.sharding import data_mesh, replicate, shard_worlds
from kinetix_dist.learner.state import init_learner_state
from kinetix_dist.learner.update import PpoConfig, make_update
from kinetix_dist.level.level import SIZES
from kinetix_dist.messages import Trajectory
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy, num_parameters

HEAD_SIZES = (3, 3, 3, 3, 2, 2)


def synthetic_static_obs(num_worlds: int, capacity: Capacity, seed: int = 0) -> StaticObs:
    """Observations of levels that were never built: right shapes, padded slots, random numbers."""
    rng = np.random.default_rng(seed)
    shapes, joints, words = capacity.shapes, 2 * capacity.joints, capacity.touch_words

    def features(count: int, width: int) -> np.ndarray:
        return rng.normal(size=(num_worlds, count, width)).astype(np.float32)

    shape_mask = rng.random((num_worlds, shapes)) < 0.8
    shape_mask[:, 0] = True
    active = (shape_mask * (1 << np.arange(shapes))).sum(axis=1).astype(np.uint32)
    rows = rng.integers(0, 2**shapes, (2, num_worlds, shapes)) & active[:, None]
    connected = (np.where(shape_mask, rows, 0) | (shape_mask * (1 << np.arange(shapes)))).astype(np.uint32)
    return StaticObs(
        polygons=features(capacity.polygons, 12 + 2 * capacity.vertices),
        circles=features(capacity.circles, 12),
        joints=features(joints, 22),
        thrusters=features(capacity.thrusters, 8),
        shape_mask=shape_mask,
        joint_mask=rng.random((num_worlds, joints)) < 0.8,
        thruster_mask=rng.random((num_worlds, capacity.thrusters)) < 0.8,
        joint_from=rng.integers(0, shapes, (num_worlds, joints)).astype(np.int32),
        joint_to=rng.integers(0, shapes, (num_worlds, joints)).astype(np.int32),
        thruster_owner=rng.integers(0, shapes, (num_worlds, capacity.thrusters)).astype(np.int32),
        connected_any=np.repeat(connected[0][..., None], words, axis=-1),
        connected_one=np.repeat(connected[1][..., None], words, axis=-1),
    )


def synthetic_trajectory(num_steps: int, num_worlds: int, capacity: Capacity, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    leading = (num_steps, num_worlds)
    return Trajectory(
        dynamic_obs=DynamicObs(
            bodies=rng.normal(size=(*leading, capacity.shapes, 7)).astype(np.float32),
            touching=rng.integers(
                0, 2**capacity.shapes, (*leading, capacity.shapes, capacity.touch_words), dtype=np.uint32
            ),
        ),
        actions=np.stack([rng.integers(0, size, leading) for size in HEAD_SIZES], axis=-1).astype(np.int8),
        log_probs=rng.normal(-5.7, 0.1, leading).astype(np.float32),
        values=rng.normal(size=leading).astype(np.float32),
        rewards=rng.normal(size=leading).astype(np.float32),
        done_after=rng.random(leading) < 0.02,
    )


def median_seconds(function: Callable[[], Any], repeats: int) -> float:
    """After one call that is not counted (it may compile)."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    mesh, capacity = data_mesh(), SIZES[args.size]
    num_samples = args.steps * args.worlds
    if num_samples % args.minibatch:
        raise SystemExit(f"{args.steps} steps x {args.worlds} worlds are no multiple of --minibatch {args.minibatch}")
    config = PpoConfig(epochs=args.epochs, minibatches=num_samples // args.minibatch)
    policy = make_policy(
        PolicyConfig(
            network=args.network,
            dtype=args.dtype,
            encoder_size=args.encoder_size,
            hidden_size=args.encoder_size,
        ),
        HEAD_SIZES,
    )
    static = synthetic_static_obs(args.worlds, capacity)
    trajectory = synthetic_trajectory(args.steps, args.worlds, capacity)
    first = observe(jax.tree.map(lambda x: x[:1], static), jax.tree.map(lambda x: x[0, :1], trajectory.dynamic_obs))
    params = init_params(policy, first, jax.random.key(0))
    state = replicate(init_learner_state(params, config.optimizer(), jax.random.key(1)), mesh)
    inputs = (
        shard_worlds(static, mesh),
        shard_worlds(trajectory, mesh, axis=1),
        shard_worlds(np.zeros(args.worlds, np.float32), mesh),
    )
    # A forward pass over one minibatch, on one device.
    count = min(args.minibatch, num_samples)
    chosen = np.arange(count)
    forward_inputs = jax.tree.map(
        jnp.asarray,
        (
            jax.tree.map(lambda x: x[chosen % args.worlds], static),
            jax.tree.map(lambda x: x[chosen // args.worlds, chosen % args.worlds], trajectory.dynamic_obs),
        ),
    )
    forward = jax.jit(lambda params, static, dynamic: policy.apply(params, observe(static, dynamic)))
    update = make_update(policy, observe, config, mesh)
    start = time.perf_counter()
    compiled = update.lower(state, *inputs).compile()
    compile_seconds = time.perf_counter() - start
    update_seconds = median_seconds(lambda: compiled(state, *inputs), args.repeats)
    forward_seconds = median_seconds(lambda: forward(params, *forward_inputs), args.repeats)
    gradient_steps = config.epochs * config.minibatches
    return {
        "benchmark": "learner_step",
        "device": jax.devices()[0].device_kind,
        "devices": mesh.devices.size,
        "jax": jax.__version__,
        "network": args.network,
        "parameters": num_parameters(params),
        "size": args.size,
        "dtype": args.dtype,
        "minibatch": args.minibatch,
        "gradient_steps": gradient_steps,
        "compile_seconds": round(compile_seconds, 2),
        "milliseconds_a_gradient_step": round(1e3 * update_seconds / gradient_steps, 4),
        "milliseconds_forward": round(1e3 * forward_seconds, 4),
        "env_steps_per_second_bound": round(num_samples / (update_seconds * 8 / config.epochs)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=sorted(SIZES), default="m")
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="bfloat16")
    parser.add_argument("--network", choices=("transformer", "flat"), default="transformer")
    parser.add_argument("--encoder-size", type=int, default=128)
    parser.add_argument("--minibatch", type=int, default=16_384, help="samples, over all devices together")
    parser.add_argument("--worlds", type=int, default=2_048)
    parser.add_argument("--steps", type=int, default=256)
    parser.add_argument("--epochs", type=int, default=1, help="the bound is given for 8, as in the paper")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--profile", type=Path, help="write a trace of one update into this folder")
    parser.add_argument("--json", type=Path, help="append the record to this file, one JSON object a line")
    args = parser.parse_args()
    if args.profile:
        with jax.profiler.trace(str(args.profile)):
            record = measure(args)
    else:
        record = measure(args)
    print(json.dumps(record))
    if args.json:
        with args.json.open("a") as file:
            file.write(json.dumps(record) + "\n")


if __name__ == "__main__":
    main()
