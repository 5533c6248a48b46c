"""The learner's kernels under compute-sanitizer: addresses, races in shared memory, barriers, what is read unset.

    python -m bench.sanitize_kernels [--tools memcheck racecheck synccheck initcheck] [--sizes s m l] [--json FILE]

Each tool watches a process of its own that computes a network's outputs and gradient with `policy.kernels` "fused", of
1 and of 150 worlds, so that tiles are empty, partly full and full. A record names the kernels in which errors were
found: the whole process is watched, XLA's and Pallas' kernels as well. Needs a GPU that the kernels are written for,
and compute-sanitizer of the CUDA toolkit.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS, synthetic_static_obs, synthetic_trajectory
from kinetix_dist.child_python import command_of
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.errors import UserError
from kinetix_dist.level.level import SIZES
from kinetix_dist.models.kernels import support
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy

COMPUTE = tuple(command_of("bench.sanitize_kernels", "--compute"))
TOOLS = ("memcheck", "racecheck", "synccheck", "initcheck")
NUM_WORLDS = (1, 150)
PLACE = re.compile(r"\bat (\w+)\+0x")
SUMMARY = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+)")


def compute(size: str) -> None:
    """Runs in the watched process. Batches and parameters are made on the CPU, which is not."""
    gpu, cpu = jax.devices()[0], jax.devices("cpu")[0]
    policy = make_policy(PolicyConfig(kernels="fused", dtype="bfloat16", read_out="colour"), ACTIONS.head_sizes)

    def outputs(params: Any, obs: Any) -> Any:
        outputs: Any = policy.apply(params, obs)
        logits, values = outputs
        return sum(jnp.sum(jax.nn.log_softmax(head)[:, 0]) for head in logits) + jnp.sum(values**2)

    plain = make_policy(PolicyConfig(read_out="colour"), ACTIONS.head_sizes)  # has the same parameters
    for worlds in NUM_WORLDS:
        with jax.default_device(cpu):
            dynamic = jax.tree.map(lambda leaf: leaf[0], synthetic_trajectory(1, worlds, SIZES[size]).dynamic_obs)
            obs = OBSERVATIONS["entity"].join(synthetic_static_obs(worlds, SIZES[size]), dynamic)
            params = init_params(plain, obs, jax.random.key(0))
        given = jax.device_put((params, obs), gpu)
        found = jax.device_get((jax.jit(outputs)(*given), jax.jit(jax.grad(outputs))(*given)))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found)), f"{size}, {worlds} worlds: not finite"


def _process(command: list[str], cache: str) -> subprocess.CompletedProcess[str]:
    # XLA would try each product in many ways, all of them watched.
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_autotune_level=0".strip()
    environment = {**os.environ, "XLA_FLAGS": flags, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    environment |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def compile_programs(size: str, cache: str) -> None:
    """Unwatched, so that they are loaded later. Raises UserError."""
    ended = _process([*COMPUTE, size], cache)
    if ended.returncode:
        raise UserError(f"size {size}: status {ended.returncode}: {ended.stderr[-1500:]}")


def watched(sanitizer: str, tool: str, size: str, cache: str) -> dict:
    """One process under one tool; raises UserError where it did not end as it should."""
    started = time.perf_counter()
    ended = _process([sanitizer, f"--tool={tool}", *COMPUTE, size], cache)
    summary = SUMMARY.search(ended.stdout)
    if summary is None or ended.returncode:
        raise UserError(f"{tool}, size {size}: status {ended.returncode}: {(ended.stderr or ended.stdout)[-1500:]}")
    lines = [line for line in ended.stdout.splitlines() if line.startswith("=========")]
    return {
        "tool": tool,
        "size": size,
        "device": jax.devices()[0].device_kind,
        "errors": int(summary[1]),
        "kernels": sorted({found[1] for line in lines if (found := PLACE.search(line))}),
        "first": lines[1:12] if int(summary[1]) else [],
        "seconds": round(time.perf_counter() - started, 1),
    }


def main() -> int:
    parser = parser_of(__doc__, "python -m bench.sanitize_kernels")
    parser.add_argument("--tools", nargs="+", choices=TOOLS, default=TOOLS)
    parser.add_argument("--sizes", nargs="+", choices=tuple(SIZES), default=tuple(SIZES))
    parser.add_argument("--json", type=output_file)
    parser.add_argument("--compute", choices=tuple(SIZES), help="the process that is watched")
    arguments = parser.parse_args()

    def work() -> int:
        if arguments.compute:
            compute(arguments.compute)
            return 0
        if why_not := support.why_no_device():
            raise UserError(f"the kernels do not run here: {why_not}")
        sanitizer = shutil.which("compute-sanitizer", path=f"{os.environ['PATH']}:/usr/local/cuda/bin")
        if sanitizer is None:
            raise UserError("there is no compute-sanitizer on the PATH; it is part of the CUDA toolkit")
        found: list[dict] = []

        def records() -> Iterator[dict]:
            with tempfile.TemporaryDirectory() as cache:
                for size in arguments.sizes:
                    compile_programs(size, cache)
                    for tool in arguments.tools:
                        found.append(watched(sanitizer, tool, size, cache))
                        yield found[-1]

        file: Path | None = arguments.json
        report_each(records(), file, text=_row)
        return int(any(record["errors"] for record in found))

    return exit_code(parser, work)


def _row(record: dict) -> str:
    found = f"{record['errors']} errors {' '.join(record['kernels'])}"
    text = f"{record['tool']:>10} {record['size']}: {found}, {record['seconds']:.0f} s"
    return "\n".join([text, *record["first"]])


if __name__ == "__main__":
    sys.exit(main())
