"""Teaching in a real browser: a level is searched or taught by its buttons, and the result plays in the page."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import is_proof_document
from tests.studio.serving import Server

OpenPage = Callable[..., Any]
END_MS = 900_000  # of one job on a loaded machine, compilation included


def panel_of(page: Any) -> Any:
    page.wait_for_selector(".editor-canvas")
    return page.locator("[data-panel=teach]")


def played_to_its_end(page: Any) -> str:
    page.wait_for_selector(".play-state[data-outcome]:not([data-outcome=''])")
    return page.locator(".play-state").get_attribute("data-outcome")


@pytest.mark.long  # compiles, and searches for some seconds
def test_a_solution_is_searched_stored_and_played(serve: Any, open_page: OpenPage, tmp_path: Path) -> None:
    results = tmp_path / "results"
    server: Server = serve("s/hop_home", "--results", results, name="edit")
    page = open_page(server, "#/edit")
    panel = panel_of(page)
    panel.get_by_text(str(results)).first.wait_for()  # the page asks its server where
    panel.get_by_label("time to teach or to search").select_option("60")
    panel.get_by_role("button", name="solve it").click()
    panel.locator("[data-state=searching]").wait_for()
    body = json.dumps({"kind": "teach", "document": {}, "seconds": 60}).encode()
    status, _, content = server.request("/api/teaching", method="POST", body=body)
    assert status == 409 and "is being searched now" in json.loads(content)["error"]
    panel.locator("[data-state=done]").wait_for(timeout=END_MS)
    assert played_to_its_end(page) == "solved"
    level, proof = sorted(results.iterdir(), key=lambda path: len(path.name))
    assert proof.name == f"{level.stem}.proof.json" and is_proof_document(json.loads(proof.read_text()))
    assert str(proof) in panel.inner_text() and "kinetix-dist levels solve" in panel.locator("pre").text_content()


@pytest.mark.slow  # searches, and trains for about a minute
def test_a_level_is_taught_and_its_run_is_on_the_dashboard(serve: Any, open_page: OpenPage, tmp_path: Path) -> None:
    document = json.loads((levels_root() / "m" / "ramp_car.json").read_text())
    file, results = tmp_path / "mine.json", tmp_path / "results"
    file.write_text(json.dumps(document))
    page = open_page(serve(file, "--results", results, name="edit"), "#/edit")
    panel = panel_of(page)
    panel.get_by_label("time to teach or to search").select_option("60")
    panel.get_by_role("button", name="teach it").click()
    panel.locator("[data-state=searching]").wait_for()
    panel.locator("[data-state=imitating]").wait_for(timeout=END_MS)
    page.reload()  # the job goes on without its page
    panel = panel_of(page)
    panel.locator("[data-state=done]").wait_for(timeout=END_MS)
    text = panel.inner_text()
    assert "ramp_car: learned: 6" in text and " of 64 attempts" in text and "95 %:" in text, text
    assert "proof of " in text and "--run.imitation_steps" in panel.locator("pre").text_content()
    panel.get_by_role("button", name="play what was learned").click()
    assert played_to_its_end(page) in ("solved", "failed", "out of time")
    panel.get_by_role("link", name="its run").click()
    page.get_by_text("finished").first.wait_for()
    assert file.read_text() == json.dumps(document)


def test_what_cannot_be_taught_is_one_line(serve: Any, open_page: OpenPage, tmp_path: Path) -> None:
    document = json.loads((levels_root() / "s" / "hop_home.json").read_text())
    document["shapes"][0]["position"] = document["shapes"][2]["position"]  # in the goal from the start
    file = tmp_path / "mine.json"
    file.write_text(json.dumps(document))
    page = open_page(serve(file, "--results", tmp_path / "results", name="edit"), "#/edit")
    panel = panel_of(page)
    panel.get_by_role("button", name="teach it").click()
    panel.get_by_text("solves itself").wait_for()
    page.complaints.clear()  # Chromium's line about the status of the response
    assert not (tmp_path / "results").exists()
