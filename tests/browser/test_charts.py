"""Charts of the overview and the curriculum in a real browser: what they tell, and that nothing moves meanwhile."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path

import pytest

from kinetix_dist.telemetry.json_lines import append_line
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from tests.browser.test_pages import OpenPage, Serve, box_of, panel, wait_for_drawn
from tests.studio.runs_for_tests import metrics_of, write_config, write_run
from tests.studio.serving import Server

BLUE = [0x00, 0x72, 0xB2]  # --line-0 of style.css

# First and last row of a canvas with a pixel of exactly a colour, and [null, null] where there is none.
ROWS_OF_COLOUR = """(canvas, [red, green, blue]) => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const rows = [];
  for (let k = 0; k < data.length; k += 4)
    if (data[k] === red && data[k + 1] === green && data[k + 2] === blue) rows.push(Math.floor(k / 4 / canvas.width));
  return [rows[0] ?? null, rows.at(-1) ?? null];
}"""
# The same of every pixel that is rather blue.
ROWS_OF_BLUE = """(canvas) => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const rows = [];
  for (let k = 0; k < data.length; k += 4)
    if (data[k + 3] > 20 && data[k + 2] > data[k] + 25) rows.push(Math.floor(k / 4 / canvas.width));
  return [rows[0] ?? null, rows.at(-1) ?? null];
}"""
BOXES = """() => [...document.querySelectorAll("[data-panel], .legend, .chart, canvas")].map((element) => {
  const box = element.getBoundingClientRect();
  return [box.x, box.y + scrollY, box.width, box.height];
})"""
ALL_OF_IT = """() => document.querySelectorAll("[aria-expanded=false]").forEach(
  (button) => button.textContent === "more" && button.click())"""
CUT = """() => [...document.querySelectorAll(".explanation, .panel h3")].filter((element) =>
  element.scrollWidth > element.clientWidth + 1 || element.scrollHeight > element.clientHeight + 1
).map((element) => element.textContent)"""
WIDE = """() => [...document.querySelectorAll("canvas")].filter((canvas) =>
  canvas.getBoundingClientRect().width > canvas.parentElement.clientWidth + 1
).map((canvas) => canvas.getAttribute("aria-label"))"""


def write_metrics(run: Path, rows: Iterable[dict[str, float]]) -> Path:
    """A run of recipe tiny with these metrics in its rows."""
    write_config(run)
    sink = JsonlSink(run / "metrics" / "metrics.jsonl", resume_at=None)
    for update, row in enumerate(rows, 1):
        sink.write(update, metrics_of(update, **row))
    sink.close()
    return run


def write_event(run: Path, event: str, update: int) -> None:
    append_line(run / "events.jsonl", {"time": "2026-01-31T12:00:00Z", "event": event, "update": update})


def write_evaluation(run: Path, update: int, solved: list[int]) -> None:
    counts = {"solved": solved, "attempts": 10, "names": [f"s/{k}" for k in range(len(solved))]}
    line = {
        "format": 1,
        "phase": "training",
        "update": update,
        "env_steps": 128 * update,
        "reported_at": update,
        "sets": {"random_s": counts},
    }
    append_line(run / "evaluations.jsonl", line)


@pytest.fixture
def long_run(tmp_path: Path) -> Path:
    """2,000 rows, more than a chart has points: bands; with events of several kinds."""
    run = write_metrics(
        tmp_path / "a", ({"learner/grad_norm": update % 7, "physics/speed_limited": 4e4} for update in range(2000))
    )
    for update in range(1, 31):
        write_event(run, "buffer_adopted", update)
    write_event(run, "process_lost", 1500)
    return run


@pytest.mark.parametrize("width", [1600, 390])
def test_hovering_and_keys_move_nothing(long_run: Path, open_page: OpenPage, serve: Serve, width: int) -> None:
    page = open_page(serve(long_run.parent), "#/run/a/overview?x=updates", viewport={"width": width, "height": 900})
    if width == 390:  # sections are folded on a phone
        page.locator("[data-section=Learning] > summary").click()
    wait_for_drawn(page, "Training episodes")
    page.wait_for_timeout(500)  # explanations are measured
    before = page.evaluate(BOXES)
    plot = panel(page, "Training episodes").locator(".u-over")
    plot.scroll_into_view_if_needed()
    box = box_of(page, plot)
    for share in (0.02, 0.3, 0.753, 0.99):  # at merged events, at none, at a lost process, at the end
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 40)
        assert "at " in panel(page, "Training episodes").locator(".at").inner_text()
        assert page.evaluate(BOXES) == before, f"hovering at {share}"
    page.mouse.move(2, 2)
    chart = panel(page, "Training episodes").locator(".chart")
    chart.focus()
    chart.press("End")
    assert page.evaluate(BOXES) == before
    chart.blur()
    assert page.evaluate(BOXES) == before


def test_a_legend_has_the_last_value_at_rest_and_that_of_the_pointer(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_metrics(tmp_path / "a", ({"learner/entropy": 10.0 * update} for update in range(1, 10)))
    page = open_page(serve(tmp_path), "#/run/a/overview?x=updates")
    wait_for_drawn(page, "Entropy")
    value, at = (panel(page, "Entropy").locator(f".legend {part}") for part in (".value", ".at"))
    assert (value.inner_text(), at.inner_text()) == ("90", "last, at 9 updates")
    box = box_of(page, panel(page, "Entropy").locator(".u-over"))
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)  # update 5 of 1 to 9
    assert (value.inner_text(), at.inner_text()) == ("50", "at 5 updates")
    page.mouse.move(2, 2)
    assert value.inner_text() == "90"
    chart = panel(page, "Entropy").locator(".chart")
    chart.focus()
    for key, expected in (("Home", "10"), ("ArrowRight", "20"), ("End", "90"), ("ArrowLeft", "80")):
        chart.press(key)
        assert value.inner_text() == expected, key
    chart.press("Escape")
    assert value.inner_text() == "90"


def test_a_constant_is_flat_and_one_value_is_a_point(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    noise = itertools.cycle([0.0, 3e-11, -2e-11])  # 3e-4 in float32 and back
    rows = [
        {"learner/learning_rate": 3e-4 + next(noise), "learner/weight_norm": 1e9, "learner/grad_norm": 0.0}
        for _ in range(40)
    ]
    rows[20]["learner/dormant_share"] = 0.25
    write_metrics(tmp_path / "a", rows)
    page = open_page(serve(tmp_path), "#/run/a/overview?x=updates&find=learner/", color_scheme="light")
    for title in ("learner/learning_rate", "Norm of the weights", "Gradient norm", "Dormant units"):
        panel(page, title).scroll_into_view_if_needed()
        wait_for_drawn(page, title)
        canvas = panel(page, title).locator("canvas").first
        first, last = canvas.evaluate(ROWS_OF_COLOUR, BLUE)
        most = 8 if title == "Dormant units" else 3  # a point has 6 pixels
        assert first is not None and last - first < most, f"{title}: from row {first} to {last}"


def test_labels_of_an_axis_differ(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server)
    labels = """async (ticks) => {
      const { tickLabels } = await moduleOf("charts/axes.js");
      return tickLabels(ticks);
    }"""
    for ticks, expected in (
        ([0, 1e-4, 2e-4], ["0", "1.0e-4", "2.0e-4"]),
        ([0.0003, 0.00030001], ["3.0000e-4", "3.0001e-4"]),
        ([0, 5e8, 1e9], ["0", "500 M", "1 G"]),
        ([1_000_100, 1_000_200, 1_000_300], ["1.0001 M", "1.0002 M", "1.0003 M"]),
        ([1, None, 10], ["1", "", "10"]),
    ):
        assert page.evaluate(labels, ticks) == expected
    limits = """async ([low, high]) => {
      const { rangeOf } = await moduleOf("charts/axes.js");
      return rangeOf(low, high);
    }"""
    for value, expected in ((0, [0, 1]), (3e-4, [0, 3.6e-4]), (1e9, [0, 1.2e9]), (-2, [-2.4, 0])):
        assert page.evaluate(limits, [value, value]) == pytest.approx(expected)


def test_what_is_smoothed_stays_faint_below(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_metrics(tmp_path / "a", ({"learner/grad_norm": float(update % 2)} for update in range(60)))
    page = open_page(serve(tmp_path), "#/run/a/overview?x=updates&smooth=0.96", color_scheme="light")
    canvas = panel(page, "Gradient norm").locator("canvas").first
    canvas.scroll_into_view_if_needed()
    wait_for_drawn(page, "Gradient norm")
    height = canvas.evaluate("(canvas) => canvas.height")
    first, last = canvas.evaluate(ROWS_OF_BLUE)
    assert last - first > 0.5 * height, "raw values go from 0 to 1"
    first, last = canvas.evaluate(ROWS_OF_COLOUR, BLUE)
    assert last - first < 0.35 * height, "their average does not"


def test_evaluations_are_points_with_intervals(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    run = write_run(tmp_path / "a", 20)
    for update in (5, 10, 20):
        write_evaluation(run, update, [5, 5])
    page = open_page(serve(tmp_path), "#/run/a/overview", color_scheme="light")
    wait_for_drawn(page, "Evaluation: solve rates")
    canvas = panel(page, "Evaluation").locator("canvas").first
    first, last = canvas.evaluate(ROWS_OF_COLOUR, BLUE)
    assert last - first > 60, "equal rates of 10 of 20: without their intervals they are flat"
    shown = panel(page, "Evaluation").locator(".entry").inner_text().split("\n")
    assert shown[-2:] == ["0.5", "0.299 to 0.701"]


def test_events_have_names_and_neighbours_are_one(long_run: Path, open_page: OpenPage, serve: Serve) -> None:
    page = open_page(serve(long_run.parent), "#/run/a/overview?x=updates")
    wait_for_drawn(page, "Training episodes")
    here = panel(page, "Training episodes").locator(".events-here span")
    assert here.inner_text() == "30 buffers, process lost"
    box = box_of(page, panel(page, "Training episodes").locator(".u-over"))
    for share, expected in ((0.005, "30 buffers"), (0.4, ""), (0.75, "process lost")):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 40)
        assert here.inner_text() == expected


def test_every_explanation_can_be_read(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_metrics(
        tmp_path / "a", [{"physics/unstable": 0.0, "physics/contact_overflow": 0.0, "physics/invalid_scene": 0.0}] * 3
    )
    page = open_page(serve(tmp_path), "#/run/a/overview")
    wait_for_drawn(page, "Training episodes")
    faults = panel(page, "Faults of the physics")
    more = faults.get_by_role("button", name="more")
    more.wait_for()
    height = faults.locator(".explanation").bounding_box()["height"]
    more.focus()
    more.press("Enter")
    faults.get_by_role("button", name="less").wait_for()
    assert faults.locator(".explanation").bounding_box()["height"] > height
    page.evaluate(ALL_OF_IT)
    page.wait_for_timeout(200)
    assert page.evaluate(CUT) == []


def test_sections_stay_folded_and_a_search_opens_what_it_finds(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_metrics(tmp_path / "a", [{"physics/speed_limited": 1.0, "learner/learning_rate": 3e-4}] * 3)
    page = open_page(serve(tmp_path), "#/run/a/overview")
    limits = panel(page, "Speed limits of bodies")
    limits.wait_for()
    page.locator("[data-section=Physics] summary").click()
    limits.wait_for(state="detached")
    page.reload()
    wait_for_drawn(page, "Training episodes")
    assert limits.count() == 0, "it stays folded"
    page.keyboard.press("/")
    page.keyboard.type("Adam annealed")  # of the meaning of a metric that is not shown at first
    wait_for_drawn(page, "learner/learning_rate")
    assert page.locator("[data-section] [data-panel]").count() == 1
    assert "find=Adam+annealed" in page.url
    page.keyboard.press("ControlOrMeta+A")
    page.keyboard.type("speed limit")
    limits.wait_for()
    page.keyboard.press("Escape")
    panel(page, "Training episodes").wait_for()
    assert limits.count() == 0


def test_only_values_outside_their_normal_range_alarm(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    counters = {"physics/speed_limited": 4e4, "physics/contact_overflow": 0.0, "physics/unstable": 0.0}
    write_metrics(tmp_path / "healthy", [counters] * 3)
    write_metrics(tmp_path / "ill", [counters, counters | {"physics/unstable": 3.0}])
    server = serve(tmp_path)
    page = open_page(server, "#/run/healthy/overview")
    wait_for_drawn(page, "Speed limits of bodies")
    assert "speed limited 40 k, normal: below" in panel(page, "Speed limits of bodies").locator(".normal").inner_text()
    assert page.locator("[data-section] .bad").count() == 0
    page.goto(f"http://127.0.0.1:{server.port}/#/run/ill/overview")
    panel(page, "Faults of the physics").locator(".normal .bad").wait_for()
    assert "unstable 3, above normal" in panel(page, "Faults of the physics").locator(".normal").inner_text()
    assert "unstable above normal" in page.locator("[data-section=Physics] summary").inner_text()
    page.locator("[data-section=Physics] summary").click()
    assert "unstable above normal" in page.locator("[data-section=Physics] summary").inner_text(), "folded, too"


def test_raster_tables_fit_a_phone(trained_server: Server, open_page: OpenPage) -> None:
    page = open_page(trained_server, "#/run/tiny/curriculum", viewport={"width": 390, "height": 844})
    wait_for_drawn(page, "Solved x finished")
    page.wait_for_timeout(300)
    assert page.evaluate(WIDE) == []
