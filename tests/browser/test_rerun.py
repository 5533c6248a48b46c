"""rerun's viewer in the page: its own files, our .rrd, nothing fetched from anywhere else, nothing left running."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

from tests.browser.conftest import TIMEOUT_MS
from tests.studio.serving import Server, serving, wait_for


@pytest.fixture(scope="module")
def server(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    with serving(trained, XDG_CACHE_HOME=str(tmp_path_factory.mktemp("cache"))) as server:
        yield server


@pytest.mark.long
def test_a_rollout_is_shown_by_rerun(server: Server, browser: Any) -> None:
    context = browser.new_context(viewport={"width": 1600, "height": 1500}, locale="en-US")
    context.set_default_timeout(2 * TIMEOUT_MS)
    page = context.new_page()
    answered, requested = [], []
    page.on("response", lambda response: answered.append((response.url, response.status)))
    page.on("request", lambda request: requested.append(request.url))
    page.goto(server.address)
    page.wait_for_selector("nav")
    page.goto(f"http://127.0.0.1:{server.port}/#/run/tiny/replays")
    page.get_by_text("show in rerun").click()
    frame = page.locator("iframe.rerun")
    frame.wait_for()

    def has_green_and_blue() -> bool:
        page.wait_for_timeout(500)
        picture = np.asarray(Image.open(io.BytesIO(frame.screenshot())).convert("RGB")).astype(int)
        red, green, blue = np.moveaxis(picture, -1, 0)
        is_green = (green > red + 40) & (green > blue + 40)
        is_blue = (blue > red + 60) & (blue > green + 40)
        return is_green.sum() > 50 and is_blue.sum() > 50

    wait_for(has_green_and_blue)
    own = f"http://127.0.0.1:{server.port}/"
    assert all(url.startswith((own, "blob:", "data:")) for url in requested), "no other host is requested"
    rrd = next(url for url, _ in answered if "/rrd/" in url)
    context.close()
    # The .rrd needs its signature, and no cookie.
    path = "/" + rrd.removeprefix(own)
    assert server.request(path, headers={"Cookie": ""})[0] == 200
    _, _, signature, name = path.split("/")
    assert server.request(f"/rrd/{signature}0/{name}", headers={"Cookie": ""})[0] == 403
    assert server.request(f"/rrd/{signature}/other.rrd")[0] == 403
    assert server.request("/rerun/index.html", headers={"Cookie": ""})[0] == 401
    assert server.request("/rerun/..%2Fx")[0] == 404
    names = [" ".join(child.cmdline()) for child in psutil.Process(server.process.pid).children(recursive=True)]
    assert not [name for name in names if "rerun" in name], "the process that handed out its files is gone"
