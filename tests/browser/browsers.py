"""Browsers that tests of the pages run in: each kind that is found here.

| kind | program | looked for |
|---|---|---|
| `shell` | headless Chromium without the parts of a window: requests no icon | what `make browser` fetches |
| `full` | Chromium or Chrome as people have it, without its window | KINETIX_FULL_BROWSER, path, Playwright's cache |

Continuous integration has the first. A machine with the second finds what only people would see.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

from tests.helpers import REPOSITORY

FETCHED = REPOSITORY / ".cache" / "browser"
FULL_VARIABLE = "KINETIX_FULL_BROWSER"
FULL_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PLAYWRIGHT_CACHE = "ms-playwright"
PLAYWRIGHT_PROGRAMS = ("chromium-*/chrome-linux*/chrome", "chromium-*/chrome-mac*/Chromium.app/Contents/MacOS/Chromium")
# No sandbox (containers have no user namespaces), WebGL in software.
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu-compositing",
    "--disable-accelerated-2d-canvas",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


@dataclasses.dataclass(frozen=True)
class Browser:
    """A program, and what its environment has besides that of the tests."""

    kind: str
    program: Path
    environment: tuple[tuple[str, str], ...] = ()


def found_browsers() -> list[Browser]:
    """Installed browsers, one of each kind at most."""
    found = []
    if (FETCHED / "chromium").is_file():  # with its own libraries and fonts, for machines that have none
        own = (("LD_LIBRARY_PATH", str(FETCHED / "lib")), ("FONTCONFIG_PATH", str(FETCHED)))
        found.append(Browser("shell", FETCHED / "chromium", own))
    if (program := _full_browser()) is not None:
        found.append(Browser("full", program))
    return found


def _full_browser() -> Path | None:
    if named := os.environ.get(FULL_VARIABLE):
        return Path(named)
    for name in FULL_NAMES:
        if (program := shutil.which(name)) is not None:
            return Path(program)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    cache = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH") or home / PLAYWRIGHT_CACHE)
    programs = [program for pattern in PLAYWRIGHT_PROGRAMS for program in sorted(cache.glob(pattern))]
    return programs[-1] if programs else None
