"""Speed of the engine worker of the web pages: start, checks, sessions, attempts, thumbnails; and its memory.

    python -m bench.engine_worker --json runs/engine_worker.json

Times are those of a client at the other end of the pipe. `first` includes compiling, or reading compiled programs from
the compile cache; a second run shows the latter.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import psutil

from bench.program import exit_code, output_file, parser_of
from bench.worker_client import Client
from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, LEVELS, REFRESH, write_snapshot

DOCUMENTS = {"s": "s/swing_up", "m": "m/rocket_car", "l": "l/walker"}
POLICY = {"checkpoint": "generalist"}
REPEATS = 20
STEPS = 100
NUM_THUMBNAILS = 1024
ENDLESS = {"max_steps": 100_000}


def level_of(size: str) -> dict[str, Any]:
    return {"document": json.loads((levels_root() / f"{DOCUMENTS[size]}.json").read_text())}


def seconds_of(work: Callable[[], Any]) -> float:
    began = time.monotonic()
    work()
    return time.monotonic() - began


def measure(client: Client, play_seconds: float) -> dict[str, Any]:
    record: dict[str, Any] = {"benchmark": "engine_worker", "cores": os.cpu_count(), "load": os.getloadavg()[0]}
    record |= {f"check_{size}": _check(client, size) for size in DOCUMENTS}
    for name, policy in (("keys", "keys"), ("policy", POLICY)):
        record |= {f"open_{name}_{size}": _session(client, size, policy) for size in DOCUMENTS}
    record["play_30_hz"] = _play(client, "keys", play_seconds)
    record["play_30_hz_policy"] = _play(client, POLICY, play_seconds)
    record |= {f"attempts_64_{size}": _attempts(client, size) for size in ("s", "l")}
    record["thumbnails_1024_l"] = _thumbnails(client)
    record["resident_mb"] = psutil.Process(client.process.pid).memory_info().rss / 1e6
    return record


def _check(client: Client, size: str) -> dict[str, float]:
    document = level_of(size)["document"]
    first = seconds_of(lambda: client.request("check", document=document))

    def median_ms(play: bool) -> float:
        times = [seconds_of(lambda: client.request("check", document=document, play=play)) for _ in range(REPEATS)]
        return 1e3 * statistics.median(times)

    return {"first_s": first, "median_ms": median_ms(True), "without_play_ms": median_ms(False)}


def _session(client: Client, size: str, policy: Any) -> dict[str, float]:
    def open_one() -> int:
        return client.request("play.open", level=level_of(size), policy=policy, env=ENDLESS)["session"]

    first = seconds_of(open_one)
    client.close_sessions()
    again = seconds_of(open_one)
    (session,) = client.sessions
    steps = [seconds_of(lambda: client.request("play.control", session=session, do="step")) for _ in range(STEPS)]
    client.close_sessions()
    return {"first_s": first, "again_s": again, "step_round_trip_ms": 1e3 * statistics.median(steps)}


def _play(client: Client, policy: Any, seconds: float) -> dict[str, float]:
    session = client.request("play.open", level=level_of("s"), policy=policy, env=ENDLESS)["session"]
    client.others.clear()
    client.request("play.control", session=session, do="run")
    end, times = time.monotonic() + seconds, []
    while time.monotonic() < end:
        client.other("frame")
        times.append(time.monotonic())
    client.close_sessions()
    gaps = 1e3 * np.diff(times)
    return {"frames": len(times), "median_ms": float(np.median(gaps)), "p95_ms": float(np.percentile(gaps, 95))}


def _attempts(client: Client, size: str) -> dict[str, float]:
    def attempt() -> None:
        client.request("attempts", level=level_of(size), policy=POLICY, attempts=64)

    return {"first_s": seconds_of(attempt), "warm_s": statistics.median(seconds_of(attempt) for _ in range(3))}


def _thumbnails(client: Client) -> dict[str, float]:
    levels, _ = load_level_set("random_l", num_levels=256)
    many = jax.tree.map(lambda x: np.concatenate([x] * (NUM_THUMBNAILS // 256)), levels)
    arrays = {LEVELS + name: array for name, array in flatten_arrays(many).items()}
    with tempfile.TemporaryDirectory() as run:
        write_snapshot(Path(run) / DIRECTORY, REFRESH, 0, {"size": np.str_("l"), **arrays})

        def request() -> int:
            request = client.send("thumbnails", run=run, refresh=0, indices=list(range(NUM_THUMBNAILS)))
            return len(client.wait(request).body)

        first = seconds_of(request)
        return {
            "first_s": first,
            "warm_s": statistics.median(seconds_of(request) for _ in range(3)),
            "mb": request() / 1e6,
        }


def main() -> int:
    parser = parser_of(__doc__, "python -m bench.engine_worker")
    parser.add_argument("--json", type=output_file, help="write the record here")
    parser.add_argument("--play-seconds", type=float, default=15.0, help="of play at 30 Hz, for each of two players")
    arguments = parser.parse_args()
    return exit_code(parser, lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        client = Client(log=Path(folder) / "log")
        start = time.monotonic() - began
        try:
            record = {"start_s": start, **measure(client, arguments.play_seconds)}
        finally:
            client.close()
    for name, values in record.items():
        shown = values if not isinstance(values, dict) else {key: round(value, 3) for key, value in values.items()}
        print(f"{name}: {shown}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
