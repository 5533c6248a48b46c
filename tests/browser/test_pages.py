"""The pages in a real browser, over a real run and over files that are written while they are looked at."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.telemetry import curriculum_log
from kinetix_dist.telemetry.json_lines import append_line
from tests.helpers import PATIENCE_S
from tests.studio.runs_for_tests import solve_rate, write_rows, write_run
from tests.studio.serving import Server, end, environment, wait_for

OpenPage = Callable[..., Any]
Serve = Callable[..., Server]

# Whether a canvas has more than its background: the number of different colours in it. Read from a copy: Chromium
# warns of a canvas that is read again and again.
COLOURS = """(canvas) => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const seen = new Set();
  for (let k = 0; k < data.length; k += 4) seen.add((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
  return seen.size;
}"""

# Colours of a level that was never solved, over many evaluations: cells too narrow for numbers, and gaps.
STRIP = 2

# How many pixels of a canvas have exactly a colour.
PIXELS = """(canvas, [red, green, blue]) => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4) count += data[k] === red && data[k + 1] === green && data[k + 2] === blue;
  return count;
}"""
# What Chromium says where LANG is C.
NO_TAG = 'Object.defineProperty(Navigator.prototype, "language", { get: () => "en-US@posix", configurable: true });'

# A click, a link or a script as early as can be: when the page has just been drawn for the first time.
AT_ONCE = """new MutationObserver((_, observer) => {
  if (!document.querySelector("nav")) return;
  observer.disconnect();
  location.hash = "#/run/a/overview";
}).observe(document, { childList: true, subtree: true });"""


def panel(page: Any, title: str) -> Any:
    return page.locator(f'[data-panel^="{title}"]')


def box_of(page: Any, locator: Any) -> dict[str, float]:
    """Box of an element, once it exists: one that is just made again has none."""
    deadline = time.monotonic() + PATIENCE_S
    while (box := locator.bounding_box()) is None:
        assert time.monotonic() < deadline, f"{locator} is nowhere"
        page.wait_for_timeout(100)
    return box


def wait_for_drawn(page: Any, title: str, selector: str = "canvas", least: int = 5) -> None:
    """Waits until the first canvas of a panel has at least that many colours."""
    canvas = panel(page, title).locator(selector).first
    canvas.wait_for()
    deadline = time.monotonic() + PATIENCE_S
    while canvas.evaluate(COLOURS) < least:
        assert time.monotonic() < deadline, f"nothing is drawn in {title!r}"
        page.wait_for_timeout(100)


def test_from_the_list_to_every_page_of_a_real_run(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server)
    page.get_by_role("link", name="tiny", exact=True).click()
    for title in ("Training episodes", "Evaluation: solve rates", "Level buffer", "Losses", "Where the time goes"):
        wait_for_drawn(page, title)
    assert "finished" in page.locator(".facts").inner_text()
    assert "buffer_adopted" in panel(page, "Events").inner_text()

    page.get_by_role("link", name="Curriculum", exact=True).click()
    for title in (
        "Solve rate in training",
        "Learnability",
        "Solve rates: candidates",
        "Solve rate by number of joints",
    ):
        wait_for_drawn(page, title)
    assert "by construction" in panel(page, "What persists").inner_text()

    page.get_by_role("link", name="Evaluation", exact=True).click()
    wait_for_drawn(page, "random_s", least=STRIP)

    page.get_by_role("link", name="Replays", exact=True).click()
    wait_for_drawn(page, "player")
    assert "kinetix-dist replay" in panel(page, "player").inner_text()

    page.get_by_role("link", name="Compare", exact=True).click()
    wait_for_drawn(page, "random_s: each run")


def test_pages_fill_while_a_run_trains(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    """Pages fill from before the first update on, without reloading; training goes on afterwards."""
    run = tmp_path / "tiny"
    command = [
        sys.executable, "-m", "kinetix_dist.cli.main", "train", "--recipe", "tiny", "--run", str(run),
        "--run.total_env_steps", str(10**9), "--evaluation.every", "2",
        "--curriculum_log.max_snapshots", "10000",  # what is left out while it is looked at has a test of its own
    ]  # fmt: skip
    with contextlib.ExitStack() as stack:
        training = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment())
        stack.callback(training.wait)
        stack.callback(training.terminate)
        wait_for((run / "config.json").is_file)
        page = open_page(serve(tmp_path), "#/run/tiny/overview")
        panel(page, "Training episodes").locator("canvas").wait_for(timeout=240_000)  # it compiles first
        for title in ("Training episodes", "Evaluation: solve rates", "Level buffer", "Losses", "Where the time goes"):
            wait_for_drawn(page, title)
        assert "running" in page.locator(".facts").inner_text()
        assert panel(page, "Processes").locator("tbody tr").count() == 1
        page.get_by_role("link", name="Curriculum", exact=True).click()
        wait_for_drawn(page, "Learnability")
        page.get_by_role("link", name="Levels", exact=True).click()
        page.locator(".thumbnail canvas").first.wait_for()
        page.get_by_role("link", name="Evaluation", exact=True).click()
        wait_for_drawn(page, "random_s", least=STRIP)
        assert training.poll() is None


def test_levels_are_pictures_and_one_of_them_opens(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, "#/run/tiny/levels")
    page.locator(".thumbnail canvas").first.wait_for()
    assert page.locator(".thumbnail canvas").count() == 8
    page.locator(".thumbnail").nth(2).click()
    wait_for_drawn(page, "level")
    with page.expect_download() as download:
        panel(page, "level").get_by_text("download as a level file").click()
    document = json.loads(Path(download.value.path()).read_text())
    assert document["shapes"], "a level file of our format"


def test_what_links_no_icon_has_one_too(trained_server: Server, open_page: OpenPage) -> None:
    """Browsers with a window then request /favicon.ico, and complain where there is none (`open_page` collects it)."""
    page = open_page(trained_server)
    page.goto(f"http://127.0.0.1:{trained_server.port}/api/runs")
    page.wait_for_timeout(1000)


@pytest.mark.long
def test_a_level_of_the_buffer_is_played_in_place(trained_server: Server, open_page: OpenPage) -> None:
    """Plays a level by the checkpoint of its run, by keys and 64 times; and shows its history."""
    page = open_page(trained_server, "#/run/tiny/levels")
    page.locator(".thumbnail").nth(2).click()
    drawer = panel(page, "level")
    drawer.get_by_text("▶ play").click()
    mind = drawer.locator(".mind")
    mind.wait_for()
    drawer.locator(".play-state:not([data-outcome=''])").wait_for()  # its last values stay
    assert "value" in mind.inner_text() and "NaN" not in mind.inner_text()
    shares = [float(text.split()[-2]) for text in mind.locator(".chance").all_inner_texts()]
    assert sum(shares) == pytest.approx(100 * mind.locator(".heads > div").count(), abs=1)
    drawer.get_by_role("button", name="stop").click()
    picture = drawer.locator("canvas.world")
    drawer.get_by_label("who plays").select_option("keys")
    picture.press(" ")
    drawer.locator(".pads").wait_for()
    page.wait_for_function("() => Number(document.querySelector('.stage canvas').dataset.step) > 2")
    picture.press("Escape")
    page.wait_for_function("() => document.querySelector('.stage canvas').dataset.step === undefined")
    drawer.get_by_role("button", name="play 64 times").click()
    drawer.locator("[data-panel=attempts]", has_text="of 64), 95 %").wait_for()
    history = panel(page, "history").locator(".tight").inner_text()
    assert history.startswith("scored, refresh") and " of " in history


def test_who_runs_where(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, "#/run/tiny/overview")
    row = panel(page, "Processes").locator("tbody tr").first
    row.wait_for()
    assert row.inner_text().split()[0] == "driver"


def test_a_p_is_never_shown_without_its_count(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, "#/run/tiny/levels")
    page.locator(".thumbnail").first.wait_for()
    for text in page.locator(".thumbnail").all_inner_texts():
        assert " of " in text, text


def test_a_rollout_is_played_stepped_and_scrubbed(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, "#/run/tiny/replays")
    canvas = page.locator(".player canvas")
    canvas.wait_for()
    player = page.locator(".player")
    player.focus()
    player.press("Home")
    assert canvas.get_attribute("data-step") == "0"
    first = canvas.evaluate("(canvas) => canvas.toDataURL()")
    player.press("ArrowRight")
    assert canvas.get_attribute("data-step") == "1"
    player.press("End")
    page.wait_for_function("() => document.querySelector('.player canvas').dataset.step !== '1'")
    assert canvas.evaluate("(canvas) => canvas.toDataURL()") != first
    assert page.locator(".player b").count() == 1, "the outcome stands at the end"


def test_a_row_on_disk_is_shown_and_a_resumed_run_goes_back(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    run = write_run(tmp_path / "a", 5)
    server = serve(tmp_path)
    page = open_page(server, "#/run/a/overview?x=updates")
    wait_for_drawn(page, "Training episodes")
    facts = page.locator(".facts")
    facts.get_by_text("640 of").wait_for()  # 5 updates of 128 steps
    write_rows(run, 6, 7)
    facts.get_by_text("896 of").wait_for()
    write_rows(run, 3, 3, resume_at=2, **{"learner/approx_kl": 0.5})
    facts.get_by_text("384 of").wait_for()
    append_line(run / "events.jsonl", {"time": "2026-01-31T13:00:00Z", "event": "resumed", "update": 2})
    panel(page, "Events").get_by_text("resumed").wait_for()


def test_a_damaged_line_is_said_and_a_server_that_ends_too(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    run = write_run(tmp_path / "a", 5)
    with (run / "metrics" / "metrics.jsonl").open("ab") as file:
        file.write(b'{"update": 6, "train/solve_rate": NaN}\n')
    write_run(tmp_path / "b", 5)
    server = serve(tmp_path)
    page = open_page(server)
    row = page.locator("table.runs tr", has_text="the last line of metrics.jsonl is damaged (train/solve_rate is nan")
    row.wait_for()
    assert page.locator("table.runs tbody tr").count() == 2
    row.get_by_role("link", name="a", exact=True).click()
    page.get_by_text("1 line is damaged in metrics/metrics.jsonl and left out").wait_for()
    end(server.process)
    page.get_by_text("disconnected").wait_for()
    page.context.close()  # before it tries again
    page.complaints.clear()  # the browser says that it cannot connect


def test_an_older_run_says_what_it_lacks(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_run(tmp_path / "a", 5)
    server = serve(tmp_path)
    page = open_page(server, "#/run/a/curriculum")
    page.get_by_text("No snapshots of its curriculum so far").wait_for()
    page.get_by_text("No counts of its training episodes so far").wait_for()
    for name, text in (
        ("levels", "No snapshots of its curriculum so far"),
        ("evaluation", "No evaluation so far"),
        ("replays", "No rollouts so far"),
        ("overview", "This run has no processes.jsonl"),
    ):
        page.goto(f"http://127.0.0.1:{server.port}/#/run/a/{name}")
        page.get_by_text(text).wait_for()


def test_without_play_pages_say_so(tmp_path: Path, trained: Path, open_page: OpenPage, serve: Serve) -> None:
    server = serve(trained, "--no-play")
    page = open_page(server, "#/run/tiny/levels")
    page.get_by_text("the server was started with --no-play").wait_for()
    page.locator(".thumbnail").nth(7).wait_for()  # counts are there without pictures
    page.wait_for_timeout(500)
    page.complaints.clear()  # the browser counts an answer of 503 as an error


def test_the_view_is_in_the_address_and_its_numbers_come_out(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_run(tmp_path / "a", 20)
    server = serve(tmp_path)
    page = open_page(server, "#/run/a/overview")
    wait_for_drawn(page, "Training episodes")
    page.get_by_label("axis").select_option("updates")
    page.wait_for_function("() => location.hash.includes('x=updates')")
    page.wait_for_load_state("networkidle")  # charts are made again from what comes
    wait_for_drawn(page, "Training episodes")
    box = box_of(page, panel(page, "Training episodes").locator(".u-over"))
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 50, steps=5)
    page.mouse.up()
    page.wait_for_function("() => location.hash.includes('from=')")
    page.goto(f"http://127.0.0.1:{server.port}/#/run/a/overview?x=updates&from=5.5&to=8.5")
    page.reload()
    wait_for_drawn(page, "Training episodes")
    with page.expect_download() as download:
        panel(page, "Training episodes").get_by_text("CSV").click()
    lines = Path(download.value.path()).read_text().split()
    assert lines[0] == "updates,train/solve_rate"
    assert lines[1:] == [f"{u},{solve_rate(u):g}" for u in (5, 6, 7, 8, 9)]
    with page.expect_download() as download:
        panel(page, "Training episodes").get_by_text("PNG").click()
    assert Path(download.value.path()).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "view", ["runs", *(f"run/tiny/{p}" for p in ("overview", "curriculum", "levels?level=2", "replays"))]
)
def test_nothing_is_cut_off_on_a_phone(trained_server: Server, open_page: OpenPage, view: str) -> None:
    page = open_page(trained_server, f"#/{view}", viewport={"width": 390, "height": 844})
    page.locator("main").wait_for()
    page.wait_for_timeout(1000)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("is_removed", [False, True], ids=["thinned", "removed"])
def test_a_snapshot_that_goes_between_list_and_request_is_dropped(
    is_removed: bool, trained: Path, tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    shutil.copytree(trained / "tiny", tmp_path / "runs" / "tiny")
    folder = tmp_path / "runs" / "tiny" / curriculum_log.DIRECTORY
    kind, number, newest = curriculum_log.list_snapshots(folder)[-1]

    def answer(route: Any) -> None:
        listed = route.fetch()
        found = [entry["number"] for entry in listed.json()["snapshots"] if entry["has_levels"]]
        assert number in found and len(found) > 1
        if is_removed:
            newest.unlink()
        else:
            read = curriculum_log.read_snapshot(newest, with_levels=False)
            arrays = {name: array for name, array in read.arrays.items() if name not in ("format", "kind")}
            curriculum_log.write_snapshot(folder, kind, number, arrays)
        route.fulfill(response=listed)

    page = open_page(serve(tmp_path / "runs"))
    page.route("**/api/runs/tiny/curriculum", answer, times=1)
    page.get_by_role("link", name="tiny", exact=True).click()
    page.get_by_role("link", name="Levels", exact=True).click()
    page.locator(".thumbnail canvas").first.wait_for()
    snapshots = page.get_by_label("snapshot").locator("option").all_inner_texts()
    assert snapshots and f"{kind} {number}" not in snapshots
    assert page.locator(".notes").count() == 0
    if is_removed:  # the browser itself says so of every answer of 404
        assert all("404" in line for line in page.complaints)
        page.complaints.clear()


def test_a_value_alone_is_a_point(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_run(tmp_path / "a", 1)
    page = open_page(serve(tmp_path), "#/run/a/overview", color_scheme="light")
    wait_for_drawn(page, "Training episodes")
    canvas = panel(page, "Training episodes").locator("canvas").first
    assert canvas.evaluate(PIXELS, [0x00, 0x72, 0xB2]) > 5, "--line-0 of style.css"


def test_an_address_that_changes_as_soon_as_the_page_is_drawn_is_shown(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_run(tmp_path / "a", 3)
    page = open_page(serve(tmp_path))
    page.add_init_script(AT_ONCE)
    page.reload()
    wait_for_drawn(page, "Training episodes")


def test_two_runs_are_compared(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_run(tmp_path / "a", 20)
    write_rows(write_run(tmp_path / "b", 10, run={"seed": 7}), 11, 20, **{"train/solve_rate": 0.9})
    page = open_page(serve(tmp_path))
    for name in "ab":
        page.get_by_label(f"compare {name}").check()
    page.get_by_role("link", name="compare 2").click()
    page.get_by_label("axis").select_option("updates")
    wait_for_drawn(page, "train/solve_rate: each run")
    with page.expect_download() as download:
        panel(page, "train/solve_rate: each run").get_by_text("CSV").click()
    _, *rows = [line.split(",") for line in Path(download.value.path()).read_text().split()]
    expected = {"a": [solve_rate(u) for u in range(1, 21)], "b": [*map(solve_rate, range(1, 11)), *[0.9] * 10]}
    for name, values in expected.items():
        shown = [(float(row[1]), float(row[2])) for row in rows if row[0] == name]
        assert shown == [(update, pytest.approx(value)) for update, value in enumerate(values, 1)]
    differences = panel(page, "Where the configurations differ")
    assert differences.locator("tbody tr").all_inner_texts() == ["run.seed\t0\t7"]
    differences.get_by_role("button", name="run.seed").click()
    legend = panel(page, "train/solve_rate: mean of groups").locator(".legend")
    for text in ("seed = 0 (1 run)", "seed = 7 (1 run)"):
        legend.get_by_text(text).wait_for()


def test_a_browser_whose_language_is_no_tag_shows_charts(tmp_path: Path, browser: Any, serve: Serve) -> None:
    write_run(tmp_path / "a", 20)
    server = serve(tmp_path)
    context = browser.new_context()
    context.add_init_script(NO_TAG)
    page = context.new_page()
    page.goto(server.address)
    page.locator("nav").wait_for()
    page.goto(f"http://127.0.0.1:{server.port}/#/run/a/overview")
    wait_for_drawn(page, "Training episodes")
    assert page.evaluate("() => navigator.language") == "en-US"
    context.close()


def test_dark_and_light_differ_and_stay(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, color_scheme="light")
    background = "() => getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(background)
    page.get_by_label("dark or light").click()
    dark = page.evaluate(background)
    page.reload()
    page.locator("nav").wait_for()
    assert page.evaluate(background) == dark != light
