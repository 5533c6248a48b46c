"""Cost of a server that follows a run, and of a page in a browser, to the training of the run.

    python -m bench.training_with_dashboard --json runs/training_with_dashboard.json

One run of a recipe. `kinetix-dist dashboard` serves it, and its overview is open in a headless Chromium on the same
cores. Updates alternate in the order with, without, without, with: without, the server and the browser are stopped
(SIGSTOP), so that all else is the same and machines that others use drift alike for both.

`cpu_seconds` of an update are those of the training command and its children between two rows of metrics,
`wall_seconds` the time between them. CPU seconds of server and browser stand apart. The first updates, which compile,
are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from bench.dashboard import CHECKOUT, DRAWN, add_browser_argument, launched, serving
from bench.program import exit_code, output_file, parser_of
from kinetix_dist.child_python import command_of
from kinetix_dist.errors import UserError
from kinetix_dist.studio.runs.run_files import METRICS, last_row
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row

LOOK_MS = 20  # between looks for a row
LEFT_OUT = 3  # updates at the start: they compile, and the page is opened
ORDER = (True, False, False, True)
RESAMPLES = 10_000
VIEWPORT: Any = {"width": 1600, "height": 900}


def family(root: psutil.Process) -> list[psutil.Process]:
    """Process with all its descendants, now."""
    return [root, *root.children(recursive=True)]


def cpu_seconds(processes: list[psutil.Process]) -> float:
    """CPU seconds of each process and of its children that have ended."""
    return sum(sum(process.cpu_times()[:4]) for process in processes)


def send(number: signal.Signals, processes: list[psutil.Process]) -> None:
    for process in processes:
        process.send_signal(number)


def newest_update(metrics: Path) -> int:
    """Return the update of the last row of a file of metrics; 0 if it has none."""
    row = last_row(metrics, is_row=is_metrics_row).row
    return 0 if row is None else row["update"]


def measure(browser: Any, runs: Path, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A record for each update."""
    run = runs / "run"
    metrics = run / METRICS
    with ExitStack() as stack:
        address, server = stack.enter_context(serving(runs))
        page = browser.new_context(locale="en-US", viewport=VIEWPORT).new_page()
        page.goto(address)
        page.wait_for_selector("nav")
        command = command_of("kinetix_dist.cli.main", "train", "--recipe", arguments.recipe)
        options = ["--run", str(run), "--run.total_env_steps", str(10**12)]
        training = subprocess.Popen(
            [*command, *options], stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(CHECKOUT)}
        )
        stack.callback(training.wait)
        stack.callback(training.terminate)
        trained = psutil.Process(training.pid)

        def wait_for_row(after: int, *, is_watched: bool) -> int:
            while True:
                if training.poll() is not None:
                    raise UserError(f"training ended with {training.returncode}; its lines stand above")
                if (update := newest_update(metrics)) > after:
                    return update
                page.wait_for_timeout(LOOK_MS) if is_watched else time.sleep(LOOK_MS / 1000)

        update = wait_for_row(0, is_watched=True)
        page.goto(f"{address.split('?')[0]}#/run/run/overview")
        page.wait_for_function(DRAWN)
        while update < LEFT_OUT:
            update = wait_for_row(update, is_watched=True)
        # The driver of the browser is left out: this program queries it, as no person does.
        below = psutil.Process().children(recursive=True)
        watching = {"server": [server], "browser": [process for process in below if "chrom" in process.name()]}
        stopped = [process for processes in watching.values() for process in processes]
        records: list[dict[str, Any]] = []
        while len(records) < arguments.updates:
            is_with = ORDER[len(records) % len(ORDER)]
            send(signal.SIGCONT if is_with else signal.SIGSTOP, stopped)
            began, before = time.monotonic(), cpu_seconds(family(trained))
            others = {who: cpu_seconds(processes) for who, processes in watching.items()}
            try:
                update = wait_for_row(update, is_watched=is_with)
                used, elapsed = cpu_seconds(family(trained)) - before, time.monotonic() - began
            finally:
                send(signal.SIGCONT, stopped)
            record = {"update": update, "with": is_with, "cpu_seconds": used, "wall_seconds": elapsed}
            others = {f"{who}_cpu_seconds": cpu_seconds(watching[who]) - used for who, used in others.items()}
            records.append(record | others | {"load": os.getloadavg()[0]})
            print({key: round(value, 2) for key, value in records[-1].items()}, flush=True)
    return records


def ratio(records: list[dict[str, Any]], name: str) -> tuple[float, float, float]:
    """Median with / median without (refreshes and checkpoints come in some updates alone), and its 95 % interval by
    resampling blocks of `ORDER`."""
    blocks = [records[k : k + len(ORDER)] for k in range(0, len(records), len(ORDER))]
    values = np.array([[[r[name] for r in block if r["with"] is arm] for arm in (True, False)] for block in blocks])

    def share(chosen: np.ndarray) -> float:
        return float(np.divide(*(np.median(values[chosen, arm]) for arm in (0, 1))))

    drawn = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile([share(chosen) for chosen in drawn], [2.5, 97.5])
    return share(np.arange(len(values))), float(low), float(high)


def main() -> int:
    parser = parser_of(__doc__, "python -m bench.training_with_dashboard")
    add_browser_argument(parser)
    parser.add_argument("--recipe", default="quickstart")
    parser.add_argument("--updates", type=int, default=32, help="that count; a multiple of 4")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    if arguments.updates < len(ORDER) or arguments.updates % len(ORDER):
        parser.error(f"--updates is {arguments.updates}; give a multiple of {len(ORDER)}")
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory() as folder, launched(arguments.browser, has_webgl=False) as browser:
        records = measure(browser, Path(folder), arguments)
    result: dict[str, Any] = {"recipe": arguments.recipe, "records": records}
    for name in ("cpu_seconds", "wall_seconds"):
        share, low, high = result[name] = ratio(records, name)
        print(f"{name} of an update, with / without: {share:.4f} ({low:.4f} to {high:.4f})")
    watched = [record for record in records if record["with"]]
    for who in ("server", "browser"):
        used = result[who] = sum(r[f"{who}_cpu_seconds"] for r in watched) / sum(r["wall_seconds"] for r in watched)
        print(f"{who}: {used:.4f} of a core")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
