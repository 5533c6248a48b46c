"""Pictures of the pages for the docs, of a real run in a real browser.

    python -m bench.page_pictures --runs DIR --run NAME --to docs/images [--only dashboard/overview editor/play]

Writes `dashboard/*.png` and `editor/*.png`, 1600 x 900 or four phones of 390 x 844 side by side, with 256 colours. DIR
holds run NAME, which has evaluations, recordings and a buffer, and others to compare it with.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from bench.dashboard import CHECKOUT, add_browser_argument, launched, serving
from bench.program import exit_code, parser_of
from kinetix_dist.errors import UserError

WIDE, PHONE = (1600, 900), (390, 844)
GAP = 10  # pixels between phones
COLOURS = 256
WALKER_SHAPES = 6  # of l/walker: the elements after them are its joints
SETTLED_MS = 2500  # after a page's last request: charts are drawn and thumbnails have come
TIMEOUT_MS = 180_000

Act = Callable[[Any], None]  # with a page, before its picture is taken


def _nothing(page: Any) -> None:
    pass


def _wait_for_words(page: Any) -> None:
    """The table of runs has a verdict on each."""
    page.wait_for_function(
        "() => document.querySelectorAll('a.word').length === document.querySelectorAll('.runs tbody tr').length"
    )


def _play_first_level(page: Any) -> None:
    page.locator(".thumbnail").first.click()
    page.locator(".drawer").get_by_role("button", name="play", exact=False).first.click()
    page.wait_for_timeout(4000)


def _step_replay(page: Any) -> None:
    page.locator(".player input[type=range]").first.evaluate(
        "(bar) => { bar.value = String(bar.max / 3); bar.dispatchEvent(new Event('input', { bubbles: true })); }"
    )


def _play_policy(page: Any) -> None:
    page.get_by_label("who plays").select_option("checkpoint:generalist")
    page.get_by_role("button", name="play", exact=False).first.click()
    page.locator(".mind").wait_for()
    page.wait_for_timeout(1200)
    page.get_by_role("button", name="pause").click()


def _select_problem(page: Any) -> None:
    page.locator("[data-panel=problems] button").first.click()


# Name of a picture: address behind the server's, and what is done on the page before.
DASHBOARD: Mapping[str, tuple[str, Act]] = {
    "runs": ("#/runs", _wait_for_words),
    "overview": ("#/run/{run}/overview", _nothing),
    "curriculum": ("#/run/{run}/curriculum", _nothing),
    "levels": ("#/run/{run}/levels", _nothing),
    "level": ("#/run/{run}/levels", _play_first_level),
    "evaluation": ("#/run/{run}/evaluation", _nothing),
    "replays": ("#/run/{run}/replays", _step_replay),
    "compare": ("#/compare", _nothing),
}
PHONES = ("overview", "curriculum", "levels", "evaluation")
# Name of a picture: what `kinetix-dist edit` is given, and what is done on the page before.
EDITOR: Mapping[str, tuple[Sequence[str], Act]] = {
    "build": (["l/walker"], lambda page: page.locator(".elements button").nth(WALKER_SHAPES).click()),
    "play": (["s/hop_home"], _play_policy),
    "gallery": ([], _nothing),
}


class Camera:
    """A browser that takes pictures of one server's pages."""

    def __init__(self, browser: Any, address: str) -> None:
        self._browser, self._address = browser, address

    def picture(
        self, view: str, act: Act = _nothing, *, size: tuple[int, int] = WIDE, scheme: str = "dark"
    ) -> Image.Image:
        """A picture of the page at address `view` behind the server's, once `act` was done. scheme: dark or light."""
        context = self._browser.new_context(
            viewport={"width": size[0], "height": size[1]}, color_scheme=scheme, locale="en-US", has_touch=size == PHONE
        )
        page = context.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(self._address)
        page.wait_for_selector("nav")
        if view:
            page.goto(self._address.split("?")[0] + view)
        page.wait_for_load_state("networkidle")
        page.wait_for_timeout(SETTLED_MS)
        act(page)
        page.wait_for_timeout(SETTLED_MS)
        taken = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        context.close()
        return taken


def side_by_side(pictures: Sequence[Image.Image]) -> Image.Image:
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    joined = Image.new("RGB", (width, max(picture.height for picture in pictures)), "white")
    left = 0
    for picture in pictures:
        joined.paste(picture, (left, 0))
        left += picture.width + GAP
    return joined


def save(picture: Image.Image, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)
    print(f"{file}  {file.stat().st_size // 1024} kB", flush=True)


def main() -> int:
    parser = parser_of(__doc__)
    add_browser_argument(parser)
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--run", required=True)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=[])
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    names = [
        *(f"dashboard/{name}" for name in (*DASHBOARD, "phone")),
        *(f"editor/{name}" for name in (*EDITOR, "problems", "phone")),
    ]
    if unknown := set(arguments.only) - set(names):
        raise UserError(f"--only has {', '.join(sorted(unknown))}; pictures are {', '.join(names)}")
    wanted = arguments.only or names
    with launched(arguments.browser) as browser:
        with serving(arguments.runs) as (address, _):
            camera = Camera(browser, address)
            for name, (view, act) in DASHBOARD.items():
                if f"dashboard/{name}" in wanted:
                    save(camera.picture(view.format(run=arguments.run), act), arguments.to / f"dashboard/{name}.png")
            if "dashboard/phone" in wanted:
                views = [DASHBOARD[name][0].format(run=arguments.run) for name in PHONES]
                phones = [camera.picture(view, size=PHONE) for view in views]
                save(side_by_side(phones), arguments.to / "dashboard/phone.png")
        for name, (given, act) in EDITOR.items():
            if f"editor/{name}" in wanted:
                with serving(*given, name="edit") as (address, _):
                    save(Camera(browser, address).picture("", act), arguments.to / f"editor/{name}.png")
        if "editor/problems" in wanted:
            with tempfile.TemporaryDirectory() as folder:
                level = json.loads((CHECKOUT / "levels/s/hop_home.json").read_text())
                level["shapes"][1]["role"] = "green"  # as the glider is
                file = Path(folder) / "two_greens.json"
                file.write_text(json.dumps(level))
                with serving(file, name="edit") as (address, _):
                    save(Camera(browser, address).picture("", _select_problem), arguments.to / "editor/problems.png")
        if "editor/phone" in wanted:
            with serving("s/hop_home", name="edit") as (address, _):
                camera = Camera(browser, address)
                phones = [camera.picture("", size=PHONE, scheme=scheme) for scheme in ("light", "dark")]
                save(side_by_side(phones), arguments.to / "editor/phone.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
