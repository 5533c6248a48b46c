"""Bytes and launches of a gradient step, by part, of the update that XLA compiles for an H200. Needs no GPU.

    python -m bench.learner_traffic                                            # both networks at S, M and L
    python -m bench.learner_traffic --sizes m --networks transformer --kernels fused --json runs/traffic.json

The update of `bench learner` is compiled for a described device (topology) and its text is read (compiled_traffic.py).
What bounds a gradient step on a GPU is this traffic: a copy reaches 4.3 TB/s of the 4.8 that an H200 has, so 4.3 GB are
a millisecond, and each launch costs 1 to 2 us more. A change of the network can be judged in a minute.

It needs Python 3.12 or later with the wheels of `jax[cuda13]`; no driver, no device. Products are those of cuBLAS:
autotuning needs a device, and may choose others there that fuse with their neighbours.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import topologies
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bench.compiled_traffic import CompiledText, Launch, launches_of, loop_body
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.benchmarks.learner_step import LearnerProgram, Network, Options, Size, learner_program
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS
from kinetix_dist.errors import UserError
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.sharding import DATA_AXIS
from kinetix_dist.learner.update import make_update
from kinetix_dist.level.level import SIZES
from kinetix_dist.models.kernels.support import KernelError, compiling_for

WORLDS = 2_048
MINIBATCHES = 2  # so that the compiler keeps the loop over minibatches
COPY_BYTES_A_SECOND = 4.3e12  # what a copy reaches on an H200
COMPILER_OPTIONS: dict[str, Any] = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}

# What the compiler asks of a device, see NVIDIA's data sheet and cudaGetDeviceProperties.
H200 = """
gpu_device_info {
  name: "NVIDIA H200" device_vendor: "NVIDIA Corporation"
  cuda_compute_capability { major: 9 minor: 0 feature_extension: ACCELERATED_FEATURES }
  core_count: 132 fpus_per_core: 128 clock_rate_ghz: 1.98
  memory_bandwidth: 4800000000000 l2_cache_size: 62914560 device_memory_size: 150754820096
  threads_per_warp: 32 threads_per_block_limit: 1024 threads_per_core_limit: 2048
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  shared_memory_per_block: 49152 shared_memory_per_block_optin: 232448 shared_memory_per_core: 233472
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  thread_dim_limit_x: 1024 thread_dim_limit_y: 1024 thread_dim_limit_z: 64
  device_address_bits: 64 platform_version: "Compute Capability 9.0a"
  driver_version: "13.0.0" runtime_version: "13.0.0" compile_time_toolkit_version: "13.0.0" dnn_version: "9.10.0"
}
platform_name: "CUDA" device_description_str: "NVIDIA H200"
dnn_version_info { major: 9 minor: 10 patch: 0 }
"""

# The part of a launch: that of its innermost (file, function), or else named scope ("", scope), that is in one.
PARTS: dict[str, Callable[[str, str], bool]] = {
    "gates": lambda file, function: file == "gate.py" or function.endswith("._gate"),
    "attention": lambda file, function: (
        file == "attention.py" or function.endswith(("._attention", "_attention_branch"))
    ),
    "feed forward": lambda file, function: function.endswith("._feed_forward"),
    "messages": lambda file, function: (
        file in ("rows.py", "messages.py")
        or function in ("_messages", "_add_messages", "EntityTransformer._message_terms")
    ),
    "encoders": lambda file, function: file == "encoders.py" or function.endswith(("_encode", "_encoder")),
    "read-out": lambda file, function: file == "colour_readout.py" or function.endswith("._told"),
    "masks, pooling": lambda file, function: (
        function in ("_token_masks", "EntityTransformer.__call__") or function.startswith("_masked_mean")
    ),
    "towers, loss": lambda file, function: (
        file in ("towers.py", "gru.py", "ppo_loss.py", "categorical.py")
        or function.startswith(("_gradient", "minibatch_loss"))
        or function == "towers"
    ),
    "optimiser": lambda file, function: file == "update.py" and function.startswith("_apply"),
    "samples": lambda file, function: (
        file == "entities.py" or function.startswith("_update.<locals>.minibatch.<locals>")
    ),
}
OTHER = "other"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Traffic:
    """Of one gradient step."""

    part: str
    launches: int
    read_bytes: float
    written_bytes: float

    @property
    def bytes(self) -> float:
        return self.read_bytes + self.written_bytes


def h200() -> Any:
    """A described device. Raises UserError where jax cannot compile for one."""
    # Its check of libraries looks for cuDNN and others, which nothing here calls.
    os.environ.setdefault("JAX_SKIP_CUDA_CONSTRAINTS_CHECK", "1")
    try:
        topology = topologies.get_topology_desc(platform="cuda", topology_name="", topology="1x1x1", target_config=H200)
    except (NotImplementedError, RuntimeError, ValueError) as error:
        raise UserError(
            f"jax {jax.__version__} cannot compile for CUDA here ({error}); "
            'install "jax[cuda13]" of the same version under Python 3.12 or later, and unset JAX_PLATFORMS'
        ) from error
    return topology.devices[0]


def compiled_update(program: LearnerProgram, config: PpoConfig, device: Any) -> str:
    """The text of the update of `bench learner`, compiled for `device`."""
    mesh = Mesh(np.array([device]), (DATA_AXIS,))
    obs = program.first_obs()
    params = jax.eval_shape(lambda key: program.policy.init(key, obs), jax.random.key(0))
    state = jax.eval_shape(config.initial_state, params, jax.random.key(0))
    last_value = jax.ShapeDtypeStruct(program.trajectory.rewards.shape[1:], np.float32)
    update = make_update(program.policy, program.observation, ACTIONS, config, mesh)
    return compiled(update, mesh, state, program.static, program.trajectory, last_value).as_text()


def compiled(
    update: Any,
    mesh: Mesh,
    state: Any,
    static: Any,
    trajectory: Any,
    last_value: Any,
    compiler_options: dict[str, Any] = COMPILER_OPTIONS,
) -> Any:
    """An update (`make_update`), compiled for the device of `mesh` and arguments like these."""
    return update.lower(
        shapes(mesh, state),
        shapes(mesh, static, DATA_AXIS),
        shapes(mesh, trajectory, None, DATA_AXIS),
        shapes(mesh, last_value, DATA_AXIS),
    ).compile(compiler_options=compiler_options)


def shapes(mesh: Mesh, tree: Any, *axes: str | None) -> Any:
    """Shapes and types of `tree`, laid over these axes of the mesh."""
    sharding = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def part_of(launch: Launch) -> str:
    for file, function in (*launch.stack, *(("", scope) for scope in launch.scopes)):
        for part, is_of in PARTS.items():
            if is_of(Path(file).name, function):
                return part
    # A product whose callers the compiler forgot: only those of messages are in no method of the network.
    if any(Path(file).name == "contraction.py" for file, _ in launch.stack):
        return "messages"
    return OTHER


def by_part(launches: list[Launch]) -> list[Traffic]:
    """One row for each part that launches anything, in the order of PARTS."""
    rows = []
    for part in (*PARTS, OTHER):
        mine = [x for x in launches if part_of(x) == part]
        if mine:
            rows.append(
                Traffic(
                    part=part,
                    launches=sum(x.times for x in mine),
                    read_bytes=sum(x.times * x.read_bytes for x in mine),
                    written_bytes=sum(x.times * x.written_bytes for x in mine),
                )
            )
    return rows


def measure(size: Size, network: Network, options: Any, device: Any) -> dict[str, Any]:
    """The record of one network at one size."""
    learner = Options(
        size=size,
        network=network,
        dtype=options.dtype,
        encoder_size=options.encoder_size,
        kernels=options.kernels,
        minibatch=options.minibatch,
        worlds=WORLDS,
        steps=MINIBATCHES * options.minibatch // WORLDS,
    )
    config = PpoConfig(epochs=1, minibatches=MINIBATCHES)
    started = time.perf_counter()
    try:
        with compiling_for(device):
            program = CompiledText(compiled_update(learner_program(learner), config, device))
    except KernelError as error:
        raise UserError(str(error)) from error
    rows = by_part(launches_of(program, loop_body(program)))
    total = sum(row.bytes for row in rows)
    return {
        "benchmark": "learner_traffic",
        "size": size,
        "network": network,
        "dtype": options.dtype,
        "kernels": options.kernels,
        "encoder_size": options.encoder_size,
        "minibatch": options.minibatch,
        "jax": jax.__version__,
        "target": "NVIDIA H200",
        "launches": sum(row.launches for row in rows),
        "bytes": round(total),
        "milliseconds_of_traffic": round(1e3 * total / COPY_BYTES_A_SECOND, 3),
        "compile_seconds": round(time.perf_counter() - started, 1),
        "parts": [dataclasses.asdict(row) for row in rows],
    }


def table(record: dict[str, Any]) -> str:
    lines = [
        f"{record['network']} at {record['size'].upper()}, {record['minibatch']:,} samples, {record['dtype']}, "
        f"kernels {record['kernels']}",
        f"  {'part':16s} {'launches':>8s} {'read, GB':>9s} {'written':>9s} {'share':>6s}",
    ]
    for row in record["parts"]:
        read, written = row["read_bytes"] / 1e9, row["written_bytes"] / 1e9
        share = 1e9 * (read + written) / record["bytes"]
        lines.append(f"  {row['part']:16s} {row['launches']:8d} {read:9.3f} {written:9.3f} {share:6.1%}")
    lines.append(
        f"  {'all':16s} {record['launches']:8d} {record['bytes'] / 1e9:9.3f} GB, "
        f"{record['milliseconds_of_traffic']:.2f} ms at {COPY_BYTES_A_SECOND / 1e12:g} TB/s"
    )
    return "\n".join(lines)


def main() -> int:
    parser = parser_of(__doc__, prog="python -m bench.learner_traffic")
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l"], choices=list(SIZES))
    parser.add_argument(
        "--networks", nargs="+", default=["transformer", "transformer_lean"], help="of PolicyConfig.network"
    )
    parser.add_argument("--minibatch", type=int, default=16_384, help="samples of a gradient step")
    parser.add_argument("--dtype", default="bfloat16", choices=["float32", "bfloat16"], help="of activations")
    parser.add_argument("--encoder-size", type=int, default=128, help="width of tokens and of hidden layers")
    parser.add_argument("--kernels", default="xla", choices=["xla", "fused"], help="as policy.kernels")
    parser.add_argument("--json", type=output_file, help="write the records here")
    options = parser.parse_args()

    def work() -> int:
        check(options)
        device = h200()
        asked = itertools.product(options.networks, options.sizes)
        report_each((measure(size, network, options, device) for network, size in asked), options.json, text=table)
        return 0

    return exit_code(parser, work)


def check(options: Any) -> None:
    """Raises UserError for what cannot be compiled."""
    known = ("transformer", "transformer_lean", "flat")
    for network in options.networks:
        if network not in known:
            raise UserError(f"--networks has {network!r}; choose from {', '.join(known)}")
    if options.minibatch < WORLDS or options.minibatch % WORLDS:
        raise UserError(f"--minibatch is {options.minibatch}; give a multiple of the {WORLDS:,} worlds of an update")
    if options.encoder_size < 1:
        raise UserError(f"--encoder-size is {options.encoder_size}; give 1 or more")


if __name__ == "__main__":
    sys.exit(main())
