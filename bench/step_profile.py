"""Where the time of training goes: microseconds of each kernel of a step of the rollout and of a gradient step.

    python -m bench.step_profile                                       # pretrain_m, both
    python -m bench.step_profile --recipes pretrain_l --network transformer --programs update --json runs/profile.json

Rollout and update of a recipe, with levels drawn at random, are timed and then traced once (jax.profiler). Each kernel
of the trace carries the name of its instruction, and the compiled program says where that comes from and what it reads
and writes: microseconds stand beside those that its bytes take at the speed of a copy. Loops are not made CUDA graphs,
in whose traces instructions have no names. On a CPU it shows how it works; what counts there are operations of XLA's
thread pool, which overlap.
"""

from __future__ import annotations

import collections
import dataclasses
import gzip
import json
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from bench import learner_traffic, training_memory
from bench.compiled_traffic import CompiledText, Launch, launches_of, loop_body
from bench.learner_traffic import COPY_BYTES_A_SECOND
from bench.program import exit_code, output_file, parser_of, report_each
from bench.training_memory import Programs, configuration
from kinetix_dist.benchmarks.measuring import median_seconds
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.learner.sharding import replicate
from kinetix_dist.models.kernels.support import KERNELS
from kinetix_dist.models.policy import NETWORKS

CURRICULUM = "domain_randomization"  # of what is profiled: it needs no buffer
COMPILER_OPTIONS = {"xla_gpu_enable_command_buffer": ""}
PARTS: dict[str, Callable[[Launch], str]] = {"rollout": training_memory.part_of, "update": learner_traffic.part_of}


