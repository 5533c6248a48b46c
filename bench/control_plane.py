"""Cost of the control plane of a run: starting so many processes, and the messages of one update to all of them.

    python -m bench.control_plane --processes 4 16 64 --json runs/control_plane.json
    python -m bench.control_plane --processes 4 16 64 --learns                  # a dry run: all form one JAX world

Processes are the Ray actors of a run on one machine with a core that computes nothing, or that takes a gradient step
of a tiny network together with all others: seconds to start all, to call all of them once as an update does (a call
each, all answers awaited), and what memory they take. CPU seconds are those of the driver and of Ray, without the
processes themselves: where these share a few cores with each other, the time of an update is mostly theirs. A number
that memory does not hold is left out, and its record says so.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from typing import Any

import psutil

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError

ROUNDS = 50  # of calls; the median counts
BYTES_PER_PROCESS = 160 << 20  # its own, an estimate, to leave out what would not fit
HIDDEN = 64  # units of the tiny network
ON_CPU = {"JAX_PLATFORMS": "cpu"}


class Idle:
    """A core that answers at once with what an update answers: some metrics and seconds."""

    def run_update(self, number: int) -> tuple[dict[str, float], dict[str, float]]:
        return {f"metric/{index}": float(number) for index in range(40)}, {"rollout": 0.0, "learn": 0.0}


def build_idle(index: int, num_processes: int) -> Idle:
    del index, num_processes
    return Idle()


class TinyLearner(Idle):
    """The same after a gradient step: a network of one layer, its gradient the mean over all processes."""

    def __init__(self) -> None:
        import jax
        import jax.numpy as jnp
        import numpy as np
        from jax.sharding import PartitionSpec

        from kinetix_dist.learner.sharding import DATA_AXIS, data_mesh, on_devices, replicate, shard_worlds

        mesh = data_mesh()

        def step(weights: Any, x: Any) -> Any:
            gradient = jax.grad(lambda w: jnp.square(x @ w).mean())(weights)
            return weights - 0.01 * jax.lax.pmean(gradient, DATA_AXIS)

        specs = {"in_specs": (PartitionSpec(), PartitionSpec(DATA_AXIS)), "out_specs": PartitionSpec()}
        self._step = jax.jit(on_devices(step, mesh, **specs))
        self._weights = replicate(np.ones((HIDDEN, HIDDEN), np.float32), mesh)
        self._x = shard_worlds(np.ones((1, HIDDEN), np.float32), mesh)

    def run_update(self, number: int) -> tuple[dict[str, float], dict[str, float]]:
        self._weights = self._step(self._weights, self._x)
        self._weights.block_until_ready()
        return super().run_update(number)


def build_tiny_learner(index: int, num_processes: int) -> TinyLearner:
    del index, num_processes
    return TinyLearner()


def measure(count: int, *, learns: bool = False) -> dict[str, object]:
    """A record of `count` processes; learns: that form one JAX world."""
    from kinetix_dist.runtime.cores.build import MODULES
    from kinetix_dist.runtime.processes.placement import ProcessPlan
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    record: dict[str, object] = {"benchmark": "control_plane", "processes": count, "learns": learns}
    record |= {"cores": psutil.cpu_count(), "load": [round(value, 1) for value in os.getloadavg()]}
    available = psutil.virtual_memory().available
    if available < count * BYTES_PER_PROCESS:
        return record | {
            "left_out": f"{available >> 20} MiB of memory are free, about {BYTES_PER_PROCESS >> 20} a process"
        }
    backend = RayBackend(heartbeat_seconds=600.0, modules=MODULES)  # as a run does
    try:
        began = time.monotonic()
        role, build = ("worker", build_tiny_learner) if learns else ("rollout", build_idle)
        plans = [ProcessPlan(role=role, index=index, env_vars=ON_CPU) for index in range(count)]
        handles = backend.spawn(plans, build)
        started = time.monotonic() - began
        backend.gather([handle.call(Idle.run_update, 0) for handle in handles])  # compiles, where there is what to
        rounds, cpu = [], _cpu_seconds(handles)
        for number in range(ROUNDS):
            began = time.monotonic()
            backend.gather([handle.call(Idle.run_update, number) for handle in handles])
            rounds.append(time.monotonic() - began)
        cpu = _cpu_seconds(handles) - cpu
        memory = [psutil.Process(handle.pid).memory_full_info() for handle in handles if handle.pid is not None]
        return record | {
            "start_seconds": round(started, 3),
            "update_milliseconds": round(1e3 * statistics.median(rounds), 3),
            "update_milliseconds_slowest": round(1e3 * max(rounds[1:]), 3),
            "control_cpu_milliseconds": round(1e3 * cpu / ROUNDS, 3),
            "resident_mib_per_process": round(statistics.mean(one.rss for one in memory) / (1 << 20), 1),
            "own_mib_per_process": round(statistics.mean(one.uss for one in memory) / (1 << 20), 1),
        }
    finally:
        backend.stop()


def _cpu_seconds(handles: Any) -> float:
    """CPU seconds of this process and of its descendants, but for the processes of the run."""
    own, here = {handle.pid for handle in handles}, psutil.Process()
    others = [process for process in here.children(recursive=True) if process.pid not in own]
    times = [process.cpu_times() for process in [here, *others]]
    return sum(one.user + one.system for one in times)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--processes", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--learns", action="store_true", help="they form one JAX world and learn")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    if min(options.processes) < 1:
        raise UserError(f"--processes has {min(options.processes)}; give numbers of processes, each 1 or more")
    report_each((measure(count, learns=options.learns) for count in options.processes), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
