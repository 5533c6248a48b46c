"""The evaluation page in a real browser: sorting, filtering, rows that come with scrolling, a level, training on it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.cli import finetune
from kinetix_dist.level.level_data import designed_sets
from tests.browser.test_pages import panel, wait_for_drawn
from tests.studio.runs_for_tests import write_config, write_evaluations
from tests.studio.serving import Server

OpenPage = Callable[..., Any]
Serve = Callable[..., Server]
SET = "all_designed_s"  # read from files, so that its levels are there at once
LARGE = "random_s"
ATTEMPTS = 8
NUM_LEVELS = 256


def names_of_set() -> list[str]:
    return [Path(file).stem for file in designed_sets()[SET]["levels"]]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A run in which hop_home was lost at last, kick slowly, and swing_up never solved; levels with joints fail."""
    run = write_config(tmp_path / "run", evaluation={"sets": [SET, LARGE]})
    names = names_of_set()
    now = dict.fromkeys(names, 8) | {"swing_up": 0, "kick": 2, "hop_home": 3}
    last = now | {"hop_home": 8, "kick": 3}
    first = now | {"hop_home": 4, "kick": 8, "swing_up": 0}
    counts = [[1] * len(names), *([each[name] for name in names] for each in (first, last, now))]
    large = [[k * level % 9 for level in range(NUM_LEVELS)] for k in range(4)]
    random_names = [f"random_s_{k}" for k in range(NUM_LEVELS)]
    write_evaluations(run, {SET: (names, ATTEMPTS, counts), LARGE: (random_names, ATTEMPTS, large)})
    return tmp_path


def first_names(page: Any, count: int = 3) -> list[str]:
    rows = page.locator(".matrix-row")
    rows.first.wait_for()
    return [rows.nth(k).locator("button").inner_text() for k in range(count)]


def test_levels_are_sorted_by_what_fails_and_by_what_was_lost(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs, "--no-play"), f"#/run/run/evaluation?set={SET}")
    assert first_names(page) == ["swing_up", "kick", "hop_home"]
    row = page.locator(".matrix-row").nth(2)
    # Newest and first counts, and both changes, stand in the row.
    assert row.inner_text().split("\n") == ["hop_home", "38 % 3 of 8 14 to 69", "50 % 4 of 8 22 to 78",
                                            "−63 −86 to −17", "−13 −50 to +30"]  # fmt: skip
    for sort, expected in (("lost", "hop_home"), ("lost_first", "kick"), ("lost_best", "kick"), ("name", "aim_rocket")):
        page.get_by_label("order").select_option(sort)
        page.wait_for_function(
            "(name) => document.querySelector('.matrix-row button').textContent === name", arg=expected
        )
        assert f"sort={sort}" in page.url
    page.get_by_label("filter", exact=False).fill("hop now<0.5")
    page.keyboard.press("Enter")
    page.get_by_text("1 of 10 levels").wait_for()
    assert first_names(page, 1) == ["hop_home"]
    page.get_by_label("filter", exact=False).fill("joints>=1")
    page.keyboard.press("Enter")
    page.get_by_text("features of these levels are not known").wait_for()
    page.get_by_text("the server was started with --no-play").first.wait_for()
    page.complaints.clear()  # the browser counts an answer of 503 as an error