def profiled(name: str, options: Any) -> TrainConfig:
    """A recipe with the worlds, steps and network asked for, one epoch and random levels. Raises ValueError."""
    config = configuration(name, options.worlds, options.network)
    minibatch = config.rollout.steps_per_update // config.ppo.minibatches
    return dataclasses.replace(
        config,
        curriculum=dataclasses.replace(config.curriculum, name=CURRICULUM),
        rollout=dataclasses.replace(config.rollout, num_steps=options.steps),
        policy=dataclasses.replace(config.policy, kernels=options.kernels),
        ppo=dataclasses.replace(config.ppo, epochs=1, minibatches=options.worlds * options.steps // minibatch),
    )


def kernel_microseconds(trace: Path) -> collections.Counter[str]:
    """Microseconds by name of the instruction, of all events of a trace that have one."""
    found: collections.Counter[str] = collections.Counter()
    for file in trace.rglob("*.trace.json.gz"):
        with gzip.open(file) as stream:
            for event in json.load(stream)["traceEvents"]:
                if event.get("ph") == "X" and (name := event.get("args", {}).get("hlo_op")):
                    found[name] += event["dur"]
    return found


def source_of(launch: Launch) -> str:
    """The innermost function of the project that a launch comes from, or else its scopes. Kernels of Pallas have no
    frames of their own (models/kernels/stable_programs.py): the jitted function that they are in."""
    for file, function in launch.stack:
        if Path(file).name == "stable_programs.py":
            return next(found[1] for scope in launch.scopes if (found := re.search(r"jit\((\w+)\)", scope)))
        if "kinetix_dist/" in file or "jax2d/" in file:
            return f"{Path(file).name}:{function}"
    return "/".join(launch.scopes[:2])


def measure(name: str, program: str, options: Any) -> dict[str, Any]:
    """The record of one program of one recipe."""
    config = profiled(name, options)
    programs = Programs(config, jax.devices()[0])
    iterations, call = (_rollout if program == "rollout" else _update)(programs)
    compiled, arguments = call
    seconds = median_seconds(lambda: compiled(*arguments), options.repeats)
    with tempfile.TemporaryDirectory(prefix="step_profile_") as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(compiled(*arguments))
        spent = kernel_microseconds(Path(folder))
    text = compiled.as_text()
    if options.text is not None:
        (options.text / f"{name}_{config.policy.network}_{program}.txt").write_text(text)
    found = CompiledText(text)
    kernels: list[dict[str, Any]] = []
    for launch in launches_of(found, loop_body(found, iterations)):
        kernels.append(
            {
                "name": launch.name,
                "part": PARTS[program](launch),
                "source": source_of(launch),
                "microseconds": round(spent.pop(launch.name, 0.0) / iterations, 3),
                "bytes": round(launch.times * (launch.read_bytes + launch.written_bytes)),
            }
        )
    kernels.sort(key=lambda kernel: -kernel["microseconds"])
    return {
        "benchmark": "step_profile",
        "program": program,
        "recipe": name,
        "network": config.policy.network,
        "policy_kernels": config.policy.kernels,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "worlds": options.worlds,
        "minibatch": config.rollout.steps_per_update // config.ppo.minibatches,
        "steps": iterations,
        "microseconds_a_step": round(1e6 * seconds / iterations, 1),
        "microseconds_outside_of_the_loop": round(sum(spent.values()), 1),
        "kernels": kernels,
        "outside": {name: round(us, 1) for name, us in spent.most_common(10)},
    }


def _rollout(programs: Programs) -> tuple[int, tuple[Any, tuple]]:
    """(iterations of its loop, (the compiled program, its arguments))."""
    compiled = programs.rollout(COMPILER_OPTIONS)
    return programs.config.rollout.num_steps, (compiled, replicate(programs.arguments(), programs.mesh))


def _update(programs: Programs) -> tuple[int, tuple[Any, tuple]]:
    """The like, of the update of what the rollout plays."""
    batch, _, _ = programs.rollout(COMPILER_OPTIONS)(*replicate(programs.arguments(), programs.mesh))
    compiled = programs.update(COMPILER_OPTIONS)
    return programs.config.ppo.minibatches, (compiled, (replicate(programs.state(), programs.mesh), *batch))


def table(record: dict[str, Any], rows: int) -> str:
    def row(name: str, kernels: list[dict[str, Any]]) -> str:
        microseconds = sum(kernel["microseconds"] for kernel in kernels)
        traffic = sum(kernel["bytes"] for kernel in kernels)
        at_best = 1e6 * traffic / COPY_BYTES_A_SECOND
        return f"  {microseconds:8.1f} us {at_best:8.1f} {traffic / 1e6:9.1f} MB {len(kernels):4d}  {name}"

    by_part = collections.defaultdict(list)
    for kernel in record["kernels"]:
        by_part[kernel["part"]].append(kernel)
    lines = [
        f"{record['recipe']} ({record['network']}, kernels {record['policy_kernels']}), {record['program']}, "
        f"{record['worlds']:,} worlds, minibatches of {record['minibatch']:,}, on {record['device']}: "
        f"{record['microseconds_a_step']:,.0f} us a step",
        "        us a step, at the speed of a copy, bytes, launches",
        row("all kernels of a step", record["kernels"]),
    ]
    lines += [row(part, kernels) for part, kernels in by_part.items()]
    lines += [row(f"{k['part']}: {k['source']} ({k['name']})", [k]) for k in record["kernels"][:rows]]
    lines.append(f"  outside of the loop, us in all: {record['microseconds_outside_of_the_loop']:,.0f}")
    lines += [f"  {us:10.0f} us  {name}" for name, us in list(record["outside"].items())[:5]]
    return "\n".join(lines)


def check(options: Any) -> None:
    """Raises UserError for what cannot be profiled."""
    if min(options.worlds, options.steps, options.repeats, options.rows) < 1:
        raise UserError("--worlds, --steps, --repeats and --rows must be 1 or more")
    if options.text is not None and not options.text.is_dir():
        raise UserError(f"--text {options.text} is no folder")
    with user_errors(ValueError):
        for name in options.recipes:
            profiled(name, options).check_batch()


def main() -> int:
    parser = parser_of(__doc__, prog="python -m bench.step_profile")
    parser.add_argument("--recipes", nargs="+", default=["pretrain_m"])
    parser.add_argument("--programs", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--worlds", type=int, default=16_384)
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--network", choices=sorted(NETWORKS), help="instead of the recipe's")
    parser.add_argument("--kernels", choices=KERNELS, default="xla")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--rows", type=int, default=30, help="kernels in the table")
    parser.add_argument("--text", type=Path, help="write the compiled programs into this folder")
    parser.add_argument("--json", type=output_file, help="write the records here")
    options = parser.parse_args()

    def work() -> int:
        check(options)
        records = (measure(name, program, options) for name in options.recipes for program in options.programs)
        report_each(records, options.json, text=lambda record: table(record, options.rows))
        return 0

    return exit_code(parser, work)


if __name__ == "__main__":
    sys.exit(main())
