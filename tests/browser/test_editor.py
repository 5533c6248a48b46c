"""The editor in a real browser: levels built by mouse and by touch, played by keys, saved, and nothing lost."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.level.document import level_to_json
from kinetix_dist.level.fit import capacity_of_size, fit_level
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import files_of_set, read_public_level
from tests.helpers import REPOSITORY, python_path
from tests.studio.serving import Server

OpenPage = Callable[..., Any]
VIEW_M = 5.5  # WHOLE_VIEW of state.js: along the shorter side of the picture, about (2.5, 2.5)
LATE_PICTURES = """{
  const real = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (act) => setTimeout(() => real(act), 200);
}"""
LATE_FILES = """{
  const real = window.fetch.bind(window);
  window.fetch = async (address, options) => {
    if (String(address).includes("api/files")) await new Promise((done) => setTimeout(done, 2000));
    return real(address, options);
  };
}"""
HAS_DRAFT = """(name) => localStorage.getItem("kinetix-dist draft")?.includes(name)"""
DESIGNED = [file for size in "sml" for file in files_of_set(f"all_designed_{size}")]


class Bench:
    """An editor page, its mouse in metres of the level."""

    def __init__(self, page: Any) -> None:
        self.page = page
        page.wait_for_selector(".editor-canvas")
        self.box = page.locator(".editor-canvas").bounding_box()

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        scale = min(self.box["width"], self.box["height"]) / VIEW_M
        middle = self.box["x"] + self.box["width"] / 2, self.box["y"] + self.box["height"] / 2
        return middle[0] + (x - 2.5) * scale, middle[1] - (y - 2.5) * scale

    def click(self, x: float, y: float, **options: Any) -> None:
        self.page.mouse.click(*self.pixel(x, y), **options)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*self.pixel(*start))
        mouse.down()
        mouse.move(*self.pixel((start[0] + end[0]) / 2, (start[1] + end[1]) / 2))
        mouse.move(*self.pixel(*end))
        mouse.up()

    def use(self, tool: str) -> None:
        self.page.get_by_role("toolbar").get_by_label(tool, exact=True).click()

    def drawn(self) -> None:
        """Waits until the panels show what the last gesture led to: they are drawn with the next picture, and until
        then have what was selected before, which a person sees and a test does not."""
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))")

    def field(self, name: str, value: str) -> None:
        self.drawn()
        entry = self.page.locator("[data-panel=selection]").get_by_label(name, exact=True)
        if entry.evaluate("(element) => element.tagName") == "SELECT":
            entry.select_option(value)
        else:
            entry.fill(value)
            entry.press("Enter")

    def checked(self) -> str:
        """Result of the validator for the level as it is now."""
        self.drawn()
        self.page.wait_for_selector("[data-panel=problems][data-checked=true]")
        return self.page.locator("[data-panel=problems]").inner_text()

    def save(self, name: str) -> None:
        self.page.get_by_role("button", name="save").click()
        self.page.get_by_text(f"saved to {name}").wait_for()


@pytest.fixture
def editing(open_page: OpenPage, serve: Callable[..., Server]) -> Callable[..., tuple[Bench, Server]]:
    def edit(given: Path | str, **options: Any) -> tuple[Bench, Server]:
        server = serve(given, name="edit")
        return Bench(open_page(server, "#/edit", **options)), server

    return edit


def build_car(bench: Bench, *, motor_speed: str | None = None) -> None:
    """A car on two wheels, and a goal to drive to. motor_speed: typed for each motor; None: as it is drawn."""
    page = bench.page
    bench.use("Box")
    bench.drag((0.4, 0.6), (1.6, 0.8))  # chassis
    bench.field("role", "green")
    bench.use("Circle")
    bench.drag((0.6, 0.6), (0.8, 0.6))
    bench.drag((1.4, 0.6), (1.6, 0.6))
    bench.use("Revolute")
    for x in (0.6, 1.4):
        bench.click(x, 0.62)
        if motor_speed is not None:
            bench.field("motor speed", motor_speed)
    bench.use("Circle")
    bench.drag((4.0, 0.8), (4.4, 0.8))
    bench.field("role", "blue")
    bench.drawn()
    page.locator("[data-panel=selection]").get_by_label("fixed").check()
    assert "Valid" in bench.checked()
    page.get_by_label("the level").press("Escape")


def test_a_level_is_built_by_mouse_solved_by_keys_and_saved(editing: Callable[..., Any], tmp_path: Path) -> None:
    bench, _ = editing(tmp_path / "mine.json")
    page = bench.page
    assert "green" in bench.checked()  # a level needs one green and one blue shape
    build_car(bench)
    page.locator("[data-panel=elements]").get_by_text("revolute").first.click()
    said = "Forward (→) rolls the wheel to the right. With the wheel as b, negative speeds roll to the right."
    page.locator("[data-forward]", has_text=said).wait_for()
    page.get_by_label("the level").press("Escape")
    page.keyboard.press("Space")
    page.keyboard.down("ArrowRight")  # held from the first step on, also where that takes a while to be compiled
    page.wait_for_selector(".play-state[data-outcome=solved]")
    page.keyboard.up("ArrowRight")
    page.keyboard.press("Escape")

    bench.save("mine.json")
    level, info = load_level(tmp_path / "mine.json")
    assert info.name == "mine" and int(level.scene.joints.motor_on.sum()) == 2
    document = json.loads((tmp_path / "mine.json").read_text())
    assert [shape["type"] for shape in document["shapes"]] == ["box", "circle", "circle", "circle"]
    assert document["shapes"][0]["width"] == 1.2 and document["joints"][0]["anchor"] == [0.6, 0.6]


def test_a_level_is_built_while_pictures_come_late(editing: Callable[..., Any], tmp_path: Path) -> None:
    """Simulates a busy machine: a person who is faster than the page changes what is selected, not what was."""
    bench, _ = editing(tmp_path / "mine.json")
    bench.page.context.add_init_script(LATE_PICTURES)
    bench.page.reload()
    bench = Bench(bench.page)
    build_car(bench, motor_speed="-2")
    bench.save("mine.json")
    document = json.loads((tmp_path / "mine.json").read_text())
    assert [joint["motor"]["speed"] for joint in document["joints"]] == [-2, -2]


@pytest.mark.long
def test_a_level_that_comes_late_replaces_nothing_that_was_done(editing: Callable[..., Any], tmp_path: Path) -> None:
    """Drawing and drafts wait for the level that the command line named."""
    bench, server = editing(tmp_path / "mine.json")
    page = bench.page
    page.context.add_init_script(LATE_FILES)
    page.reload()
    page.get_by_text("the level is opened ...").wait_for()
    bench = Bench(page)
    bench.use("Box")
    bench.drag((0.4, 0.6), (1.6, 0.8))
    page.wait_for_function(HAS_DRAFT, arg="box_1")

    again = page.context.new_page()
    again.goto(f"http://127.0.0.1:{server.port}/#/edit")
    again.get_by_role("button", name="bring it back").click()
    again.get_by_role("button", name="box_1").wait_for()
    again.wait_for_timeout(2500)  # longer than a file takes
    assert again.get_by_role("button", name="box_1").count() == 1


def test_levels_play_plays_at_once_and_stops_for_editing(open_page: OpenPage, serve: Callable[..., Server]) -> None:
    page = open_page(serve("s/hop_home", "--policy", "random", name="levels play"), "#/edit")
    page.wait_for_function(
        "() => Number(/step (\\d+) of/.exec(document.querySelector('.play-state')?.textContent)?.[1]) > 10",
        timeout=180_000,  # the engine starts and compiles first, below everything else that a machine does
    )
    assert page.get_by_label("who plays").input_value() == "random"
    page.get_by_role("button", name="stop").click()
    page.wait_for_selector(".play-state", state="detached")
    page.wait_for_timeout(500)
    assert page.locator(".play-state").count() == 0 and "hop_home" in page.title()  # it does not start again


@pytest.mark.slow  # a minute of training
def test_a_level_that_was_built_is_validated_and_trained_on(editing: Callable[..., Any], tmp_path: Path) -> None:
    """Random actions solve it about two times in three, the policy always."""
    file, run = tmp_path / "mine.json", tmp_path / "run"
    bench, _ = editing(file)
    build_car(bench)
    bench.save("mine.json")

    def command(*arguments: str) -> None:
        program = [sys.executable, "-m", "kinetix_dist.cli.main", *arguments]
        environment = os.environ | {"PYTHONPATH": python_path()}
        done = subprocess.run(program, capture_output=True, text=True, timeout=600, check=False, env=environment)
        assert done.returncode == 0, done.stderr

    command("levels", "validate", str(file))
    command(
        "train", "--recipe", "single_level", "--env.size", "m", "--curriculum.levels", str(file), "--run", str(run),
        "--evaluation.sets", str(file), "--run.total_env_steps", "40000", "--recording.make_pictures", "False",
    )  # fmt: skip
    rates = json.loads((run / "report.json").read_text())["solve_rate"]
    assert rates["after"][str(file)]["low"] > rates["random_policy"][str(file)]["high"], rates


def test_every_designed_level_is_opened_and_saved_unchanged(editing: Callable[..., Any], tmp_path: Path) -> None:
    for file in DESIGNED:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    bench, server = editing(tmp_path)
    page = bench.page
    save = """async (names) => {
      const from = (name) => moduleOf(`editor/${name}.js`);
      const [{ Editor }, { openFile, saveFile }] = await Promise.all(["state", "files"].map(from));
      const engine = await (await fetch("api/engine")).json();
      for (const name of names) {
        const editor = new Editor(engine);
        await openFile(editor, name);
        if (editor.isUnsaved) throw new Error(`${name} is not as it was opened`);
        await saveFile(editor, name);
        if (editor.note !== `saved to ${name}`) throw new Error(editor.note);
      }
    }"""
    page.evaluate(save, [file.name for file in DESIGNED])
    for file in DESIGNED:
        assert json.loads((tmp_path / file.name).read_text()) == json.loads(file.read_text()), file
    assert len(server.json("/api/files")["files"]) == len(DESIGNED) == 74


def test_every_public_level_is_opened_and_saved_as_the_same_level(
    editing: Callable[..., Any], tmp_path: Path, public_levels: Path
) -> None:
    """Compares with the result of `kinetix-dist levels import`."""
    bench, _ = editing(tmp_path)
    files = sorted(public_levels.rglob("*.json"))
    for k, file in enumerate(files):
        save = """async ([name, text]) => {
          const from = (name) => moduleOf(`editor/${name}.js`);
          const [{ Editor }, { openText, saveFile }] = await Promise.all(["state", "files"].map(from));
          const editor = new Editor(await (await fetch("api/engine")).json());
          await openText(editor, text);
          await saveFile(editor, name);
          return editor.note;
        }"""
        assert bench.page.evaluate(save, [f"{k}.json", file.read_text()]) == f"saved to {k}.json", file
        level, info = read_public_level(file)
        written = json.loads((tmp_path / f"{k}.json").read_text())
        expected = level_to_json(fit_level(level, capacity_of_size(info.size)), info)
        assert written == expected | {"name": written["name"]}, file
    assert len(files) == 74


def test_tools_by_touch(editing: Callable[..., Any], tmp_path: Path) -> None:
    """Taps, drags and two fingers on a phone, as Chromium sends them."""
    size = {"width": 390, "height": 844}
    bench, _ = editing(tmp_path / "touched.json", viewport=size, has_touch=True, device_scale_factor=2)
    page = bench.page
    devtools = page.context.new_cdp_session(page)

    def fingers(kind: str, *points: tuple[float, float]) -> None:
        places = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(bench.pixel(*point) for point in points)]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    def stroke(*points: tuple[float, float]) -> None:
        fingers("touchStart", points[0])
        for point in points[1:]:
            fingers("touchMove", point)
        fingers("touchEnd")

    bench.use("Box")
    stroke((1.0, 1.0), (1.5, 1.2), (2.0, 1.6))
    bench.use("Circle")
    stroke((3.0, 2.0))  # a tap places one
    bench.use("Triangle")
    for corner in ((3.5, 3.0), (4.5, 3.0), (4.0, 4.0)):
        stroke(corner)
    bench.use("Quadrilateral")
    for corner in ((0.5, 3.0), (1.5, 3.0), (1.4, 4.0), (0.6, 4.0)):
        stroke(corner)
    bench.use("Fixed")
    stroke((1.9, 1.5), (2.5, 1.8), (3.0, 2.0))  # from the box to the circle
    bench.use("Thruster")
    stroke((1.2, 1.2), (1.2, 2.2))
    bench.use("Select")
    stroke((3.2, 2.13), (3.4, 2.4), (3.7, 2.63))  # next to the joint, which lies on top
    metres = "async () => document.querySelector('.editor-canvas').getBoundingClientRect().width"
    assert page.evaluate(metres) <= 390
    bench.save("touched.json")
    document = json.loads((tmp_path / "touched.json").read_text())
    assert [shape["type"] for shape in document["shapes"]] == ["box", "circle", "polygon", "polygon"]
    assert [len(shape["vertices"]) for shape in document["shapes"][2:]] == [3, 4]
    assert document["joints"] == [{"type": "fixed", "a": "circle_1", "b": "box_1", "anchor": [3.0, 2.0]}]
    [thruster] = document["thrusters"]
    assert thruster["shape"] == "box_1" and thruster["angle"] == pytest.approx(1.5708, abs=1e-4)
    assert document["shapes"][1]["position"] == [3.5, 2.5]
    # Two fingers that part show less of the level: the same tap is nearer to the middle then.
    fingers("touchStart", (2.3, 2.5), (2.7, 2.5))
    fingers("touchMove", (1.9, 2.5), (3.1, 2.5))
    fingers("touchEnd")
    bench.use("Circle")
    stroke((4.5, 2.5))
    bench.save("touched.json")
    x = json.loads((tmp_path / "touched.json").read_text())["shapes"][4]["position"][0]
    assert 2.6 < x < 4.0, x


def test_what_is_wrong_leads_to_its_shape_and_nothing_is_lost(editing: Callable[..., Any], tmp_path: Path) -> None:
    """Complaints and warnings that lead to what they are about, a file changed elsewhere, a draft after a crash."""
    file = tmp_path / "hop.json"
    original = (REPOSITORY / "levels" / "s" / "hop_home.json").read_bytes()
    file.write_bytes(original)
    bench, server = editing(file)
    page = bench.page
    selection = page.locator("[data-panel=selection]")
    assert "Valid" in bench.checked()
    for _ in range(2):
        bench.use("Box")
        bench.click(2.5, 3.5)
    assert "has room for 1" in bench.checked()
    bench.field("restitution", "7")
    assert "restitution" in bench.checked()
    page.get_by_label("the level").press("Escape")
    page.get_by_label("the level").press("Escape")
    page.locator(".problem", has_text="restitution").click()
    selection.get_by_role("heading", name="box_2").wait_for()
    page.get_by_label("the level").press("Delete")
    assert "restitution" not in bench.checked()

    file.write_bytes(original + b"\n")  # somebody else
    page.get_by_role("button", name="save").click()
    page.get_by_text("was changed elsewhere; nothing was saved.", exact=False).first.wait_for()
    assert file.read_bytes() == original + b"\n"
    page.wait_for_function(HAS_DRAFT, arg="box_1")

    again = page.context.new_page()  # the page before is left as a crash leaves it
    again.goto(f"http://127.0.0.1:{server.port}/#/edit")
    again.get_by_role("button", name="bring it back").click()
    again.get_by_role("button", name="box_1").wait_for()
    again.close()
    file.unlink()  # and then it is gone: what was agreed to was another file
    page.get_by_role("button", name="save over it").click()
    page.get_by_text("hop.json is gone; nothing was saved").wait_for()
    page.get_by_role("button", name="save it anew").click()
    page.get_by_text("saved to hop.json").wait_for()
    assert [text.split("status of ")[1][:3] for text in page.complaints] == ["412", "412"]  # Chromium reports it too
    page.complaints.clear()
    assert {shape["id"] for shape in json.loads(file.read_text())["shapes"]} >= {"box_1"}


def test_a_policy_plays_with_its_value_and_64_attempts_have_an_interval(editing: Callable[..., Any]) -> None:
    bench, _ = editing("s/hop_home")
    page = bench.page
    page.get_by_label("who plays").select_option("checkpoint:generalist")
    page.get_by_role("button", name="play", exact=False).first.click()
    mind = page.locator(".mind")
    mind.wait_for()
    page.get_by_role("button", name="one step on").click()  # and pauses, also where nothing was played yet
    page.locator(".play-state", has_text=re.compile(r"step [1-9]")).wait_for()
    page.get_by_label("step", exact=True).fill("1")
    page.locator(".play-state", has_text="step 1 of").wait_for()
    shares = [float(text.split()[-2]) for text in mind.locator(".chance").all_inner_texts()]
    bound = [text.split("\n")[0] for text in mind.locator(".heads > div").all_inner_texts()]
    assert bound == ["thruster 0"], "no colour that the level has not"
    assert len(shares) == 2 and sum(shares) == pytest.approx(100, abs=1)
    page.get_by_label("speed").select_option("0.125")  # the episode lasts a minute, so that it can be paused
    page.get_by_role("button", name="go on").click()
    page.get_by_role("button", name="pause").click()
    page.get_by_role("button", name="go on").wait_for()
    page.get_by_role("button", name="take over").click()
    page.locator(".pads").wait_for()
    page.get_by_role("button", name="edit", exact=False).last.click()

    page.get_by_label("policy of the attempts").select_option("random")
    page.get_by_role("button", name="play 64 times").click()
    page.locator("[data-panel=attempts]", has_text="of 64), 95 %").wait_for()
    assert "learnability 0." in page.locator("[data-panel=attempts]").inner_text()


@pytest.mark.long
def test_levels_come_in_and_go_out(editing: Callable[..., Any], tmp_path: Path) -> None:
    """A link holds the level; the public format comes back as the same level; what is no level is one line."""
    bench, _ = editing("m/ramp_car")
    page = bench.page
    bench.checked()
    with page.expect_download() as public:
        page.get_by_role("button", name="public format").click()
    with page.expect_download() as ours:
        page.get_by_role("button", name="download", exact=True).click()
    with page.expect_download() as picture:
        page.get_by_role("button", name="PNG").click()
    written = json.loads(Path(ours.value.path()).read_text())
    assert written == json.loads((REPOSITORY / "levels" / "m" / "ramp_car.json").read_text())
    assert Path(picture.value.path()).read_bytes()[:4] == b"\x89PNG"
    assert "env_state" in json.loads(Path(public.value.path()).read_text())
    page.get_by_role("button", name="link").click()
    page.wait_for_function("() => location.hash.includes('level=')")
    other = page.context.new_page()
    other.goto(page.url)
    other.get_by_role("button", name="chassis (green box)").wait_for()
    other.close()

    page.locator("input[type=file]").set_input_files(public.value.path())
    page.get_by_role("button", name="polygon_4 (green)").wait_for()
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="chassis (green box)").wait_for()
    for content, text in ((b"{", "is not JSON"), (b"[1]", "no JSON object"), (b"x" * 4_000_000, "too large")):
        page.locator("input[type=file]").set_input_files(
            {"name": "a.json", "mimeType": "application/json", "buffer": content}
        )
        page.locator(".note", has_text=text).wait_for()
    picture = page.get_by_label("the level")
    for key in ("Escape", "Escape", "b", "ArrowRight", "Shift+ArrowUp", "Enter"):  # a box without a mouse
        picture.press(key)
    page.get_by_role("heading", name="box_1").wait_for()
    assert page.get_by_label("position 1", exact=True).input_value() == "2.55"
    assert page.get_by_label("position 2", exact=True).input_value() == "2.505"
    picture.press("Control+z")
    assert "Valid" in bench.checked()
    page.get_by_role("button", name="new level of size").click()
    page.locator(".note", has_text="a new random level").wait_for()
    assert "Valid" in bench.checked()
    page.get_by_role("button", name="any change").click()
    page.locator(".note", has_text="change").wait_for()
