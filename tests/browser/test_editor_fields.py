"""The panels of the editor: roles and values of several elements, units, names in warnings, who plays and who tries."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level_data import levels_root
from tests.browser.test_editor import Bench

COMPILE_MS = 180_000  # until play starts: the worker compiles behind everything else
USUAL = """async () => {
  const { fieldsOf } = await moduleOf("editor/fields.js");
  const elements = { shapes: { type: "box" }, joints: { type: "revolute", motor: {} }, thrusters: {} };
  const all = Object.entries(elements).flatMap(([part, element]) => fieldsOf(part, element, []));
  return Object.fromEntries(all.filter(({ usual }) => usual).map(({ name, usual }) => [name, usual]));
}"""
SNAP = """async ([document, walls, at, px]) => {
  const { snapped, snapTargets } = await moduleOf("editor/snap.js");
  return snapped(at, snapTargets(document, walls, at), px).point;
}"""


@pytest.fixture
def editing(open_page: Callable[..., Any], serve: Callable[..., Any]) -> Callable[..., Bench]:
    def edit(given: Path | str, **options: Any) -> Bench:
        return Bench(open_page(serve(given, name="edit"), "#/edit", **options))

    return edit


def saved(bench: Bench, file: Path) -> dict[str, Any]:
    bench.save(file.name)
    bench.page.get_by_role("button", name="save", exact=True).wait_for()  # the note may be that of the time before
    return dict(json.loads(file.read_text()))


def two_boxes(bench: Bench) -> None:
    """box_1 to the left, box_2 to the right, which is selected."""
    for x in (1.0, 3.0):
        bench.use("Box")
        bench.drag((x, 1.0), (x + 0.6, 1.4))
    bench.drawn()


def test_a_role_of_the_panel_is_taken_over_as_by_the_buttons(editing: Callable[..., Bench], tmp_path: Path) -> None:
    bench = editing(tmp_path / "mine.json")
    page = bench.page
    two_boxes(bench)
    bench.field("role", "blue")
    page.get_by_role("button", name="box_1").click()
    bench.field("role", "blue")
    page.locator(".note", has_text="box_2 has no role now").wait_for()
    page.get_by_role("button", name="floor").click()
    bench.field("role", "red")  # any number of shapes are red
    page.get_by_role("button", name="box_2").click()
    bench.field("role", "red")
    written = saved(bench, tmp_path / "mine.json")
    assert [shape.get("role") for shape in written["shapes"]] == ["blue", "red"]
    assert written["walls"] == {"floor": {"role": "red"}}
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Undo").click()  # the role and what it was taken from are one step
    page.get_by_role("button", name="box_2 (blue)").wait_for()

    page.get_by_role("button", name="box_1").click(modifiers=["Shift"])
    bench.field("role", "green")
    page.locator(".note", has_text="one shape of a level is green").wait_for()
    assert page.locator("[data-panel=selection]").get_by_label("role").input_value() == "mixed"


def test_of_several_values_only_what_is_changed_is_written(editing: Callable[..., Bench], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    bench = editing(file)
    page, panel = bench.page, bench.page.locator("[data-panel=selection]")
    two_boxes(bench)
    for name, value in (("density", "2"), ("velocity 1", "1"), ("velocity 2", "0.5")):
        bench.field(name, value)
    panel.get_by_label("fixed").check()
    page.get_by_role("button", name="box_1").click(modifiers=["Shift"])
    page.get_by_role("heading", name="2 elements").wait_for()
    before = saved(bench, file)

    density, fixed = panel.get_by_label("density"), panel.get_by_label("fixed")
    assert density.input_value() == "" and density.get_attribute("placeholder") == "mixed"
    assert fixed.evaluate("(box) => box.indeterminate") and not fixed.is_checked()
    assert panel.get_by_label("width").input_value() == "0.6"  # they share it
    for field in ("density", "velocity 1"):  # through a field without a value: nothing was typed
        panel.get_by_label(field).press("Enter")
        panel.get_by_label(field).press("Tab")
    assert saved(bench, file) == before

    bench.field("velocity 2", "3")
    bench.field("friction", "0.5")
    shapes = saved(bench, file)["shapes"]
    assert [shape["velocity"] for shape in shapes] == [[0, 3], [1, 3]]
    assert [shape.get("density") for shape in shapes] == [None, 2] and [s["friction"] for s in shapes] == [0.5, 0.5]
    bench.drawn()
    fixed.check()
    bench.field("density", "4")
    shapes = saved(bench, file)["shapes"]
    assert [(shape["fixed"], shape["density"]) for shape in shapes] == [(True, 4), (True, 4)]
    page.get_by_label("Fixed, or free to move").click()
    assert [shape.get("fixed") for shape in saved(bench, file)["shapes"]] == [None, None]


def test_motors_of_two_joints_get_one_power(editing: Callable[..., Bench], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_bytes((levels_root() / "m" / "ramp_car.json").read_bytes())
    bench = editing(file)
    panel = bench.page.locator("[data-panel=selection]")
    joints = bench.page.locator("[data-panel=elements] button", has_text="revolute")
    joints.nth(0).click()
    bench.field("motor speed", "-2")
    joints.nth(1).click(modifiers=["Shift"])
    bench.drawn()
    assert panel.get_by_label("motor speed").get_attribute("placeholder") == "mixed"
    assert "×900 rad/s²" in panel.inner_text() and panel.get_by_label("density").count() == 0
    bench.field("motor power", "0.25")
    motors = [joint["motor"] for joint in saved(bench, file)["joints"]]
    assert [motor["power"] for motor in motors] == [0.25, 0.25] and motors[0]["speed"] != motors[1]["speed"]


def test_units_and_usual_values_are_those_of_levels(editing: Callable[..., Bench], tmp_path: Path) -> None:
    """Usual: nine tenths of what the designed levels have, and what random levels are drawn with."""
    bench = editing(tmp_path / "mine.json")
    page = bench.page
    usual = page.evaluate(USUAL)
    documents = [json.loads(file.read_text()) for file in levels_root().glob("[sml]/*.json")]
    motors = [joint["motor"] for level in documents for joint in level.get("joints", []) if "motor" in joint]
    thrusters = [thruster for level in documents for thruster in level.get("thrusters", [])]
    found = {
        "motor.speed": [abs(motor.get("speed", 1)) for motor in motors],
        "motor.power": [motor.get("power", 1) for motor in motors],
        "power": [thruster.get("power", 1) for thruster in thrusters],
        **{
            name: [shape.get(name, missing) for level in documents for shape in level["shapes"]]
            for name, missing in (("density", 1), ("friction", 1), ("restitution", 0))
        },
    }
    assert usual.keys() == found.keys()
    for name, values in found.items():
        low, high = usual[name]
        inside = np.mean([low <= value <= high for value in values])
        assert inside >= 0.9, (name, inside)
    config = GeneratorConfig()
    assert usual["motor.speed"] == [config.motor_speed_min, config.motor_speed_max]
    assert usual["motor.power"][1] == config.motor_power_max

    two_boxes(bench)
    bench.use("Thruster")
    bench.click(3.3, 1.2)
    bench.field("power", "0.5")
    bench.checked()
    words = page.locator("[data-push]").inner_text()
    assert words == "It pushes with up to 5 N."  # masses are known of a level without problems
    page.get_by_role("button", name="box_1").click()
    page.get_by_label("Role blue").click()
    page.get_by_role("button", name="box_2").first.click()
    page.get_by_label("Role green").click()
    assert "Valid" in bench.checked()
    page.get_by_role("button", name="thruster of box_2").click()
    bench.drawn()
    assert page.locator("[data-push]").inner_text() == "It pushes with up to 5 N; box_2 weighs 2.4 N."  # 0.24 kg x 9.81
    title = page.locator("[data-panel=selection] .field", has_text="power").get_attribute("title")
    assert title == "power, ×10 N; usual 0.04 to 1; 1 if left out"


def test_warnings_and_problems_name_shapes_and_lead_to_them(editing: Callable[..., Bench], tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    level = json.loads((levels_root() / "m" / "ramp_car.json").read_text())
    chassis = next(shape for shape in level["shapes"] if shape["id"] == "chassis")
    level["shapes"].append({"id": "brick", "type": "box", "width": 0.3, "height": 0.3, "position": chassis["position"]})
    file.write_text(json.dumps(level | {"size": "l"}))
    bench = editing(file)
    page, panel = bench.page, bench.page.locator("[data-panel=problems]")
    bench.use("Circle")  # whatever tool is in use
    said = bench.checked()
    assert "chassis (green box) and brick (box) overlap" in said and "[" not in said
    panel.locator(".warning", has_text="brick (box) overlap").click()
    page.get_by_role("heading", name="2 elements").wait_for()
    pressed = page.locator("[data-panel=elements] button[aria-pressed=true]").all_inner_texts()
    assert [text.split(")")[0] for text in pressed] == ["chassis (green box", "brick (box"]
    page.get_by_role("toolbar").get_by_label("Select", exact=True).and_(page.locator("[aria-pressed=true]")).wait_for()

    page.get_by_role("button", name="brick (box)", exact=False).last.click()
    bench.field("restitution", "7")
    said = bench.checked()
    assert "restitution of brick (box): " in said and "shapes[" not in said
    page.get_by_label("the level").press("Escape")
    panel.locator(".problem").click()
    page.get_by_role("heading", name="brick (box)").wait_for()

    two_greens = level | {"shapes": [shape | {"role": "green"} for shape in level["shapes"][:2]], "joints": []}
    page.get_by_role("tab", name="gallery").click()
    page.get_by_label("link or text of a level").fill(json.dumps(two_greens))
    page.locator("[data-panel=elements]").wait_for()
    bench.checked()
    panel.locator(".problem", has_text="2 shapes are green").click()
    page.get_by_role("heading", name="2 elements").wait_for()


def test_a_pointer_snaps_to_what_is_nearest_to_it(editing: Callable[..., Bench], tmp_path: Path) -> None:
    page = editing(tmp_path / "mine.json").page
    walls = page.evaluate("async () => (await (await fetch('api/engine')).json()).walls")
    far = {"id": "a", "type": "box", "width": 0.2, "height": 0.2, "position": [4.0, 0.522]}  # its lower edge: 0.422
    near = {"id": "b", "type": "box", "width": 0.2, "height": 0.2, "position": [1.013, 2.0]}
    level = {"shapes": [far, near], "joints": []}

    def snapped(x: float, y: float) -> list[float]:
        return list(page.evaluate(SNAP, [level, walls, [x, y], 0.008]))

    assert snapped(2.2, 0.418) == [2.2, 0.4]  # the floor is below the pointer, the box, 4 mm nearer in height, far off
    assert snapped(2.2, 0.46) == [2.2, pytest.approx(0.422)]  # in line with the box, out of reach of the floor
    assert snapped(1.02, 2.95) == [pytest.approx(1.013), 3.0]
    assert snapped(1.05, 2.05) == pytest.approx([1.013, 2.0])  # its centre
    assert snapped(0.96, 1.0) == [1.0, 1.0]  # 4 cm from the grid, 5.3 from the line


def test_a_joint_takes_the_two_shapes_that_are_nearest(editing: Callable[..., Bench], tmp_path: Path) -> None:
    """A post that stands on the floor touches it in a line of no height."""
    file = tmp_path / "mine.json"
    bench = editing(file)
    bench.use("Box")
    bench.drag((1.0, 0.4), (1.3, 1.4))
    bench.use("Circle")
    bench.drag((1.2, 3.0), (1.4, 3.0))
    for y in (0.42, 0.38):  # above and below the line
        bench.use("Revolute")
        bench.click(1.15, y)
        bench.page.get_by_role("heading", name="revolute floor - box_1").wait_for()
        bench.page.get_by_role("button", name="Undo").click()
    bench.use("Revolute")
    bench.click(1.15, 0.42)
    [joint] = saved(bench, file)["joints"]
    assert (joint["a"], joint["b"], joint["anchor"]) == ("floor", "box_1", [1.15, 0.4])
    bench.click(1.15, 0.8)  # in the middle of the post nothing else is near
    bench.page.locator(".note", has_text="only one shape here").wait_for()


def test_why_a_level_cannot_be_played_is_shown_until_it_changes(editing: Callable[..., Bench], tmp_path: Path) -> None:
    bench = editing(tmp_path / "mine.json")
    page = bench.page
    page.get_by_label("the level").press("Space")
    page.get_by_role("alert").filter(has_text="0 shapes are green").wait_for()
    bench.use("Box")
    bench.click(1.0, 1.0)
    page.get_by_role("alert").wait_for(state="detached")
    page.locator(".note", has_text="drag from corner to corner").wait_for()


def test_the_page_says_who_plays_and_another_takes_over(editing: Callable[..., Bench]) -> None:
    page = editing("s/hop_home").page
    choice, state = page.get_by_label("who plays"), page.locator(".play-state")
    choice.select_option("random")
    page.get_by_role("button", name="play", exact=False).first.click()
    state.filter(has_text="random actions · step").wait_for(timeout=COMPILE_MS)
    page.get_by_label("speed").select_option("0.125")
    page.get_by_role("button", name="take over").click()
    state.filter(has_text="you, by keys · step").wait_for()
    assert choice.input_value() == "keys"
    choice.select_option("noop")  # from the start
    state.filter(has_text="no actions · step").wait_for()
    page.get_by_role("button", name="stop").click()
    assert choice.input_value() == "noop"


def test_the_page_says_that_a_proof_plays_while_a_person_is_chosen(editing: Callable[..., Bench]) -> None:
    """`solve it` plays what it found; its result is given here, without a search."""
    level = json.loads((levels_root() / "s" / "hop_home.json").read_text())
    proof = {"steps": 9, "method": "random", "robustness": None, "actions": [[0, 0, 0, 0, 1, 0]] * 9}
    job = {"number": 1, "kind": "solve", "state": "done", "document": level, "text": "solved", "proof": proof}
    job |= {"before": None, "after": None, "run": None, "files": {}, "elapsed": 1, "command": "", "advice": ""}
    page = editing("s/hop_home").page
    page.route("**/api/teaching", lambda route: route.fulfill(json={"results": "", "seconds": [60], "job": job}))
    page.reload()
    page.get_by_role("button", name="play the proof").click()
    page.locator(".play-state", has_text="the proof · step").wait_for(timeout=COMPILE_MS)
    choice = page.get_by_label("who plays")
    assert choice.input_value() == "actions"
    page.get_by_role("button", name="stop").click()
    page.locator(".play-state").wait_for(state="detached")
    assert choice.input_value() == "keys"


def test_the_distance_is_that_of_edges_and_a_touch_solves(editing: Callable[..., Bench], tmp_path: Path) -> None:
    circle = {"type": "circle", "radius": 0.2}
    goal = circle | {"id": "goal", "position": [2.0, 1.0], "role": "blue", "fixed": True}
    ball = circle | {"id": "ball", "position": [2.0, 2.0], "role": "green"}
    file = tmp_path / "fall.json"
    shapes = {"shapes": [goal, ball], "thrusters": [{"shape": "ball", "angle": 1.5708, "power": 0.1}]}
    file.write_text(json.dumps({"format": "kinetix-dist-level", "version": 1, "name": "fall", "size": "s", **shapes}))
    bench = editing(file)
    page, state = bench.page, bench.page.locator(".play-state")
    page.keyboard.press("Space")
    state.wait_for(timeout=COMPILE_MS)
    page.get_by_role("button", name="from the start").click()
    page.locator(".play-state[data-outcome=solved]", has_text="green touched blue").wait_for()
    page.get_by_label("step", exact=True).fill("0")
    state.filter(has_text="green is 0.60 m from blue").wait_for()  # 1 m, less both radii


def test_attempts_name_their_policy_and_follow_the_choice_of_who_plays(editing: Callable[..., Bench]) -> None:
    page = editing("s/hop_home").page
    attempts = page.locator("[data-panel=attempts]")
    policy = attempts.get_by_label("policy of the attempts")
    assert policy.input_value() == "checkpoint:generalist"  # the bundled one, where a person plays
    page.get_by_label("who plays").select_option("random")
    assert policy.input_value() == "random"
    policy.select_option("noop")
    attempts.get_by_role("button", name="play 64 times").click()
    attempts.get_by_text("no actions: p ").wait_for(timeout=COMPILE_MS)
    policy.select_option("random")  # what was played stays named
    assert "no actions: p " in attempts.inner_text()
