"""Speed of the editor in a real browser: dragging, checking, playing.

    python -m bench.editor [--browser .cache/browser/chromium] [--json FILE]

`drag` is the work of the page for one picture while all shapes of a level of size L are dragged; `check` from the
question to the answer, over all designed levels of size L; `gap` between frames of play; `key` from a key to the
picture that obeyed it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

import numpy as np

from bench.dashboard import add_browser_argument, launched, serving
from bench.program import exit_code, output_file, parser_of
from kinetix_dist.errors import UserError

LEVEL, TORSO_M = "l/walker", (1.0, 2.0)  # a point of its first shape
NUM_MOVES = 120
CHECKED = "[data-panel=problems][data-checked=true]"

MEASURE_WORK = """() => {
  window.work = [];
  let sum = 0;
  const frame = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (act) => frame((now) => {
    const began = performance.now();
    act(now);
    sum += performance.now() - began;
  });
  let began = 0;
  window.addEventListener("pointermove", () => { began = performance.now(); }, true);
  window.addEventListener("pointermove", () => { sum += performance.now() - began; });
  frame(function tick() { if (sum) window.work.push(sum); sum = 0; frame(tick); });
}"""
CHECK = """async () => {
  const { channel } = await import(new URL("base/channel.js", document.querySelector("script[type=module]").src));
  const { levels } = await (await fetch("api/levels/sets/all_designed_l")).json();
  const times = [];
  for (const { text } of levels) {
    const began = performance.now();
    await channel.request("check", { document: JSON.parse(text), play: false });
    times.push(performance.now() - began);
  }
  return times;
}"""
PLAY = """async (seconds) => {
  const { channel } = await import(new URL("base/channel.js", document.querySelector("script[type=module]").src));
  const [[, session]] = channel.sessions;
  const show = session.frame;
  const gaps = [], keys = [];
  let last = 0, pressed = 0, wanted = 0, isDown = false;
  session.frame = (bytes) => {
    const now = performance.now();
    if (last) gaps.push(now - last);
    last = now;
    show(bytes);
    if (pressed && new DataView(bytes).getUint32(8, true) >= wanted) {
      const at = pressed;
      pressed = 0;
      requestAnimationFrame(() => keys.push(performance.now() - at));
    }
  };
  const timer = setInterval(() => {
    isDown = !isDown;
    wanted += 1;
    pressed = performance.now();
    document.body.dispatchEvent(new KeyboardEvent(isDown ? "keydown" : "keyup", { key: "ArrowRight", bubbles: true }));
  }, 170);
  await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
  clearInterval(timer);
  return { gaps, keys };
}"""


def measure(browser: Any, play_seconds: float) -> dict[str, list[float]]:
    """Milliseconds."""
    with serving(LEVEL, name="edit") as (address, _):
        page = browser.new_context(viewport={"width": 1600, "height": 900}, locale="en-US").new_page()
        page.set_default_timeout(120_000)
        page.goto(address)
        page.wait_for_selector(CHECKED)
        page.wait_for_timeout(3000)  # until it was tried whether the level solves itself
        page.keyboard.press("Control+a")
        page.evaluate(MEASURE_WORK)
        box = page.locator(".editor-canvas").bounding_box()
        scale = min(box["width"], box["height"]) / 5.5  # pixels of a metre
        x = box["x"] + box["width"] / 2 + (TORSO_M[0] - 2.5) * scale
        y = box["y"] + box["height"] / 2 - (TORSO_M[1] - 2.5) * scale
        page.mouse.move(x, y)
        page.mouse.down()
        for k in range(NUM_MOVES):
            page.mouse.move(x + 0.5 * k, y - 0.3 * k)
        page.mouse.up()
        drag = page.evaluate("() => window.work")
        page.locator(".elements button").first.click()
        at = float(page.get_by_label("position 1", exact=True).input_value())
        if abs(at - TORSO_M[0] - 0.5 * NUM_MOVES / scale) > 0.1:
            raise UserError(f"the torso was not dragged (x is {at} m); is {LEVEL} another level?")
        check = page.evaluate(CHECK)
        page.get_by_role("button", name="play", exact=False).first.click()
        page.wait_for_selector(".play-state")
        page.wait_for_timeout(1000)
        played = page.evaluate(PLAY, play_seconds)
    return {"drag_ms": drag, "check_ms": check, "gap_ms": played["gaps"], "key_ms": played["keys"]}


def main() -> int:
    parser = parser_of(__doc__)
    add_browser_argument(parser)
    parser.add_argument("--play-seconds", type=float, default=6.0, help="an episode has 8.5 s")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    with launched(arguments.browser) as browser:
        result = measure(browser, arguments.play_seconds)
    for name, values in result.items():
        median, high = np.percentile(values, [50, 95])
        print(f"{name:12s} median {median:6.1f}, 95 % {high:6.1f} ({len(values)})")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result | {"load": os.getloadavg()}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
