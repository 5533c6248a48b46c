"""A level of a run's buffer in the editor: played bit for bit from its arrays while it is as it came."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.studio.worker import frames
from kinetix_dist.studio.worker.levels import level_of
from kinetix_dist.studio.worker.request import env_of
from kinetix_dist.studio.worker.session import Session
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, list_snapshots
from tests.studio.serving import Server

NUM_STEPS, INDEX = 10, 3
RECORD = """async () => {
  const { channel } = await moduleOf("base/channel.js");
  const [[, session]] = channel.sessions;
  const show = session.frame;
  window.frames_of_play = {};
  session.frame = (bytes) => {
    window.frames_of_play[new DataView(bytes).getUint32(4, true)] = btoa(String.fromCharCode(...new Uint8Array(bytes)));
    show(bytes);
  };
}"""


def test_it_is_played_from_its_arrays_bit_for_bit(
    trained: Path, trained_server: Server, open_page: Callable[..., Any]
) -> None:
    kind, number, _ = list_snapshots(trained / "tiny" / DIRECTORY)[-1]
    address = f"runs/tiny/curriculum/{kind}/{number}/levels/{INDEX}/document"
    page = open_page(trained_server, f"#/edit?from={address}")
    picture = page.get_by_label("the level")
    page.locator("[data-panel=problems][data-checked=true]").wait_for()
    picture.press("Space")
    page.locator(".play-state", has_text="from the stored arrays").wait_for()
    picture.press("p")
    page.get_by_role("button", name="go on").wait_for()
    page.get_by_label("speed").select_option("0.125")  # so slow that hardly a frame is spared
    page.evaluate(RECORD)
    picture.press("Backspace")  # from the start
    page.wait_for_function(f"() => Object.keys(window.frames_of_play).some((step) => step >= {NUM_STEPS})")
    seen = page.evaluate("() => window.frames_of_play")

    run = str(trained / "tiny")
    given = level_of({"run": run, kind: number, "index": INDEX})
    session = Session(1, env_of({"run": run}, given.info.size), given.level, seed=0)
    compared, expected = 0, frames.decode(session.frame(), session.sizes)
    for step in range(NUM_STEPS):
        expected = frames.decode(session.frame(), session.sizes)
        if str(step) in seen:  # a slow page is spared frames
            shown = frames.decode(base64.b64decode(seen[str(step)]), session.sizes)
            np.testing.assert_array_equal(shown.poses, expected.poses)
            assert (shown.reward, shown.total_reward) == (expected.reward, expected.total_reward)
            compared += 1
        session.step()
    assert compared > NUM_STEPS / 2
    assert np.abs(expected.poses - session.moments[0].poses).max() > 1e-3, "something moves"

    picture.press("Escape")  # another level is played as the document that it is
    picture.press("Control+a")
    picture.press("ArrowUp")
    picture.press("Space")
    page.locator(".play-state").wait_for()
    assert "stored" not in page.locator(".play-state").inner_text()
    picture.press("Escape")
    picture.press("Control+z")
    picture.press("Space")
    page.locator(".play-state", has_text="from the stored arrays").wait_for()
