"""Seconds until the first step of an engine, with nothing cached and in a second process that finds the cache.

    python bench/compile_time.py [--sizes s m l 64 128 512] [--json FILE]

A size is s, m, l, or a number of shapes without joints. Each measurement is a process of its own with caches in a new
folder: "cold" compiles the kernel and the program around it, "cached" loads both. Times are from before the first step
to its result; imports and building the scene are not part of them. `cpu_seconds` is the processor time of the same
span, which a busy machine does not change.
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


def first_step(size: str) -> dict:
    """In the process measured: one world of one resting ball, stepped once."""
    import jax

    from jax2d import Engine, SceneBuilder
    from kinetix_dist.cli.growth_scenes import capacity_of
    from kinetix_dist.level.level import SIZES

    capacity = SIZES[size] if size in SIZES else capacity_of(int(size))
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


def measure(size: str) -> list[dict]:
    records = []
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "WARP_CACHE_PATH": f"{folder}/warp",
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "PYTHONPATH": str(Path(__file__).resolve().parent.parent),
        }
        for cache in ("cold", "cached"):
            command = [sys.executable, __file__, "--first-step", size]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode != 0:
                raise SystemExit(f"the process that was to step size {size} failed:\n{done.stderr}")
            records.append({"cache": cache} | json.loads(done.stdout.splitlines()[-1]))
            print("{cache:<7} {size:>4} {seconds:8.2f} s {cpu_seconds:8.2f} s of processor".format(**records[-1]))
    return records


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l", "64", "128", "512"])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--first-step", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.first_step:
        print(json.dumps(first_step(arguments.first_step)))
        return
    records = [record for size in arguments.sizes for record in measure(size)]
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
