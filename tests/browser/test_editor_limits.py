"""Handles of joints, equal gaps, hatching; levels that are far too large; play whose worker or server ends."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.browser.test_editor import Bench
from tests.browser.test_pages import COLOURS
from tests.studio.serving import end

MANY_BYTES = 100_000_000
COMPILE_MS = 240_000  # until play starts: the worker compiles behind everything else that the machine does
DROP = """async ([bytes, name]) => {
  const file = new File([new Uint8Array(bytes)], name, { type: "application/json" });
  const data = new DataTransfer();
  data.items.add(file);
  document.querySelector("main.editor").dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true }));
}"""


@pytest.fixture
def editing(open_page: Callable[..., Any], serve: Callable[..., Any]) -> Callable[..., Any]:
    def edit(given: Path | str, **options: Any) -> tuple[Bench, Any]:
        server = serve(given, name="edit")
        return Bench(open_page(server, "#/edit", **options)), server

    return edit


def level_of(shapes: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return {"format": "kinetix-dist-level", "version": 1, "name": "made", "size": "l", "shapes": shapes, **more}


def box(number: int, x: float, y: float, width: float = 0.4, **more: Any) -> dict[str, Any]:
    return {"id": f"box_{number}", "type": "box", "width": width, "height": 0.4, "position": [x, y], **more}


def test_handles_of_joints_and_equal_gaps(editing: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "made.json"
    shapes = [
        box(1, 2.0, 2.0, role="green"), box(2, 2.8, 2.0), box(3, 1.0, 4.0, angle=0.5), box(4, 1.6, 4.0),
        box(5, 0.5, 0.3, 0.2), box(6, 1.1, 0.3, 0.6), box(7, 2.5, 0.3, 0.4, role="blue", fixed=True),
    ]  # fmt: skip
    slider = {"type": "prismatic", "a": "box_1", "b": "box_2", "anchor": [2.4, 2.0], "axis": 0, "limits": [-0.3, 0.3]}
    joint = {"type": "revolute", "a": "box_3", "b": "box_4", "anchor": [1.3, 4.0]}
    file.write_text(json.dumps(level_of(shapes, joints=[slider, joint])))
    bench, _ = editing(file)
    elements = bench.page.locator(".elements")
    elements.get_by_role("button", name="prismatic", exact=False).click()
    bench.drag((2.95, 2.0), (2.4, 2.55))  # the axis, its handle 0.55 m from the anchor, to straight up
    bench.drag((2.4, 2.3), (2.4, 2.72))  # the upper limit: 0.7 on the grid
    elements.get_by_role("button", name="revolute", exact=False).click()
    # b is to the right of the joint, 0.5 rad behind a; the handle of the rest angle goes from 0 to 90 degrees.
    bench.drag((1.52, 4.0), (1.3, 4.22))
    for number, option in ((5, {}), (6, {"modifiers": ["Shift"]}), (7, {"modifiers": ["Shift"]})):
        elements.get_by_role("button", name=f"box_{number}", exact=False).click(**option)
    bench.page.get_by_label("the level").press("Alt+h")
    bench.save("made.json")
    saved = json.loads(file.read_text())
    assert saved["joints"][0]["axis"] == pytest.approx(math.pi / 2, abs=1e-4)
    assert saved["joints"][0]["limits"] == [-0.3, 0.7]
    # now = 0 - 0.5 rad; a quarter turn on, to the next 15 degrees
    assert saved["joints"][1]["rest_angle"] == pytest.approx(math.radians(60), abs=1e-4)
    edges = [(s["position"][0] - s["width"] / 2, s["position"][0] + s["width"] / 2) for s in saved["shapes"][4:]]
    assert edges[0][0] == 0.4 and edges[2][1] == 2.7  # the outermost stay
    gaps = [edges[1][0] - edges[0][1], edges[2][0] - edges[1][1]]
    assert gaps == pytest.approx([(2.3 - 1.2) / 2] * 2, abs=2e-4)


def test_what_is_fixed_is_hatched(editing: Callable[..., Any], tmp_path: Path) -> None:
    """The colours of a fixed box: its own, the hatching's, the outline's."""
    bench, _ = editing(tmp_path / "new.json")
    colours = """async (fixed) => {
      const { drawWorld } = await moduleOf("world/canvas.js");
      const { levelPicture } = await moduleOf("world/display_list.js");
      const engine = await (await fetch("api/engine")).json();
      const shapes = [{ id: "a", type: "box", width: 2, height: 2, position: [2.5, 2.5], role: "red", fixed }];
      const { display, poses } = levelPicture({ size: "s", shapes }, engine);
      const canvas = Object.assign(document.createElement("canvas"), { width: 520, height: 520 });
      drawWorld(canvas, display, poses, engine.palette, { letters: true });
      const data = canvas.getContext("2d").getImageData(170, 170, 40, 40).data; // inside, away from the letter
      return new Set(Array.from({ length: 1600 }, (_, k) => data.slice(4 * k, 4 * k + 3).join(" "))).size;
    }"""
    assert bench.page.evaluate(colours, False) == 1
    assert bench.page.evaluate(colours, True) > 2


def test_levels_that_are_far_too_large_are_one_line_or_drawn(editing: Callable[..., Any], tmp_path: Path) -> None:
    bench, _ = editing(tmp_path / "new.json")
    page = bench.page
    note = page.locator(".note")
    page.evaluate(DROP, [MANY_BYTES, "huge.json"])
    note.filter(has_text="huge.json is too large for a level: 100.0 MB; a level has a few kB").wait_for()

    def open_shapes(count: int) -> None:
        shapes = [box(k, 0.05 * (k % 100), 0.05 * (k // 100), 0.04) for k in range(count)]
        buffer = json.dumps(level_of(shapes)).encode()
        page.locator("input[type=file]").set_input_files(
            {"name": "many.json", "mimeType": "application/json", "buffer": buffer}
        )

    open_shapes(10_000)
    note.filter(has_text="this is too large for a level: more than 1,000 shapes").wait_for()
    began = time.monotonic()
    open_shapes(1000)
    note.filter(has_text="opened; undo brings back the level before").wait_for()
    assert "has room for" in bench.checked()
    assert page.locator(".editor-canvas").evaluate(COLOURS) > 4
    page.get_by_label("the level").press("Control+z")
    assert "green" in bench.checked()  # the empty level before
    assert time.monotonic() - began < 30, "a page that hangs takes minutes"


@pytest.mark.long
def test_play_ends_in_one_line_with_its_worker_and_with_the_server(editing: Callable[..., Any], tmp_path: Path) -> None:
    bench, server = editing("s/hop_home")
    page, picture = bench.page, bench.page.get_by_label("the level")

    def play() -> None:
        picture.press("Space")
        page.locator(".play-state").or_(page.get_by_role("alert")).first.wait_for(timeout=COMPILE_MS)
        assert page.get_by_role("alert").all_inner_texts() == []

    play()
    [worker] = [c for c in psutil.Process(server.process.pid).children() if "studio.worker" in " ".join(c.cmdline())]
    worker.kill()
    page.get_by_role("alert").filter(has_text="the engine worker died (exit status -9)").wait_for()
    page.get_by_role("button", name="✎ edit").wait_for()
    picture.press("Escape")
    page.get_by_role("alert").wait_for(state="detached")
    page.get_by_text("✓ Valid").wait_for()  # the level is there, and another worker
    play()
    end(server.process)
    page.get_by_role("alert").filter(has_text="the connection to the server was lost").wait_for()
    page.get_by_text("disconnected").wait_for()
    picture.press("Escape")
    picture.press("Control+a")
    picture.press("Delete")  # drawing goes on without a server
    page.get_by_text("disconnected").wait_for()
    page.context.close()  # before it tries again
    page.complaints.clear()  # the browser says that it cannot connect
