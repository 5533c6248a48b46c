"""Browsers without a window, real runs, and pages that may neither complain nor connect to anything but their server.

Tests run once in each kind of browser that is found (browsers.py). Without one they are skipped, unless
KINETIX_BROWSER_TESTS=required (continuous integration).
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.browsers import OPTIONS, found_browsers
from tests.helpers import PATIENCE_S, python_path
from tests.studio.serving import Server, serving

REQUIRED = os.environ.get("KINETIX_BROWSER_TESTS") == "required"
FOUND = {browser.kind: browser for browser in found_browsers()}
# `make test` takes one, `make test-long` the other too.
KINDS = [pytest.param(kind, marks=[pytest.mark.long] if number else []) for number, kind in enumerate(FOUND)]
TIMEOUT_MS = 1000 * PATIENCE_S
# moduleOf("base/channel.js"): the page's own copy. Scripts are served below a path with their hash, and a browser that
# imports one from another path gets a second copy, whose channel is never connected.
MODULE_OF = """window.moduleOf = (name) => import(new URL(name, document.querySelector("script[type=module]").src))"""
TRAINED_VARIABLE = "KINETIX_TRAINED_RUNS"


def _missing(reason: str) -> None:
    if REQUIRED:
        pytest.fail(f"{reason}, and KINETIX_BROWSER_TESTS=required")
    pytest.skip(reason)


# Of a module: Playwright keeps an event loop running, and files of other tests have their own.
@pytest.fixture(scope="module", params=KINDS or ["none"])
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        _missing("playwright is not installed")
        return
    if not FOUND:
        _missing("there is no Chromium here; `make browser` fetches one")
        return
    found = FOUND[request.param]
    environment: dict[str, str | float | bool] = {**os.environ, "LANG": "en_US.UTF-8", **dict(found.environment)}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found.program, args=[*OPTIONS], env=environment)
        yield browser
        browser.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., Server]]:
    """serve(path, options): a server that ends after the pages of the test: those that lose theirs complain."""
    with contextlib.ExitStack() as stack:
        yield lambda *arguments, **options: stack.enter_context(serving(*arguments, **options))


@pytest.fixture
def open_page(browser: Any, serve: Any) -> Iterator[Callable[..., Any]]:
    """open_page(server, "#/runs", width=...): a page with access. At the end no page of the test may have complained,
    or connected to another origin than its server."""
    opened, complaints = [], []

    def open_one(server: Server, view: str = "#/runs", **options: Any) -> Any:
        options.setdefault("viewport", {"width": 1600, "height": 900})
        context = browser.new_context(locale="en-US", accept_downloads=True, **options)
        context.set_default_timeout(TIMEOUT_MS)
        context.add_init_script(MODULE_OF)
        page = context.new_page()
        origin = server.address.split("?")[0]
        allowed = (origin, origin.replace("http", "ws"), "blob:", "data:")
        page.on("console", lambda message: message.type in ("error", "warning") and complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: r.url.startswith(allowed) or complaints.append(f"requested {r.url}"))
        page.goto(server.address)
        page.wait_for_selector("nav")
        page.goto(origin + view)
        opened.append(context)
        page.complaints = complaints
        return page

    yield open_one
    for context in opened:
        context.close()
    assert not complaints, complaints


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a real run of seconds: recipe tiny, with evaluations and recordings while it trains.

    KINETIX_TRAINED_RUNS names one that is there already (test_offline.py, which comes back here without a network).
    """
    if TRAINED_VARIABLE in os.environ:
        return Path(os.environ[TRAINED_VARIABLE])
    runs = tmp_path_factory.mktemp("trained")
    command = [
        sys.executable, "-m", "kinetix_dist.cli.main", "train", "--recipe", "tiny", "--run", str(runs / "tiny"),
        "--evaluation.every", "4", "--recording.num_rollouts", "2", "--recording.make_pictures", "False",
    ]  # fmt: skip
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        env=os.environ | {"PYTHONPATH": python_path()},
    )
    assert done.returncode == 0, done.stderr
    return runs


@pytest.fixture(scope="session")
def trained_server(trained: Path) -> Iterator[Server]:
    with serving(trained) as server:
        yield server