def test_only_rows_in_sight_exist_and_keys_reach_all(runs: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(runs, "--no-play"), f"#/run/run/evaluation?set={LARGE}&sort=name")
    assert first_names(page, 1) == ["random_s_0"]
    assert page.locator(".matrix-row").count() < 80 < NUM_LEVELS
    matrix = page.locator(".matrix")
    matrix.focus()
    page.keyboard.press("End")
    page.get_by_role("row", name="random_s_255").wait_for()
    assert page.locator(".matrix-row").count() < 80
    head, last = (
        page.locator(".matrix-head").bounding_box(),
        page.get_by_role("row", name="random_s_255").bounding_box(),
    )
    box = matrix.bounding_box()
    assert abs(head["y"] - box["y"]) < 3 and last["y"] + last["height"] <= box["y"] + box["height"]  # both in sight
    assert page.locator(".matrix-head").inner_text().split("\n")[1:5] == [
        "now",
        "before training",
        "since previous",
        "since first",
    ]
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Space")
    page.get_by_text("1 chosen").wait_for()
    assert page.get_by_role("row", name="random_s_254").get_attribute("aria-selected") == "true"
    page.keyboard.press("Enter")
    panel(page, "level").get_by_text("random_s_254").wait_for()
    page.keyboard.press("Escape")
    panel(page, "level").wait_for(state="detached")
    page.goto(page.url.split("#")[0] + f"#/run/run/evaluation?set=all+sets&level={LARGE}/random_s_7")
    panel(page, "level").get_by_text("random_s_7", exact=True).wait_for()
    assert page.get_by_text("266 of 266 levels").is_visible()
    page.wait_for_load_state("networkidle")
    page.complaints.clear()  # answers of 503


def test_a_level_opens_with_its_history_and_plays(trained: Path, open_page: OpenPage, serve: Serve) -> None:
    server = serve(trained)
    page = open_page(server, "#/run/tiny/evaluation?set=random_s&sort=name&level=random_s_3")
    wait_for_drawn(page, "level", ".stage canvas")
    wait_for_drawn(page, "history")
    evaluated = [json.loads(line) for line in (trained / "tiny" / "evaluations.jsonl").read_text().splitlines()]
    assert panel(page, "history").locator(".tight tbody tr").count() == len(evaluated)
    text = panel(page, "level").inner_text()
    assert "95 %" in text and "green to blue" in text
    panel(page, "level").get_by_role("button", name="play", exact=False).first.click()
    page.locator(".play-state").wait_for()
    wait_for_drawn(page, "What fails in random_s")
    panel(page, "level").get_by_role("link", name="edit").click()
    page.wait_for_function("() => document.querySelector('[data-panel=attempts]') !== null")
    page.wait_for_function(
        "() => [...document.querySelectorAll('input')].some((field) => field.value === 'random_s_3')"
    )


def test_chosen_levels_become_a_command_and_files(trained: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(trained), "#/run/tiny/evaluation?set=random_s")
    page.get_by_label("number of levels").fill("3")
    page.get_by_role("button", name="choose the first").click()
    command = page.locator(".command pre")
    command.wait_for()
    unpack, train = command.inner_text().splitlines()
    assert "--from" in train
    words = shlex.split(train)
    args = finetune.parse(words[2:])
    assert args.train is not None and args.train.config.curriculum.levels == "tiny_random_s_3_levels"
    with page.expect_download() as caught:
        panel(page, "train on these").get_by_role("link").click()
    assert caught.value.suggested_filename == shlex.split(unpack)[4] == "tiny_random_s_3_levels.zip"
    page.get_by_role("button", name="choose all").click()
    page.wait_for_function("() => document.querySelector('.command pre').textContent.includes('--levels random_s ')")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone(runs: Path, open_page: OpenPage, serve: Serve, scheme: str) -> None:
    page = open_page(
        serve(runs, "--no-play"),
        f"#/run/run/evaluation?set={LARGE}&level=random_s_9",
        viewport={"width": 390, "height": 844},
        color_scheme=scheme,
    )
    page.locator(".matrix-row").first.wait_for()
    page.get_by_role("button", name="choose the first").click()
    page.locator(".command pre").wait_for()
    page.wait_for_load_state("networkidle")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    matrix = page.locator(".matrix")
    matrix.evaluate("(element) => { element.scrollLeft = 400; }")
    name, box = page.locator(".matrix-row .name").first.bounding_box(), matrix.bounding_box()
    assert abs(name["x"] - box["x"]) < 3  # names stay
    page.complaints.clear()  # answers of 503
