"""What the control plane of a run costs: starting so many processes, and the messages of one update to all of them.

    python -m bench.control_plane --processes 4 16 64 --json runs/control_plane.json

Processes are the Ray actors of a run with a core that computes nothing, on one machine: seconds to start all, to ask
all of them once as an update does (a call each, all answers awaited), and what memory they take. A number that memory
does not hold is left out, and its record says so.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import psutil

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError

ROUNDS = 50  # of calls; the median counts
BYTES_A_PROCESS = 400 << 20  # an estimate, to leave out what would not fit
ON_CPU = {"JAX_PLATFORMS": "cpu"}


class Idle:
    """A core that answers at once with what an update answers: some metrics and seconds."""

    def run_update(self, number: int) -> tuple[dict[str, float], dict[str, float]]:
        return {f"metric/{index}": float(number) for index in range(40)}, {"rollout": 0.0, "learn": 0.0}


def build_idle(index: int, num_processes: int) -> Idle:
    del index, num_processes
    return Idle()


def measure(count: int) -> dict[str, object]:
    """A record of `count` processes."""
    from kinetix_dist.runtime.processes.placement import ProcessPlan
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    record: dict[str, object] = {"benchmark": "control_plane", "processes": count, "cores": psutil.cpu_count()}
    available = psutil.virtual_memory().available
    if available < count * BYTES_A_PROCESS:
        return record | {
            "left_out": f"{available >> 20} MiB of memory are free, about {BYTES_A_PROCESS >> 20} a process"
        }
    backend = RayBackend(heartbeat_seconds=600.0)
    try:
        began = time.monotonic()
        # Not workers: these would form one JAX world, which is another cost.
        plans = [ProcessPlan(role="rollout", index=index, env_vars=ON_CPU) for index in range(count)]
        handles = backend.spawn(plans, build_idle)
        started = time.monotonic() - began
        rounds = []
        for number in range(ROUNDS):
            began = time.monotonic()
            backend.gather([handle.call("run_update", number) for handle in handles])
            rounds.append(time.monotonic() - began)
        resident = [psutil.Process(handle.pid).memory_info().rss for handle in handles if handle.pid is not None]
        return record | {
            "start_seconds": round(started, 3),
            "update_milliseconds": round(1e3 * statistics.median(rounds), 3),
            "update_milliseconds_slowest": round(1e3 * max(rounds[1:]), 3),
            "resident_mib_a_process": round(statistics.mean(resident) / (1 << 20), 1),
        }
    finally:
        backend.stop()


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--processes", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    if min(options.processes) < 1:
        raise UserError(f"--processes has {min(options.processes)}; give numbers of processes, each 1 or more")
    report_each(map(measure, options.processes), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
