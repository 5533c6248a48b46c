"""How much of a policy's gradient is rounding: in bfloat16, beside the same in float32, for each checkpoint.

    python -m bench.gradient_rounding generalist runs/a/checkpoints/00000300 [--levels dev_random_l] [--json FILE]

The function is a sum of outputs with fixed random weights, at the start of the first levels of the set. A record has
the mean difference of the outputs (logits), and of parameters the length of the difference of both gradients, as a
share of the length in float32. `key_constant` is the length of what all keys of the first attention have in common,
which softmax ignores and the network leaves out; with --with-key-bias it is left in, as it was until `68e5cf5`.
`query_norm` is the largest norm of the weights of a head's queries, as they are used; --max-qk-norm limits it to
another number than the checkpoint's own `policy.max_qk_norm`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models import entity_transformer
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.trained_policy import Trained, checkpoint_at

SHOWN = ("attention_0_qkv_kernel", "attention_0_norm_offset", "feed_forward_0_kernel")
FIRST_ATTENTION = ("norm_scale", "norm_offset", "qkv_kernel", "qkv_bias")
COLUMNS = "{:32} {:>12} {:>10} {:>8}" + " {:>24}" * len(SHOWN)


def records(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    if args.with_key_bias:
        entity_transformer.without_key_bias = lambda bias: bias
    for path in args.checkpoints:
        trained = checkpoint_at(Path(path))
        limit = trained.config.policy.max_qk_norm if args.max_qk_norm is None else args.max_qk_norm
        options = {"with_key_bias": args.with_key_bias, "max_qk_norm": limit}
        yield {"checkpoint": path} | options | rounding_of(trained, args.levels, args.count, limit)


def rounding_of(trained: Trained, set_name: str, count: int, max_qk_norm: float) -> dict[str, Any]:
    config = trained.config
    if config.policy.network not in ("transformer", "transformer_lean"):
        raise UserError(f"{trained.checkpoint.path}: network {config.policy.network!r} has no attention")
    env = make_environment(config)
    levels = jax.tree.map(lambda x: jnp.asarray(x[:count]), load_level_set(set_name, config.env.size)[0])
    prepared = env.prepare(levels)
    _, dynamic_obs = env.reset(prepared)
    obs = env.observation.join(prepared.static_obs, dynamic_obs)
    gradients, outputs, params = {}, {}, None
    for dtype in ("bfloat16", "float32"):
        network = dataclasses.replace(config.policy, dtype=dtype, kernels="xla", max_qk_norm=max_qk_norm)
        policy, params = load_policy(trained.checkpoint, network, env, levels)

        def total(params: Any, policy: Any = policy) -> tuple[Any, Any]:
            logits, _ = policy.apply(params, obs)
            weights = [np.random.default_rng(head).standard_normal(x.shape) for head, x in enumerate(logits)]
            return sum(jnp.mean(x * jnp.float32(weight)) for x, weight in zip(logits, weights)), logits

        gradient, logits = jax.jit(jax.grad(total, has_aux=True))(params)
        gradients[dtype] = gradient["params"]
        outputs[dtype] = np.concatenate([np.asarray(head) for head in logits], axis=1)
    scale, offset, kernel, bias = (np.asarray(params["params"][f"attention_0_{name}"]) for name in FIRST_ATTENTION)
    bias = bias + offset @ kernel
    queries, keys, _ = np.split(np.concatenate([scale[:, None] * kernel, bias[None]]), 3, axis=1)
    query_norm = np.linalg.norm(queries.reshape(len(queries), config.policy.num_heads, -1), axis=(0, 2)).max()
    return {
        "key_constant": float(np.linalg.norm(keys[-1])),
        "query_norm": float(min(query_norm, max_qk_norm or query_norm)),
        "outputs": float(np.abs(outputs["bfloat16"] - outputs["float32"]).mean()),
        "gradient": {name: _share(gradients["bfloat16"][name], gradients["float32"][name]) for name in SHOWN},
    }


def _share(rounded: Any, exact: Any) -> float:
    rounded, exact = np.asarray(rounded, np.float64), np.asarray(exact, np.float64)
    return float(np.linalg.norm(rounded - exact) / np.linalg.norm(exact))


def line_of(record: dict[str, Any]) -> str:
    shares = (f"{record['gradient'][name]:.2f}" for name in SHOWN)
    name = "/".join(Path(record["checkpoint"]).parts[-3:])
    norms = (f"{record[norm]:.1f}" for norm in ("key_constant", "query_norm"))
    return COLUMNS.format(name, *norms, f"{record['outputs']:.3f}", *shares)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("checkpoints", nargs="+")
    parser.add_argument("--levels", default="dev_random_l", help="a set of the size that they were trained on")
    parser.add_argument("--count", type=int, default=256)
    parser.add_argument("--with-key-bias", action="store_true")
    parser.add_argument("--max-qk-norm", type=float, help="0: no limit")
    parser.add_argument("--json", type=output_file)
    args = parser.parse_args()

    def work() -> int:
        if args.count < 1:
            raise UserError(f"--count is {args.count}; it must be 1 or more")
        if args.max_qk_norm is not None and not 0 <= args.max_qk_norm < math.inf:
            raise UserError(f"--max-qk-norm is {args.max_qk_norm}; it must be 0 (no limit) or a positive number")
        print(COLUMNS.format("checkpoint", "key_constant", "query_norm", "outputs", *SHOWN))
        report_each(records(args), args.json, text=line_of)
        return 0

    return exit_code(parser, work)


if __name__ == "__main__":
    sys.exit(main())
