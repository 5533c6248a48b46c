"""Tools of the editor: ready-made mechanisms, joints that show where they land, roles, sizes, the bar of a phone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.browser.test_editor import Bench

ORANGE = (213, 94, 0)  # of overlay.js: outlines of shapes that a joint would hold
COUNT_PIXELS = """([r, g, b]) => {
  const canvas = document.querySelector(".editor-canvas");
  const context = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let k = 0; k < data.length; k += 4) count += data[k] === r && data[k + 1] === g && data[k + 2] === b;
  return count;
}"""
IS_AT_END = """() => {
  const row = document.querySelector(".tools .rest");
  return row.scrollLeft + row.clientWidth > row.scrollWidth - 2;
}"""
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "device_scale_factor": 2}
COMPILE_MS = 180_000  # until play starts, or a mechanism is made: the worker compiles behind everything else


@pytest.fixture
def editing(open_page: Callable[..., Any], serve: Callable[..., Any]) -> Callable[..., Bench]:
    def edit(given: Path | str, **options: Any) -> Bench:
        return Bench(open_page(serve(given, name="edit"), "#/edit", **options))

    return edit


def cursor(bench: Bench) -> str:
    bench.drawn()
    return str(bench.page.evaluate("() => document.querySelector('.editor-canvas').style.cursor"))


def elements(bench: Bench, kind: str) -> int:
    """Number of listed elements whose name has this in it."""
    bench.drawn()
    return bench.page.locator("[data-panel=elements] button", has_text=kind).count()


def saved(bench: Bench, file: Path) -> dict[str, Any]:
    bench.save(file.name)
    return dict(json.loads(file.read_text()))


def add(bench: Bench, name: str, number: int) -> None:
    bench.page.get_by_label(f"Mechanism: {name}").click()
    bench.page.get_by_role("heading", name=f"{number} elements").wait_for(timeout=COMPILE_MS)


def test_a_ready_made_car_drives_to_the_right_by_the_right_key(editing: Callable[..., Bench], tmp_path: Path) -> None:
    bench = editing(tmp_path / "mine.json")
    page = bench.page
    add(bench, "car", 3)
    bench.use("Circle")
    bench.drag((4.2, 0.7), (4.5, 0.7))
    bench.page.keyboard.press("Shift+B")
    page.locator("[data-panel=selection]").get_by_label("fixed").check()
    assert "Valid" in bench.checked()
    written = saved(bench, tmp_path / "mine.json")
    assert [shape["id"] for shape in written["shapes"]] == ["car_1", "car_2", "car_3", "circle_1"]
    assert all(joint["motor"]["speed"] < 0 for joint in written["joints"])  # of a wheel as b: to the right
    page.get_by_label("the level").press("Escape")
    page.keyboard.press("Space")
    page.keyboard.down("ArrowRight")
    page.wait_for_selector(".play-state[data-outcome=solved]", timeout=COMPILE_MS)
    page.keyboard.up("ArrowRight")
    page.keyboard.press("Escape")
    for _ in range(4):  # circle, role, fixed: one step each, and the car is the first one
        page.get_by_role("button", name="Undo").click()
    assert elements(bench, "car") == 0
    page.get_by_role("button", name="Redo").click()
    assert elements(bench, "revolute") == 2


def test_mechanisms_stand_apart_and_a_full_size_has_a_remedy(editing: Callable[..., Bench], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    bench = editing(file)
    page = bench.page
    add(bench, "car", 3)
    page.get_by_label("Mechanism: hopper").click()
    remedy = page.locator(".note .remedy", has_text="use size L and add it")
    remedy.wait_for(timeout=COMPILE_MS)
    assert "size m has room for 0 more" in page.locator(".note").inner_text()
    remedy.click()
    page.get_by_role("heading", name="4 elements").wait_for(timeout=COMPILE_MS)
    written = saved(bench, file)
    assert written["size"] == "l" and [shape.get("role") for shape in written["shapes"]].count("green") == 1
    assert "overlap" not in bench.checked()
    page.get_by_role("button", name="Undo").click()
    written = saved(bench, file)
    assert written["size"] == "m" and len(written["shapes"]) == 3

    for x in (0.6, 4.4):  # one box more than the size has room for
        bench.use("Box")
        bench.click(x, 3.5)
    assert "size m has room for 2" in bench.checked()
    page.locator("[data-panel=problems] .remedy", has_text="use size L").click()
    assert "room" not in bench.checked() and saved(bench, file)["size"] == "l"
    page.get_by_role("button", name="Undo").click()
    assert "size m has room for 2" in bench.checked()


def test_a_joint_shows_where_it_lands_and_is_not_stacked(editing: Callable[..., Bench], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    bench = editing(file)
    page = bench.page
    bench.use("Box")
    bench.drag((1.0, 1.0), (2.0, 1.4))
    bench.use("Circle")
    bench.drag((1.8, 1.2), (2.1, 1.2))
    page.get_by_label("the level").press("Escape")
    page.get_by_label("the level").press("Escape")
    bench.use("Revolute")
    page.mouse.move(*bench.pixel(4.0, 4.0))
    assert cursor(bench) == "not-allowed" and page.evaluate(COUNT_PIXELS, ORANGE) == 0
    page.mouse.move(*bench.pixel(1.2, 1.2))  # on the box alone
    assert cursor(bench) == "not-allowed"
    page.mouse.move(*bench.pixel(1.82, 1.21))
    assert cursor(bench) == "copy"
    assert page.evaluate(COUNT_PIXELS, ORANGE) > 300  # the outlines of both
    bench.click(1.82, 1.21)
    bench.click(1.82, 1.21)
    assert elements(bench, "revolute") == 1 and cursor(bench) == "pointer"
    page.get_by_role("heading", name="revolute box_1 - circle_1").wait_for()
    page.locator(".note", has_text="joined here already").wait_for()
    bench.use("Fixed")
    bench.drag((1.2, 1.2), (1.8, 1.2))  # the same by a drag, with another tool
    assert elements(bench, "fixed") == 0
    [joint] = saved(bench, file)["joints"]
    assert joint["anchor"] == [1.8, 1.2]

    bench.use("Fixed")  # by keys: the cross says what it would join
    for _ in range(3):
        page.get_by_label("the level").press("ArrowUp")
    page.locator(".note", has_text="no shape here").wait_for()


def test_roles_by_buttons_and_keys_and_a_new_level_without_complaints(
    editing: Callable[..., Bench], tmp_path: Path
) -> None:
    bench = editing(tmp_path / "mine.json")
    page = bench.page
    assert "Still to draw" in bench.checked() and "problem" not in bench.checked()
    assert page.locator(".problem, .bad").count() == 0
    assert page.locator("[data-guidance] li").count() == 3
    assert page.get_by_label("Role green").is_disabled()
    bench.use("Box")
    bench.click(1.0, 1.0)
    page.get_by_label("Role green").click()
    page.get_by_role("button", name="box_1 (green)").wait_for()
    bench.use("Circle")
    bench.click(3.0, 1.0)
    page.keyboard.press("Shift+G")  # one shape is green
    page.get_by_role("button", name="circle_1 (green)").wait_for()
    page.locator(".note", has_text="box_1 has no role now").wait_for()
    page.keyboard.press("Shift+N")
    assert page.locator("[data-guidance] li").count() == 3
    page.get_by_role("button", name="floor").click()
    page.keyboard.press("Shift+R")
    page.get_by_role("button", name="floor (red)").wait_for()
    assert page.get_by_label("Role red").get_attribute("aria-pressed") == "true"


def test_every_tool_has_an_icon_a_label_and_a_title(editing: Callable[..., Bench], tmp_path: Path) -> None:
    buttons = editing(tmp_path / "mine.json").page.get_by_role("toolbar").locator("button").all()
    assert len(buttons) == 10 + 4 + 14 + 5
    for button in buttons:
        assert button.get_attribute("aria-label") and button.get_attribute("title")
        assert button.locator("svg path, svg circle, svg rect").count() or len(button.inner_text()) == 1


def test_the_bar_of_a_phone_has_two_rows_that_fingers_reach(editing: Callable[..., Bench], tmp_path: Path) -> None:
    page = editing(tmp_path / "mine.json", **PHONE).page
    bar, width = page.get_by_role("toolbar"), "() => document.documentElement.scrollWidth"
    assert bar.bounding_box()["height"] < 2 * 46 and page.evaluate(width) == 390
    rows = {round(button.bounding_box()["y"]) for button in bar.locator("button").all()}
    assert len(rows) == 2
    row = bar.locator(".rest")
    place = row.bounding_box()
    devtools = page.context.new_cdp_session(page)
    y = place["y"] + place["height"] / 2
    for _ in range(3):  # a finger along the second row
        devtools.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": 350, "y": y}]})
        for x in range(340, 20, -20):
            devtools.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{"x": x, "y": y}]})
        devtools.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.wait_for_function(IS_AT_END)
    lander = page.get_by_label("Mechanism: lander").bounding_box()
    page.touchscreen.tap(lander["x"] + lander["width"] / 2, lander["y"] + lander["height"] / 2)
    page.get_by_role("heading", name="lander_1").wait_for(timeout=COMPILE_MS)
    assert page.evaluate(width) == 390


def test_a_policy_shows_bound_controls_and_its_last_values_at_the_end(editing: Callable[..., Bench]) -> None:
    page = editing("s/hop_home").page
    page.get_by_label("who plays").select_option("checkpoint:generalist")
    page.get_by_role("button", name="play", exact=False).first.click()
    page.locator(".mind").wait_for(timeout=COMPILE_MS)
    page.wait_for_selector(".play-state:not([data-outcome=''])", timeout=60_000)
    names = [text.split("\n")[0] for text in page.locator(".mind .heads > div").all_inner_texts()]
    shares = [float(text.split()[-2]) for text in page.locator(".mind .chance").all_inner_texts()]
    assert names == ["thruster 0"] and sum(shares) == pytest.approx(100, abs=1)
    assert "value" in page.locator(".mind").inner_text()
