"""Compare and Runs in a real browser: held-out solve rates at first, sorting, words with a meaning, a phone."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.evaluation.rate_difference import difference_of_rates
from tests.studio.evaluated_runs import write_evaluated_run, write_evaluation
from tests.studio.runs_for_tests import write_config, write_run
from tests.studio.serving import Server

OpenPage = Callable[..., Any]
Serve = Callable[..., Server]
PHONE = {"width": 390, "height": 844}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two seeds of one recipe, of which `good` solves more; one with another set; one that was never evaluated."""
    write_evaluated_run(tmp_path / "good", before=1, after=4)
    write_evaluated_run(tmp_path / "poor", before=1, after=2, seed=1)
    other = write_run(tmp_path / "other", 20)
    write_evaluation(other, "training", 20, {"s/kick": [3]})
    write_config(tmp_path / "young")
    return tmp_path


def leads(page: Any, table: str) -> list[str]:
    """Names of the runs of a table, from its top."""
    return page.locator(f"table.{table} tbody td.lead").all_inner_texts()


def test_held_out_solve_rates_are_compared_at_first(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/compare?runs=good,poor,other,young")
    chart = page.locator('[data-panel="random_s: each run"]')
    chart.locator("canvas").wait_for()
    legend = chart.locator(".legend").inner_text()
    assert "good" in legend and "poor" in legend and "random actions 25.0 % (16 of 64)" in legend
    left_out = chart.get_by_text("left out:").inner_text()
    assert left_out == "left out: other (not evaluated on random_s); young (no evaluation so far (evaluations.jsonl))"
    with page.expect_download() as download:
        chart.get_by_text("CSV").click()
    lines = [line.split(",") for line in Path(download.value.path()).read_text().split()]
    assert lines[0] == ["run", "env_steps", "evaluation/random_s/solve_rate", "low", "high", "episodes"]
    assert [(row[0], row[2], row[5]) for row in lines[1:4]] == [
        ("good", "0.25", "32"),
        ("good", "0.5", "32"),
        ("good", "1", "32"),
    ]
    row = page.locator("table.compared tbody tr", has_text="good").inner_text()
    assert "100.0 %" in row and "32 of 32" in row and "+75.0" in row
    poor = page.locator("table.compared tbody tr", has_text="poor").inner_text()
    _, low, high = difference_of_rates(16, 32, 8, 32)
    assert f"+25.0\n+{100 * low:.1f} to +{100 * high:.1f}" in poor and "may be chance" not in poor


def test_headers_sort_by_mouse_and_keys_and_the_address_holds_it(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/compare?runs=poor,young,good,other")
    page.locator("table.compared").wait_for()
    assert leads(page, "compared") == ["good", "other", "poor", "young"], "the best now first, without a rate last"
    header = page.locator("table.compared th", has_text="now")
    assert header.get_attribute("aria-sort") == "descending"
    header.get_by_role("button").first.click()
    assert header.get_attribute("aria-sort") == "ascending"
    assert leads(page, "compared") == ["poor", "other", "good", "young"]
    run = page.locator("table.compared th", has_text="run").first
    run.get_by_role("button").press("Enter")
    page.wait_for_function("() => location.hash.includes('sort=run')")
    page.reload()
    page.locator("table.compared").wait_for()
    assert leads(page, "compared") == ["good", "other", "poor", "young"]
    with page.expect_download() as download:
        page.locator('[data-panel^="Held-out"]').get_by_text("CSV").click()
    lines = [line.split(",") for line in Path(download.value.path()).read_text().splitlines()]
    assert [line[0] for line in lines] == ["run", "good", "other", "poor", "young"]
    assert lines[1][lines[0].index("now_solved")] == "32" and lines[4][-1] == "no evaluation so far (evaluations.jsonl)"


def test_sets_are_chosen_and_the_address_holds_them(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/compare?runs=good,poor,other")
    page.get_by_label("s/kick", exact=True).uncheck()
    page.locator('[data-panel="s/kick: each run"]').wait_for(state="detached")
    page.wait_for_function("() => location.hash.includes('sets=random_s')")
    assert leads(page, "compared") == ["good", "poor", "other"]
    page.locator("table.compared tr", has_text="other").get_by_text("not evaluated on random_s").wait_for()
    page.get_by_label("metric", exact=True).select_option("train/solve_rate")
    page.locator('[data-panel="train/solve_rate: each run"] canvas').wait_for()


def test_seeds_are_a_group_with_a_band(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/compare?runs=good,poor&x=updates")
    groups = page.locator('[data-panel="random_s: mean of groups"]')
    groups.locator(".legend", has_text="all (2 runs)").wait_for()
    with page.expect_download() as download:
        groups.get_by_text("CSV").click()
    last = Path(download.value.path()).read_text().split()[-1].split(",")
    assert last == ["all", "20", "0.75", "0.5", "1", "2"]


def test_runs_are_cards_on_a_phone(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/runs", viewport=PHONE)
    page.locator("table.runs").wait_for()
    assert page.locator("table.runs thead").is_hidden()
    page.get_by_label("sort runs").select_option("-env_steps")
    assert leads(page, "runs")[-1] == "young"
    page.get_by_label("sort runs").select_option("run")
    assert leads(page, "runs") == ["good", "other", "poor", "young"]
    for view in ("runs", "compare?runs=good,poor,other,young"):
        page.goto(f"{page.url.split('#')[0]}#/{view}")
        page.locator("table.sortable").wait_for()
        page.wait_for_timeout(300)
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        right = page.locator("table.sortable td").evaluate_all(
            "(cells) => Math.max(...cells.map((cell) => cell.getBoundingClientRect().right))"
        )
        assert right <= 390, "cells are seen whole, without scrolling aside"


def test_a_time_is_said_as_people_do_and_its_date_stands_behind_it(
    runs: Path, open_page: OpenPage, serve: Serve
) -> None:
    page = open_page(serve(runs), "#/runs")
    time = page.locator("table.runs tr", has_text="good").locator("time")
    assert re.fullmatch(r"written (just now|\d+ s ago)", time.inner_text())
    assert "UTC" in (time.get_attribute("title") or "")
    found = page.evaluate("""async () => {
      const { ago, count } = await moduleOf("base/language.js");
      return [...[3, 21 * 60, 7200, 3 * 86400].map(ago), ...[1, 2, 0].map((number) => count(number, "level"))];
    }""")
    assert found == ["just now", "21 min ago", "2 h ago", "3 days ago", "1 level", "2 levels", "0 levels"]


def test_the_meaning_of_a_term_opens_and_closes(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/compare?runs=good,poor")
    word, box = page.get_by_role("button", name="evaluation sets"), page.locator("#meaning")
    word.focus()
    box.get_by_text("a named list of levels").wait_for()
    assert word.get_attribute("aria-describedby") == "meaning"
    page.keyboard.press("Escape")
    box.wait_for(state="hidden")
    word.blur()
    word.hover()
    box.wait_for()
    page.mouse.move(800, 700)
    box.wait_for(state="hidden")
    word.click()
    page.mouse.move(800, 700)
    page.wait_for_timeout(300)
    assert box.is_visible(), "a click holds it"
    page.mouse.click(800, 5)
    box.wait_for(state="hidden")


def test_the_meaning_of_a_term_opens_by_a_tap_within_a_phone(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs), "#/run/good/overview", viewport=PHONE, has_touch=True)
    word, box = page.locator("button.term:visible").first, page.locator("#meaning")
    word.tap()
    box.wait_for()
    assert box.inner_text().strip()
    at = box.bounding_box()
    assert at is not None and at["x"] >= 0 and at["x"] + at["width"] <= 390
    word.tap()
    box.wait_for(state="hidden")
