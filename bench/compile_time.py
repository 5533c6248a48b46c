"""Seconds until the first step of an engine, with nothing cached and in a second process that finds the cache.

    python bench/compile_time.py [--sizes s m l 64 128 512] [--compute-capability 9.0] [--json FILE]

A size is s, m, l, or a number of shapes without joints. Each measurement is a process of its own with caches in a new
folder: "cold" compiles the kernel and the program around it, "cached" loads both. Times are from before the first step
to its result; imports and building the scene are not part of them. `cpu_seconds` is the processor time of the same
span, which a busy machine changes less. `--compute-capability` also compiles for a GPU of that kind, which need not be
there, and reads from the result how much local memory a thread takes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax

from bench.program import exit_code, output_file, parser_of
from jax2d import Capacity, Effects, Engine, SceneBuilder, preset
from jax2d.warp.memory import thread_bytes
from kinetix_dist.benchmarks.growth_scenes import capacity_of
from kinetix_dist.child_python import command_of
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.level.level import SIZES

CHECKOUT = str(Path(__file__).resolve().parent.parent)


def capacity_named(size: str) -> Capacity:
    """Capacity of size s, m, l or of a number of shapes; raises UserError for anything else."""
    if size in SIZES:
        return SIZES[size]
    if not size.isdigit():
        raise UserError(f"--sizes has {size!r}; give s, m, l, or a number of shapes")
    with user_errors(ValueError):
        return capacity_of(int(size))


def first_step(size: str) -> dict:
    """Runs in the measured process: one world of one resting ball, stepped once."""
    capacity = capacity_named(size)
    builder = SceneBuilder(capacity)
    builder.add_circle(radius=0.5)
    world = builder.build()
    engine = Engine(capacity)
    scene, state = jax.tree.map(lambda x: x[None], (world.scene, engine.initial_state(*world)))
    packed = jax.block_until_ready((engine.pack_scene(scene), engine.pack_state(state), engine.no_controls(1)))
    wall, processor = time.perf_counter(), time.process_time()
    jax.block_until_ready(jax.jit(engine.step_packed)(*packed))
    return {
        "size": size,
        "shapes": capacity.shapes,
        "device": jax.devices()[0].device_kind,
        "seconds": round(time.perf_counter() - wall, 3),
        "cpu_seconds": round(time.process_time() - processor, 3),
    }


def compile_for_gpu(size: str, compute_capability: str) -> dict:
    """Runs in the measured process. Warp's cache is left empty."""
    capacity = capacity_named(size)
    wall, processor = time.perf_counter(), time.process_time()
    local = thread_bytes(capacity, preset("standard"), Effects.full(capacity), compute_capability)
    return {
        "size": size,
        "shapes": capacity.shapes,
        "device": f"compute capability {compute_capability}, compiled only",
        "seconds": round(time.perf_counter() - wall, 3),
        "cpu_seconds": round(time.process_time() - processor, 3),
        "thread_bytes": local,
    }


def measure(size: str, compute_capability: str | None) -> list[dict]:
    records = []
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "WARP_CACHE_PATH": f"{folder}/warp",
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "PYTHONPATH": os.pathsep.join([CHECKOUT, *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        runs = [("cold", "--first-step"), ("cached", "--first-step")]
        if compute_capability is not None:
            runs.append(("cold", f"--compute-capability={compute_capability}"))
        for cache, what in runs:
            command = command_of(__file__, "--in-this-process", size, what)
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode != 0:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise SystemExit(f"the process that was to compile size {size} failed: {last}")
            records.append({"cache": cache} | json.loads(done.stdout.splitlines()[-1]))
            row = "{size:>4} {cache:<7} {seconds:8.2f} s {cpu_seconds:8.2f} s of processor, {device}"
            print(row.format(**records[-1]), flush=True)
    return records


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l", "64", "128", "512"])
    parser.add_argument("--json", type=output_file)
    parser.add_argument("--compute-capability")
    parser.add_argument("--in-this-process", help=argparse.SUPPRESS)
    parser.add_argument("--first-step", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.in_this_process is not None:
        size = arguments.in_this_process
        record = first_step(size) if arguments.first_step else compile_for_gpu(size, arguments.compute_capability)
        print(json.dumps(record))
        return 0
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    for size in arguments.sizes:
        capacity_named(size)  # refused before anything is compiled
    records = [record for size in arguments.sizes for record in measure(size, arguments.compute_capability)]
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
