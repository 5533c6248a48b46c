"""Speed of the dashboard in a real browser: pages, long runs, live rows; and the server's CPU time and memory.

    python bench/dashboard.py [--browser .cache/browser/chromium] [--json FILE]

Runs are written by training's own sink: 50 of 2,000 updates, one of 200,000. The 50 have the refreshes, counts and
evaluations of `sfl_s`. `page` is from the request to a drawn chart, `verdict` to the heading of a run that was not read
before, `cold_NAME` to the last panel of a page of such a run; `cpu` is the CPU time of the server and of all processes
of the browser for it, whatever else the machine does. `words` is until the table of runs has a verdict on each of the
50, `runs_page_while_judged` the slowest table meanwhile. `row` from a row on disk to its number on the page,
`cpu_share` that of one core over 20 s with one run that gets a row a second and a page that watches it. `scrolling` is
of the evaluation page with 256 levels x 100 evaluations, two rows further with each frame: frames per second, and the
share of frames that showed a row that was not there.
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.child_python import command_of
from kinetix_dist.config import to_dict
from kinetix_dist.errors import UserError
from kinetix_dist.recipes import recipe
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, OUTCOMES, REFRESH, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line
from kinetix_dist.telemetry.names import METRICS
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink

NUM_RUNS, NUM_UPDATES, NUM_LONG = 50, 2000, 200_000
REPEATS = 5
LIVE_SECONDS = 20
STEPS = 10_000  # of an update: 1.01 M, 1.02 M, ... from the 101st on, which the page distinguishes
FIRST_LIVE = 100  # updates of the live run before it is watched
NAMES = [name for name in METRICS if "<" not in name and not name.startswith("progress/")][:44]  # rows of 1.2 kB
VERDICT = ".verdict[data-state]"
COLD_PAGES = {
    "overview": ".verdict[data-state] ~ .section .chart canvas",
    "curriculum": "[data-panel^='Solve rate by number of shapes'] canvas",
    "evaluation": ".matrix canvas",
}  # by the last part of each that is drawn
NUM_CANDIDATES, NUM_CHOSEN, REFRESH_EVERY, OUTCOMES_EVERY = 12_288, 1024, 128, 16
NUM_LEVELS, NUM_EVALUATIONS, ATTEMPTS = 256, 100, 16
SCROLL_SECONDS = 8
SCROLL = """(milliseconds) => new Promise((done) => {
  const matrix = document.querySelector(".matrix");
  const box = matrix.getBoundingClientRect();
  let begin = null, last = null, step = 52, missing = 0;
  const gaps = [];
  const frame = (now) => {
    begin ??= now;
    if (last !== null) gaps.push(now - last);
    last = now;
    const shown = document.elementFromPoint(box.left + 20, box.top + box.height / 2);
    missing += !shown?.closest(".matrix-row");
    const before = matrix.scrollTop;
    matrix.scrollTop += step;
    if (matrix.scrollTop === before) step = -step;
    if (now - begin < milliseconds) requestAnimationFrame(frame);
    else done({ gaps, missing });
  };
  requestAnimationFrame(frame);
})"""
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


def write_judged(run: Path, updates: int) -> None:
    """Evaluations, refreshes and counts of training, as many and as large as those of `sfl_s`."""
    chance = np.random.default_rng(0)
    for update in range(0, updates + 1, 100):
        sets = {
            name: {"names": [f"{name}_{k}" for k in range(256)], "solved": [1] * 128 + [0] * 128, "attempts": 1}
            for name in ("random_s", "designed_s")
        }
        row = {"format": 1, "phase": "training" if update else "before", "update": update, "reported_at": update}
        append_line(run / "evaluations.jsonl", row | {"env_steps": STEPS * update, "sets": sets})
    (run / DIRECTORY).mkdir()
    for update in range(0, updates, OUTCOMES_EVERY):
        version = update - update % REFRESH_EVERY
        if update == version:
            write_snapshot(run / DIRECTORY, REFRESH, version, _refresh(version, chance))
        attempts = chance.integers(0, 32, NUM_CHOSEN)
        row = {"format": 2, "update": update + OUTCOMES_EVERY, "from_update": update, "buffer": version}
        counts = {"solved": chance.binomial(attempts, 0.5).tolist(), "attempts": attempts.tolist()}
        sources = {"fresh": {"solved": 6000 + update, "attempts": 16_384}}
        append_line(run / DIRECTORY / OUTCOMES, row | counts | {"sources": sources})


def _refresh(version: int, chance: np.random.Generator) -> dict[str, Any]:
    finished = chance.integers(2, 9, NUM_CANDIDATES).astype(np.int32)
    solved = chance.binomial(finished, chance.choice([0.0, 0.5, 1.0], NUM_CANDIDATES)).astype(np.int32)
    features = chance.integers(0, 9, (NUM_CANDIDATES, 6)).astype(np.uint8)
    chosen = np.argsort(-solved * (finished - solved), kind="stable")[:NUM_CHOSEN]
    return {
        "curriculum": np.str_("sfl"), "size": np.str_("s"), "policy_version": np.int32(version),
        "written_after": np.int32(version), "first_batch": np.int32(version), "scoring_seconds": np.float64(1.0),
        "level_id": chosen.astype(np.uint64) + np.uint64(100_000 * version),
        "score": np.zeros(NUM_CHOSEN, np.float32), "features": features[chosen],
        "feature_names": np.array(["shapes", "joints", "motors", "thrusters", "fixed_shapes", "red_shapes"]),
        "candidate": chosen.astype(np.int32), "solved": solved[chosen], "finished": finished[chosen],
        "candidates/solved": solved, "candidates/finished": finished, "candidates/features": features,
    }  # fmt: skip


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
    result |= _measure_table(page, seconds_to)
    overview = [seconds_to(f"#/run/run_{k}/overview", lambda: page.wait_for_function(DRAWN)) for k in range(REPEATS)]
    result["overview_page_seconds"] = overview
    judged = [f"#/run/run_{REPEATS + k}/overview" for k in range(REPEATS)]  # none of them was read before
    result["verdict_seconds"] = [seconds_to(view, lambda: page.wait_for_selector(VERDICT)) for view in judged]
    for number, (name, last) in enumerate(COLD_PAGES.items(), 2):
        runs = range(REPEATS * number, REPEATS * (number + 1))
        before = _cpu_seconds(server)
        views = [f"#/run/run_{k}/{name}" for k in runs]
        result[f"cold_{name}_seconds"] = [seconds_to(view, partial(page.wait_for_selector, last)) for view in views]
        page.wait_for_load_state("networkidle")
        result[f"cold_{name}_cpu_seconds"] = (_cpu_seconds(server) - before) / REPEATS
    result["long_run_seconds"] = seconds_to("#/run/long/overview", lambda: page.wait_for_function(DRAWN))
    result["server_mib_after_long_run"] = server.memory_info().rss / 2**20
    return result


def _measure_table(page: Any, seconds_to: Callable[[str, Any], float]) -> dict[str, Any]:
    """Table of runs: while verdicts are worked out, until there are all, and then."""

    def seconds() -> float:
        return seconds_to("#/runs", lambda: page.wait_for_selector("table.runs"))

    start, judged = time.monotonic(), 0
    meanwhile: list[float] = []
    while judged < NUM_RUNS:
        meanwhile.append(seconds())
        judged = page.locator("a.word").count()
        time.sleep(0.5)
    words = time.monotonic() - start
    return {
        "runs_page_while_judged": max(meanwhile),
        "words_seconds": words,
        "runs_page_seconds": [seconds() for _ in range(REPEATS)],
    }


def _cpu_seconds(server: psutil.Process) -> float:
    """CPU time of a server and of the browser, which this process has started."""
    processes = [server, *(one for one in psutil.Process().children(recursive=True) if "chromium" in one.name())]
    return sum(times.user + times.system for times in (process.cpu_times() for process in processes))


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


def write_evaluations(run: Path) -> Path:
    """A run with evaluations of many levels, of which more and more are solved."""
    write_run(run, NUM_EVALUATIONS)
    names = [f"random_s_{k}" for k in range(NUM_LEVELS)]
    for k in range(NUM_EVALUATIONS):
        solved = [min(ATTEMPTS, k * level % 97 * ATTEMPTS // 97) for level in range(NUM_LEVELS)]
        sets = {"random_s": {"names": names, "solved": solved, "attempts": ATTEMPTS}}
        phase = "training" if k else "before"
        row = {"format": 1, "phase": phase, "update": k, "env_steps": STEPS * k, "reported_at": k, "sets": sets}
        append_line(run / "evaluations.jsonl", row)
    return run


def measure_scrolling(browser: Any, run: Path) -> dict[str, Any]:
    with serving("--no-play", run) as (address, _):
        page = browser.new_context(viewport={"width": 1600, "height": 900}, locale="en-US").new_page()
        page.goto(address)
        page.wait_for_selector("table.runs")
        start = time.monotonic()
        page.goto(address.split("?")[0] + f"#/run/{run.name}/evaluation")
        page.wait_for_selector(".matrix canvas")
        seconds = time.monotonic() - start
        page.wait_for_load_state("networkidle")
        cdp = page.context.new_cdp_session(page)
        cdp.send("Performance.enable", {"timeDomain": "threadTicks"})  # CPU time, whatever else the machine does
        before = _main_thread_seconds(cdp)
        measured = page.evaluate(SCROLL, 1000 * SCROLL_SECONDS)
        gaps = measured["gaps"]
        return {
            "evaluation_page_seconds": seconds,
            "scrolling_frames_per_second": 1000 * len(gaps) / sum(gaps),
            "scrolling_longest_frame_ms": max(gaps),
            "scrolling_p95_frame_ms": sorted(gaps)[int(0.95 * len(gaps))],
            "scrolling_main_thread_ms_per_frame": 1000 * (_main_thread_seconds(cdp) - before) / len(gaps),
            "scrolling_missing_share": measured["missing"] / (len(gaps) + 1),
        }


def _main_thread_seconds(cdp: Any) -> float:
    metrics = cdp.send("Performance.getMetrics")["metrics"]
    return next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration")


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
    with tempfile.TemporaryDirectory() as folder, launched(arguments.browser, has_webgl=False) as browser:
        runs = Path(folder) / "runs"
        for k in range(NUM_RUNS):
            write_judged(write_run(runs / f"run_{k}", NUM_UPDATES), NUM_UPDATES)
        long = write_run(Path(folder) / "long", NUM_LONG)
        live = write_run(Path(folder) / "live", FIRST_LIVE)
        evaluated = write_evaluations(Path(folder) / "evaluated")
        result = measure(browser, runs, long) | measure_live(browser, live) | measure_scrolling(browser, evaluated)
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
