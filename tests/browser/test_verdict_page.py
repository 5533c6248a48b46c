"""The verdict in a real browser: it comes first, parts lead to their evidence, a new run says what is expected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.studio.runs_for_tests import write_config
from tests.studio.serving import Server
from tests.studio.verdict_runs import write_collapsed, write_learning, write_state

OpenPage = Callable[..., Any]
Serve = Callable[..., Server]

# The title of the panel that has the focus, once the page has scrolled to it.
SHOWN = """(title) => {
  const element = document.activeElement;
  if (!element?.dataset.panel?.startsWith(title)) return false;
  const box = element.getBoundingClientRect();
  return box.top >= 0 && box.top < innerHeight;
}"""


def test_the_verdict_comes_first_and_its_parts_lead_to_their_evidence(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_learning(tmp_path / "a")
    page = open_page(serve(tmp_path, "--no-play"), "#/run/a/overview?x=updates")
    heading = page.locator(".verdict h2")
    heading.get_by_text("Yes: it learned. 2 of 2 held-out sets rose").wait_for()
    page.locator(".chart canvas").first.wait_for()
    assert page.locator("main > :first-child").get_attribute("class") == "verdict"
    assert page.locator(".verdict li").count() == 12
    for title, place, panel in (
        ("Speed", "/overview?x=updates&panel=", "Where the time goes"),
        ("random_s", "/evaluation?x=updates&set=", "random_s"),
        ("Learnability", "/curriculum?x=updates&panel=", "Learnability"),
        ("Never touched", "/curriculum?x=updates&panel=", "Solve rate by number of shapes"),
    ):
        page.locator(".verdict").get_by_role("link", name=title, exact=True).click()
        page.wait_for_function(SHOWN, arg=panel)
        assert place in page.url
        page.go_back()
        heading.wait_for()


def test_a_link_opens_the_folded_part_of_the_page(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_learning(tmp_path / "a", refreshes=2)
    server = serve(tmp_path, "--no-play")
    page = open_page(server, "#/run/a/overview?panel=train/episodes")
    page.wait_for_function(SHOWN, arg="train/episodes")


@pytest.mark.parametrize("width", [1600, 390])
def test_a_collapse_is_the_first_line_of_the_page(
    tmp_path: Path, open_page: OpenPage, serve: Serve, width: int
) -> None:
    write_collapsed(tmp_path / "a", refreshes=2)
    page = open_page(
        serve(tmp_path, "--no-play"), "#/run/a/overview", viewport={"width": width, "height": 844}, color_scheme="dark"
    )
    heading = page.locator(".verdict h2")
    heading.get_by_text("No: training collapsed").wait_for()
    assert heading.bounding_box()["y"] < 300
    assert page.locator('[data-statement="stability"] .mark').get_attribute("aria-label") == "needs a look"
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width


def test_a_run_that_has_just_begun_says_when_its_first_buffer_is_expected(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "plr"})
    write_state(run, "running", "compiling", None)
    page = open_page(serve(tmp_path), "#/run/a/overview")
    page.get_by_text("Too early to tell: no update is done. The run is compiling.").wait_for()
    for name in ("Curriculum", "Levels"):
        page.get_by_role("link", name=name, exact=True).click()
        page.locator("main > .missing", has_text="First buffer expected after update 2 (with the first").wait_for()
        assert "older version" not in page.locator("main").inner_text()
