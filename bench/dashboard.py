"""Speed of the dashboard in a real browser: pages, long runs, live rows; and the server's CPU time and memory.

    python bench/dashboard.py [--browser .cache/browser/chromium] [--json FILE]

Runs are written by training's own sink: 20 of 2,000 updates, one of 200,000. `page` is from the request to a drawn
chart, `row` from a row on disk to its number on the page, `cpu_share` that of one core over 20 s with one run that gets
a row a second and a page that watches it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.child_python import command_of
from kinetix_dist.config import to_dict
from kinetix_dist.errors import UserError
from kinetix_dist.recipes import recipe
from kinetix_dist.telemetry.names import METRICS
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink

NUM_RUNS, NUM_UPDATES, NUM_LONG = 20, 2000, 200_000
REPEATS = 5
LIVE_SECONDS = 20
STEPS = 10_000  # of an update: 1.01 M, 1.02 M, ... from the 101st on, which the page distinguishes
FIRST_LIVE = 100  # updates of the live run before it is watched
NAMES = [name for name in METRICS if "<" not in name and not name.startswith("progress/")][:44]  # rows of 1.2 kB
DRAWN = "() => document.querySelectorAll('.chart canvas').length > 3"
CHECKOUT = Path(__file__).resolve().parent.parent


def write_rows(run: Path, first: int, last: int) -> None:
    sink = JsonlSink(run / "metrics" / "metrics.jsonl", resume_at=None)
    for update in range(first, last + 1):
        row = {name: round(update * k % 97 / 97, 6) for k, name in enumerate(NAMES, 1)}
        sink.write(update, row | {"progress/env_steps": STEPS * update, "progress/seconds": 2.0 * update})
    sink.close()


def write_run(run: Path, updates: int) -> Path:
    run.mkdir(parents=True)
    config = recipe("quickstart")
    (run / "config.json").write_text(json.dumps({"hash": config.hash, "config": to_dict(config)}))
    write_rows(run, 1, updates)
    return run


@contextmanager
def serving(*paths: Path | str, name: str = "dashboard") -> Iterator[tuple[str, psutil.Process]]:
    """Address and process of a dashboard (or `name="edit"`) over paths."""
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "PYTHONUNBUFFERED": "1"}
    command = command_of("kinetix_dist.cli.main", name, "--port", 0, *paths)
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert server.stdout is not None
        match = re.search(r"http://\S+", server.stdout.readline())
        assert match, "the server did not start"
        yield match[0], psutil.Process(server.pid)
    finally:
        server.terminate()
        server.wait()


def measure(browser: Any, runs: Path, long: Path) -> dict[str, Any]:
    with serving(runs, long) as (address, server):
        return _measure(browser, address, server)


def _measure(browser: Any, address: str, server: psutil.Process) -> dict[str, Any]:
    page = browser.new_context(viewport={"width": 1600, "height": 900}, locale="en-US").new_page()
    page.set_default_timeout(120_000)
    base = address.split("?")[0]
    page.goto(address)
    page.wait_for_selector("table.runs")

    def seconds_to(view: str, wait: Any) -> float:
        page.goto("about:blank")
        start = time.monotonic()
        page.goto(base + view)
        wait()
        return time.monotonic() - start

    result: dict[str, Any] = {}
    list_seconds = [seconds_to("#/runs", lambda: page.wait_for_selector("table.runs")) for _ in range(REPEATS)]
    result["runs_page_seconds"] = list_seconds
    overview = [seconds_to(f"#/run/run_{k}/overview", lambda: page.wait_for_function(DRAWN)) for k in range(REPEATS)]
    result["overview_page_seconds"] = overview
    result["long_run_seconds"] = seconds_to("#/run/long/overview", lambda: page.wait_for_function(DRAWN))
    result["server_mib_after_long_run"] = server.memory_info().rss / 2**20
    return result


def measure_live(browser: Any, run: Path) -> dict[str, Any]:
    with serving(run) as (address, server):
        page = browser.new_context(locale="en-US").new_page()
        page.goto(address)
        page.wait_for_selector("table.runs")
        page.goto(address.split("?")[0] + "#/run/live/overview")
        page.wait_for_function(DRAWN)
        delays: list[float] = []
        before, start = server.cpu_times(), time.monotonic()
        for update in range(FIRST_LIVE + 1, FIRST_LIVE + 1 + LIVE_SECONDS):
            write_rows(run, update, update)
            written = time.monotonic()
            if update % 2:
                shown = json.dumps(f"{float(f'{STEPS * update / 1e6:.3g}'):g} M of")
                page.wait_for_function(f"() => document.querySelector('.facts').textContent.includes({shown})")
                delays.append(time.monotonic() - written)
            time.sleep(max(0.0, 1.0 - (time.monotonic() - written)))
        after = server.cpu_times()
        used = after.user + after.system - before.user - before.system
        return {
            "row_seconds": delays,
            "cpu_share": used / (time.monotonic() - start),
            "server_mib": server.memory_info().rss / 2**20,
        }


def add_browser_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--browser", type=Path, default=CHECKOUT / ".cache" / "browser" / "chromium")


@contextmanager
def launched(program: Path, *, has_webgl: bool = True) -> Iterator[Any]:
    """A headless Chromium, by a software renderer: with WebGL, which costs more for every picture, or without. Raises
    UserError where there is none."""
    if not program.is_file():
        raise UserError(f"--browser {program} is no file; `make browser` fetches one")
    from playwright.sync_api import sync_playwright

    renderer = ["--use-gl=angle", "--use-angle=swiftshader"] if has_webgl else ["--disable-gpu"]
    options = ["--headless", "--no-sandbox", *renderer]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(program), args=options)
        yield browser
        browser.close()


def main() -> int:
    parser = parser_of(__doc__)
    add_browser_argument(parser)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory() as folder, launched(arguments.browser) as browser:
        runs = Path(folder) / "runs"
        for k in range(NUM_RUNS):
            write_run(runs / f"run_{k}", NUM_UPDATES)
        long = write_run(Path(folder) / "long", NUM_LONG)
        live = write_run(Path(folder) / "live", FIRST_LIVE)
        result = measure(browser, runs, long) | measure_live(browser, live)
    for name, value in result.items():
        shown = (
            f"{statistics.median(value):.3f} (median of {len(value)})" if isinstance(value, list) else f"{value:.3f}"
        )
        print(f"{name:28s} {shown}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result | {"load": os.getloadavg()}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
