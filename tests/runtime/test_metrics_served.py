"""A real run is scraped while it goes on: what Prometheus sees is what metrics.jsonl has."""

import contextlib
import threading
import time

import psutil
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl
from tests.helpers import free_port
from tests.runtime.conftest import NUM_UPDATES, tiny_options
from tests.telemetry.test_prometheus import scrape

pytestmark = pytest.mark.long


def test_a_run_is_scraped_while_it_goes_on(tmp_path):
    port, seen, is_over = free_port(), [], threading.Event()

    def keep_scraping():
        while not is_over.is_set():
            with contextlib.suppress(OSError):  # not begun yet, or over (URLError, or cut off while it answers)
                seen.append(scrape(port))
            time.sleep(0.05)

    scraper = threading.Thread(target=keep_scraping)
    scraper.start()
    try:
        options = ["--run", str(tmp_path / "run"), *tiny_options(NUM_UPDATES), "--run.metrics_port", str(port)]
        assert main(["train", *options]) == 0
    finally:
        is_over.set()
        scraper.join()
    last = seen[-1]
    row = read_jsonl(tmp_path / "run" / "metrics" / "metrics.jsonl")[-1]
    assert last["kinetix_progress_updates", ""] == row["progress/updates"] == NUM_UPDATES
    for name in ("time/idle", "runtime/compile_seconds", "memory/resident_gib_driver", "memory/host_share"):
        assert last["kinetix_" + name.replace("/", "_"), ""] == row[name] > 0
    assert row["memory/resident_gib_driver"] < 16
    # Since the process started, whatever ran in it before.
    assert row["runtime/compile_seconds"] < time.time() - psutil.Process().create_time()
