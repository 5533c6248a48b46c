"""A level's link opens in another installation: pasted, dropped, typed, by the command, and before there is access."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.test_editor import Bench
from tests.studio.serving import Server, serving

CHASSIS = "chassis (green box)"  # of m/ramp_car
COMPILE_MS = 180_000  # until play starts: the worker compiles behind everything else
PASTE = """(text) => {
  const data = new DataTransfer();
  data.setData("text/plain", text);
  document.body.dispatchEvent(new ClipboardEvent("paste", { clipboardData: data, bubbles: true }));
}"""
DROP = """(text) => {
  const data = new DataTransfer();
  data.setData("text/plain", text);
  document.querySelector("main.editor").dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true }));
}"""


@pytest.fixture(scope="module")
def link(browser: Any) -> str:
    """Of m/ramp_car, from an installation that has ended since."""
    with serving("m/ramp_car", name="edit") as server:
        context = browser.new_context()
        page = context.new_page()
        page.goto(server.address)
        page.get_by_role("button", name=CHASSIS).wait_for()
        page.get_by_role("button", name="link", exact=True).click()
        page.wait_for_function("() => location.hash.includes('level=1.')")
        url = str(page.url)
        context.close()
    assert server.token not in url
    return url


@pytest.fixture
def here(open_page: Callable[..., Any], serve: Callable[..., Server], tmp_path: Path) -> Iterator[Any]:
    """The editor of another installation, with an empty level."""
    page = open_page(serve(tmp_path / "mine.json", name="edit"), "#/edit")
    Bench(page)
    yield page


def is_opened(page: Any) -> None:
    page.get_by_role("button", name=CHASSIS).wait_for()


def is_undone(page: Any) -> None:
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name=CHASSIS).wait_for(state="detached")


def test_a_link_is_pasted_dropped_and_typed(here: Any, link: str) -> None:
    for script, text in ((PASTE, link), (PASTE, link.split("#")[1]), (DROP, link)):
        here.evaluate(script, text)
        is_opened(here)
        is_undone(here)
    here.get_by_role("tab", name="gallery").click()
    here.get_by_label("link or text of a level").fill(link)
    is_opened(here)
    is_undone(here)
    here.evaluate("(hash) => { location.hash = hash; }", link.split("#")[1])  # as one pastes it into the address bar
    is_opened(here)


def test_a_damaged_link_is_one_line_and_changes_nothing(here: Any, link: str) -> None:
    later = link.replace("level=1.", "level=7.")
    for text, said in ((link[:-9], "damaged or cut off"), (link.split("1.")[0], "damaged"), (later, "of version 7")):
        here.evaluate(PASTE, text)
        here.locator(".note", has_text=said).wait_for()
    assert here.locator(".problem").count() == 0 and here.get_by_role("button", name=CHASSIS).count() == 0


def test_the_command_opens_a_link(browser: Any, serve: Callable[..., Server], link: str) -> None:
    server = serve(link, name="edit")
    context = browser.new_context()
    page = context.new_page()
    page.goto(server.address)  # the printed one
    is_opened(page)
    context.close()


def test_levels_play_plays_the_level_of_a_link(
    open_page: Callable[..., Any], serve: Callable[..., Server], link: str
) -> None:
    page = open_page(serve(link, "--policy", "random", name="levels play"), "#/edit")
    page.locator(".play-state", has_text="random actions · step").wait_for(timeout=COMPILE_MS)
    page.get_by_role("button", name="stop").click()
    is_opened(page)


def test_a_level_survives_the_exchange_of_the_token(browser: Any, serve: Callable[..., Server], link: str) -> None:
    """Opened where there is no access yet; the printed address is pasted there, or opened in another tab."""
    server = serve(name="edit")
    origin, part = server.address.split("?")[0], link.split("#")[1]
    for is_pasted in (True, False):
        context = browser.new_context()
        page = context.new_page()
        page.goto(f"{origin}#{part}")
        page.get_by_text("no access").wait_for()
        if is_pasted:
            page.get_by_label("or paste that address here").fill("nothing of use")
            page.get_by_role("button", name="go on").click()
            page.get_by_text("there is no token in this").wait_for()
            page.get_by_label("or paste that address here").fill(server.address)
            page.get_by_role("button", name="go on").click()
        else:
            page = context.new_page()
            page.goto(server.address)
        is_opened(page)
        assert server.token not in page.url
        context.close()
