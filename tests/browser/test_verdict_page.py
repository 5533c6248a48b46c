"""The verdict in a real browser: it comes first, parts lead to their evidence, a new run says what is expected."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.level.sets import load_level_set
from kinetix_dist.studio.worker.evaluated_sets import features_of_set
from tests.studio.runs_for_tests import write_config, write_rows
from tests.studio.serving import Server
from tests.studio.verdict_runs import write_collapsed, write_learning, write_mislabelled, write_state

OpenPage = Callable[..., Any]
Serve = Callable[..., Server]

PHONE = {"width": 390, "height": 844}
# The title of the panel that has the focus, once the page has scrolled to it.
SHOWN = """(title) => {
  const element = document.activeElement;
  if (!element?.dataset.panel?.startsWith(title)) return false;
  const box = element.getBoundingClientRect();
  return box.top >= 0 && box.top < innerHeight;
}"""


def test_the_verdict_comes_first_and_its_parts_lead_to_their_evidence(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_learning(tmp_path / "a")
    page = open_page(serve(tmp_path, "--no-play"), "#/run/a/overview?x=updates")
    heading = page.locator(".verdict h2")
    heading.get_by_text("Yes: it learned. 2 of 2 held-out sets rose").wait_for()
    page.locator(".chart canvas").first.wait_for()
    assert page.locator("main > :first-child").get_attribute("class") == "verdict"
    following = page.locator(".verdict .next")
    assert following.locator("p").inner_text().startswith("Next: train for longer: solve rates of fresh levels still")
    assert "--resume --run.total_env_steps 2048" in following.locator("pre").inner_text()
    following.get_by_role("button", name="copy").click()
    following.get_by_text("copied").or_(following.get_by_text("it is selected")).wait_for()
    assert page.locator(".verdict li").count() == 12
    for title, place, panel in (
        ("Speed", "/overview?x=updates&panel=", "Where the time goes"),
        ("random_s", "/evaluation?x=updates&set=", "random_s"),
        ("Learnability", "/curriculum?x=updates&panel=", "Learnability"),
        ("Never touched", "/curriculum?x=updates&panel=", "Solve rate by number of shapes"),
    ):
        page.locator(".verdict").get_by_role("link", name=title, exact=True).click()
        page.wait_for_function(SHOWN, arg=panel)
        assert place in page.url
        page.go_back()
        heading.wait_for()


def test_a_link_opens_the_folded_part_of_the_page(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_learning(tmp_path / "a", refreshes=2)
    server = serve(tmp_path, "--no-play")
    page = open_page(server, "#/run/a/overview?panel=train/episodes")
    page.wait_for_function(SHOWN, arg="train/episodes")


def test_what_fails_comes_from_the_engine_and_leads_to_the_group(
    trained: Path, tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    run = tmp_path / "a"
    shutil.copytree(trained / "tiny", run)
    lines = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    name, found = next(iter(lines[-1]["sets"].items()))
    features = features_of_set(load_level_set(name)[0])
    has_joints = [count > 0 for count in features["joints"]]
    found["solved"] = [0 if joints else found["attempts"] for joints in has_joints]
    (run / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    page = open_page(serve(tmp_path), "#/run/a/overview")
    failing = page.locator('[data-statement="failing"]')
    failing.get_by_text(re.compile(f"In {name}, levels with .* fail most beyond the rest: 0.0 %")).wait_for()
    failing.get_by_role("link", name="What fails").click()
    page.wait_for_function(SHOWN, arg=f"What fails in {name}")
    assert "group=" in page.url and page.locator(f'[data-panel="What fails in {name}"] select').input_value() != "none"


def test_each_warning_is_said_once_and_leads_to_its_metric(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    run = write_learning(tmp_path / "a", refreshes=2)
    write_rows(run, 33, 60, **{"learner/approx_kl": 0.3, "time/idle": 0.4})
    page = open_page(serve(tmp_path, "--no-play"), "#/run/a/overview")
    own = page.locator('[data-statement="warning/learner/approx_kl"]')
    own.get_by_text("0.3 in the last 10 rows (rule: mean of 10 rows above 0.1).").wait_for()
    assert page.locator("main").inner_text().count("rule: mean of 10 rows above 0.2") == 1, "of time/idle, by Speed"
    assert page.locator(".warnings").count() == 0
    own.get_by_role("link", name="learner/approx_kl").click()
    page.wait_for_function(SHOWN, arg="KL divergence")


def test_terms_are_marked_once_and_not_in_names_of_settings(tmp_path: Path, open_page: OpenPage, serve: Serve) -> None:
    write_mislabelled(tmp_path / "a", refreshes=2)
    page = open_page(serve(tmp_path, "--no-play"), "#/run/a/overview")
    terms = page.locator(".verdict button.term")
    terms.first.wait_for()
    words = [word.lower().removesuffix("s") for word in terms.all_inner_texts()]
    assert len(set(words)) == len(words) and "random_" in words
    remedy = page.locator('[data-statement="claim"]')
    assert "curriculum.scoring_steps" in remedy.inner_text()
    assert remedy.get_by_role("button", name="curriculum", exact=True).count() == 0
    terms.filter(has_text="random_s").click()
    page.locator("#meaning", has_text="held-out sets of 256 random levels").wait_for()


def test_on_a_phone_the_verdict_comes_first_and_the_rest_is_folded(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_learning(tmp_path / "a_run_with_a_name_that_is_far_too_long_for_a_phone", refreshes=2)
    write_collapsed(tmp_path / "b", refreshes=2)
    server = serve(tmp_path, "--no-play")
    page = open_page(server, "#/run/a_run_with_a_name_that_is_far_too_long_for_a_phone/overview", viewport=PHONE)
    page.locator(".verdict .next").wait_for()
    page.locator("[data-section]").first.wait_for()
    assert page.locator("[data-section][open]").count() == 0 and page.locator(".chart").count() == 0
    assert page.locator(".verdict li:visible").count() == 0, "no part needs a look"
    assert page.evaluate("() => document.documentElement.scrollHeight") < 3 * PHONE["height"]
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    tops = {box["y"] // 10 * 10 for box in (link.bounding_box() for link in page.locator("nav a:visible").all())}
    assert len(tops) == 2, "two rows"
    theme = page.get_by_role("button", name="dark or light").bounding_box()
    assert theme["y"] < min(tops) + 10, "in the first one"
    page.locator(".verdict summary").click()
    page.get_by_role("link", name="Speed", exact=True).click()
    page.wait_for_function(SHOWN, arg="Where the time goes")
    page.reload()
    page.locator("[data-section][open]").first.wait_for()
    page = open_page(server, "#/run/b/overview", viewport=PHONE)
    page.locator('.verdict [data-statement="stability"]:visible').wait_for()
    assert page.locator('.verdict [data-statement="speed"]:visible').count() == 0


def test_the_table_of_runs_has_a_word_for_each_and_sorts_by_it(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_learning(tmp_path / "b_good", refreshes=2)
    write_collapsed(tmp_path / "c_bad", refreshes=2)
    write_config(tmp_path / "a_new")
    page = open_page(serve(tmp_path, "--no-play"), "#/runs?sort=verdict")
    for word in ("works", "collapsed", "early"):
        page.locator("td[data-label=verdict]", has_text=word).wait_for()
    assert page.locator("tbody tr td[data-label=verdict]").all_inner_texts() == ["✗ collapsed", "? early", "✓ works"]
    assert "training collapsed" in (page.locator("a.word").first.get_attribute("title") or "")
    page.get_by_role("button", name="verdict").click()
    assert "sort=-verdict" in page.url
    page.locator("a.word", has_text="works").click()
    page.locator(".verdict h2", has_text="Yes: it learned").wait_for()


def test_the_curriculum_opens_where_it_is_known_what_was_learned(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    write_learning(tmp_path / "a", refreshes=3)
    page = open_page(serve(tmp_path, "--no-play"), "#/run/a/curriculum")
    page.get_by_text("It is the newest whose learning is known. The newest of all is").wait_for()
    assert page.get_by_label("refresh", exact=True).input_value() == "16"
    assert "when they were chosen" in page.locator('[data-panel^="What was learned"]').inner_text()
    page.get_by_role("button", name="refresh 32").click()
    missing = page.locator('[data-panel^="What was learned"] .missing')
    missing.wait_for()
    assert missing.inner_text().startswith(
        "Not known: the run ended before the refresh that would have played buffer 32"
    )
    assert "version" not in page.locator("main").inner_text()


@pytest.mark.parametrize("width", [1600, 390])
def test_a_collapse_is_the_first_line_of_the_page(
    tmp_path: Path, open_page: OpenPage, serve: Serve, width: int
) -> None:
    write_collapsed(tmp_path / "a", refreshes=2)
    page = open_page(
        serve(tmp_path, "--no-play"), "#/run/a/overview", viewport={"width": width, "height": 844}, color_scheme="dark"
    )
    heading = page.locator(".verdict h2")
    heading.get_by_text("No: training collapsed").wait_for()
    assert heading.bounding_box()["y"] < 300
    assert page.locator('[data-statement="stability"] .mark').get_attribute("aria-label") == "needs a look"
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width


def test_a_run_that_has_just_begun_says_when_its_first_buffer_is_expected(
    tmp_path: Path, open_page: OpenPage, serve: Serve
) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "plr"})
    write_state(run, "running", "compiling", None)
    page = open_page(serve(tmp_path), "#/run/a/overview")
    page.get_by_text("Too early to tell: no update is done. The run is compiling.").wait_for()
    for name in ("Curriculum", "Levels"):
        page.get_by_role("link", name=name, exact=True).click()
        page.locator("main > .missing", has_text="First buffer expected after update 2 (with the first").wait_for()
        assert "older version" not in page.locator("main").inner_text()
