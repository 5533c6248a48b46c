"""The pages behind a reverse proxy (a process of its own) that serves them below a path prefix."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.test_pages import panel, wait_for_drawn
from tests.helpers import REPOSITORY, next_line
from tests.studio.serving import Server, environment, serving

PREFIX = "/kinetix/pages"


@dataclasses.dataclass(frozen=True)
class Proxied:
    """Server behind a proxy, by the proxy's address."""

    port: int
    address: str


@pytest.fixture(params=["--keep-host", ""], ids=["host kept", "host of the server"])
def proxied(trained: Path, request: pytest.FixtureRequest) -> Iterator[Proxied]:
    with serving(trained, "--allow-host", "127.0.0.1") as server:
        yield from _behind_proxy(server, *filter(None, [request.param]))


def _behind_proxy(server: Server, *options: str) -> Iterator[Proxied]:
    command = [sys.executable, "-m", "tests.browser.proxy", PREFIX, str(server.port), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment(), cwd=REPOSITORY) as proxy:
        try:
            port = int(next_line(proxy))
            yield Proxied(port, f"http://127.0.0.1:{port}{PREFIX}/?token={server.token}")
        finally:
            proxy.kill()


@pytest.mark.long
def test_curves_levels_and_play_below_a_path_prefix(proxied: Proxied, open_page: Callable[..., Any]) -> None:
    """`open_page` complains of any request that is not below the prefix."""
    page = open_page(proxied, "#/run/tiny/overview")
    wait_for_drawn(page, "Training episodes")
    page.get_by_role("link", name="Levels", exact=True).click()
    page.locator(".thumbnail").first.click()
    panel(page, "level").get_by_text("▶ play").click()
    panel(page, "level").locator(".mind").wait_for()
    page.get_by_role("link", name="Replays", exact=True).click()
    wait_for_drawn(page, "player")
