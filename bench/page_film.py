"""Moving picture of the editor for the docs: a level is drawn, played by keys, taught, and watched.

    python -m bench.page_film --to docs/images/editor/film.gif [--teach-minutes 1]

All of it is a real session in a headless Chromium. Each part is shown faster than it was, as its caption says: training
takes a minute or more. Stops with an error where a part did not happen.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from bench.dashboard import add_browser_argument, launched, serving
from bench.program import exit_code, parser_of
from kinetix_dist.errors import UserError

WIDTH, HEIGHT = 1280, 800  # of the page
SHOWN_WIDTH = 900
CAPTION_HEIGHT, CAPTION_SIZE = 34, 17
COLOURS = 48
VIEW_M = 5.5  # along the shorter side of the picture, about (2.5, 2.5)
PAUSE_MS = 1400  # for a caption to be read
LAST_MS = 4000
TIMEOUT_MS = 60_000
LONGEST_S = 600  # of a part
TAUGHT = "[data-panel=teach] [role=status][data-state=done]"


class Film:
    """Pictures of a page, each with the time that it is shown."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self._font = ImageFont.load_default(CAPTION_SIZE)
        self.frames: list[Image.Image] = []
        self.milliseconds: list[int] = []

    def shoot(self, caption: str, milliseconds: int = PAUSE_MS) -> None:
        page = Image.open(io.BytesIO(self._page.screenshot())).convert("RGB")
        shown = page.resize((SHOWN_WIDTH, SHOWN_WIDTH * page.height // page.width), Image.Resampling.LANCZOS)
        frame = Image.new("RGB", (shown.width, shown.height + CAPTION_HEIGHT), "#1c2128")
        frame.paste(shown, (0, CAPTION_HEIGHT))
        ImageDraw.Draw(frame).text((12, 7), caption, fill="white", font=self._font)
        self.frames.append(frame.quantize(COLOURS, dither=Image.Dither.NONE))
        self.milliseconds.append(milliseconds)

    def shoot_while(self, caption: str, is_over: Callable[[], bool], *, every_s: float, milliseconds: int) -> None:
        """Takes a picture every so often. Raises UserError where it goes on for ten minutes."""
        deadline = time.monotonic() + LONGEST_S
        while not is_over():
            if time.monotonic() > deadline:
                raise UserError(f"{caption!r} did not end within {LONGEST_S} s")
            self.shoot(caption, milliseconds)
            self._page.wait_for_timeout(1000 * every_s)

    def save(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        first, *others = self.frames
        first.save(file, save_all=True, append_images=others, duration=self.milliseconds, loop=0, optimize=True)
        seconds = sum(self.milliseconds) / 1000
        print(f"{file}  {file.stat().st_size // 1024} kB, {len(self.frames)} pictures, {seconds:.0f} s")


class Drawing:
    """The editor's mouse in metres of the level."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self._box = page.locator(".editor-canvas").bounding_box()

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        scale = min(self._box["width"], self._box["height"]) / VIEW_M
        middle = self._box["x"] + self._box["width"] / 2, self._box["y"] + self._box["height"] / 2
        return middle[0] + (x - 2.5) * scale, middle[1] - (y - 2.5) * scale

    def use(self, tool: str) -> None:
        self.page.get_by_role("toolbar").get_by_label(tool, exact=True).click()

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*self.pixel(*start))
        mouse.down()
        mouse.move(*self.pixel((start[0] + end[0]) / 2, (start[1] + end[1]) / 2))
        mouse.move(*self.pixel(*end))
        mouse.up()


def make_film(page: Any, teach_minutes: int) -> Film:
    film, drawing = Film(page), Drawing(page)
    film.shoot("1  Draw: a new level")
    page.locator("[aria-label=mechanisms] button", has_text="car").first.click()
    page.wait_for_selector(".elements button")
    page.wait_for_timeout(1000)
    film.shoot("1  Draw: a car, ready-made")
    page.keyboard.press("Shift+g")
    film.shoot("1  Draw: the car is green")
    drawing.use("Box")
    drawing.drag((3.2, 0.42), (3.5, 0.48))
    page.wait_for_timeout(300)
    film.shoot("1  Draw: a loose plate on its way")
    drawing.use("Circle")
    drawing.drag((4.4, 0.75), (4.7, 0.75))
    page.wait_for_timeout(300)
    page.keyboard.press("Shift+b")
    film.shoot("1  Draw: the goal is blue")
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    page.wait_for_selector(".play-state")
    page.keyboard.down("ArrowRight")
    for _ in range(12):
        film.shoot("2  Play: by arrow keys", 160)
    page.keyboard.up("ArrowRight")
    page.keyboard.press("Escape")
    page.get_by_label("time to teach or to search").select_option(str(60 * teach_minutes))
    page.get_by_role("button", name="teach it", exact=True).click()
    page.wait_for_selector("[data-panel=teach] [role=status][data-state]")
    page.locator("[data-panel=teach]").scroll_into_view_if_needed()
    film.shoot_while(
        "3  Teach: the bundled policy is tried, and trained where it fails",
        lambda: page.locator(TAUGHT).count() > 0,
        every_s=5.0,
        milliseconds=350,
    )
    film.shoot("3  Teach: " + page.locator(TAUGHT).inner_text().split(": ", 1)[1], 3500)
    page.locator(".play-state").wait_for()
    page.evaluate("() => scrollTo(0, 0)")
    page.get_by_role("button", name="from the start").click()
    if page.get_by_role("button", name="go on").is_visible():
        page.get_by_role("button", name="go on").click()
    for _ in range(16):
        film.shoot("4  Watch: the policy plays", 200)
    film.milliseconds[-1] = LAST_MS
    return film


def main() -> int:
    parser = parser_of(__doc__)
    add_browser_argument(parser)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--teach-minutes", type=int, choices=(1, 2, 5), default=1)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    with (
        tempfile.TemporaryDirectory() as folder,
        serving(f"{folder}/mine.json", "--results", f"{folder}/taught", name="edit") as (address, _),
        launched(arguments.browser) as browser,
    ):
        page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, locale="en-US").new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(address)
        page.wait_for_selector(".editor-canvas")
        page.wait_for_timeout(2000)
        make_film(page, arguments.teach_minutes).save(arguments.to)
    return 0


if __name__ == "__main__":
    sys.exit(main())
