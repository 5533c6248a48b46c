"""The editor's own modules, run in the browser: what it draws and writes, against what the engine draws and reads."""

from __future__ import annotations

import copy
import json
import math
import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from jax2d.display_list import display_list
from kinetix_dist.level.document import dump_document, level_to_json
from kinetix_dist.level.schema import document_info, level_from_json, turned_colours_of
from kinetix_dist.level.sets import files_of_set
from kinetix_dist.studio.worker.service import hello
from tests.helpers import REPOSITORY
from tests.studio.serving import Server, serving

FILES = [file for size in "sml" for file in files_of_set(f"all_designed_{size}")]
NEAR_M = 1e-5  # the engine's levels are float32: 5 m are known to 5e-7 m, and centroids and anchors are sums of some

DRAW = """async ([documents, engine]) => {
  const { levelPicture } = await moduleOf("world/display_list.js");
  return documents.map((document) => levelPicture(document, engine)).map(({ display, poses }) => ({ display, poses }));
}"""
WRITE = """async (texts) => {
  const { documentText } = await moduleOf("editor/document.js");
  return texts.map((text) => documentText(JSON.parse(text)));
}"""


WHEELS = """async (documents) => {
  const { wheelOf } = await moduleOf("editor/motors.js");
  return documents.map((document) => (document.joints ?? []).map((joint) => wheelOf(document, joint)));
}"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("levels"), name="edit") as server:
        yield server


def turned_and_reversed(document: dict[str, Any]) -> dict[str, Any]:
    """The same kind of level with what designed files seldom have: turned frames whose origin is no centroid, corners
    in another order, ends of joints the other way round."""
    document, draw = copy.deepcopy(document), random.Random(document["name"])
    for shape in document["shapes"]:
        shape["angle"] = draw.uniform(-3, 3)
        if shape["type"] == "polygon":
            shift, first = (draw.uniform(-1, 1), draw.uniform(-1, 1)), draw.randrange(len(shape["vertices"]))
            corners = [[x + shift[0], y + shift[1]] for x, y in shape["vertices"]]
            shape["vertices"] = corners[first:] + corners[:first]
    for joint in document.get("joints", []):
        joint["a"], joint["b"] = joint["b"], joint["a"]
        if "anchor_a" in joint:
            joint["anchor_a"], joint["anchor_b"] = joint["anchor_b"], joint["anchor_a"]
    return document


def without_limits(document: dict[str, Any]) -> dict[str, Any]:
    joints = [{name: value for name, value in joint.items() if name != "limits"} for joint in document["joints"]]
    return document | {"joints": joints}


def near(found: Any, expected: Any, where: str) -> int:
    """Compares two JSON values number by number; how many numbers there are."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
        return sum(near(found[key], expected[key], f"{where}.{key}") for key in expected)
    if isinstance(expected, list | tuple):
        assert len(found) == len(expected), where
        return sum(near(a, b, f"{where}[{k}]") for k, (a, b) in enumerate(zip(found, expected, strict=True)))
    if isinstance(expected, bool | str):
        assert found == expected, where
        return 0
    # An axis of pi and one of -pi are one direction.
    gap = abs(found - expected)
    assert min(gap, abs(gap - 2 * math.pi) if where.endswith(".angle") else gap) < NEAR_M, (where, found, expected)
    return 1


def test_the_editors_display_list_is_that_of_the_engine_number_by_number(
    server: Server, open_page: Callable[..., Any]
) -> None:
    originals = [json.loads(file.read_text()) for file in FILES]
    # Every level in the format's normal form too, which has polygons, local anchors and rest angles everywhere.
    written = [level_to_json(level_from_json(document), document_info(document)) for document in originals]
    sliders = [document for document in written if any(joint["type"] == "prismatic" for joint in document["joints"])]
    documents = [*originals, *written, *map(turned_and_reversed, written), *map(without_limits, sliders)]
    page = open_page(server, "#/edit")
    pictures = page.evaluate(DRAW, [documents, json.loads(json.dumps(hello()))])
    numbers, kinds = 0, set()
    for document, picture in zip(documents, pictures, strict=True):
        try:
            level = level_from_json(document)
        except ValueError as error:  # ends of a joint that were turned apart: no level has them
            assert "apart" in str(error), error
            continue
        expected = display_list(
            level.scene,
            level.shape_role,
            motor_colours=level.motor_colour,
            thruster_colours=level.thruster_colour,
        ).to_json()
        numbers += near(picture["display"], expected, document["name"])
        poses = np.concatenate([level.position, level.angle[:, None]], axis=1)
        shown = level.scene.shapes.active
        drawn = np.reshape(picture["poses"], (-1, 3))
        assert drawn.shape == poses.shape
        numbers += near(drawn[shown].tolist(), poses[shown].tolist(), f"{document['name']} poses")
        kinds |= {(entry["kind"], entry["part"][0]) for entry in expected["primitives"]}
    assert numbers > 20_000 and ("rail", "joint") in kinds


def test_files_are_written_as_the_engine_writes_them(server: Server, open_page: Callable[..., Any]) -> None:
    """And nothing of a designed level changes by being read and written."""
    texts = [file.read_text() for file in FILES]
    for text, written in zip(texts, open_page(server, "#/edit").evaluate(WRITE, texts), strict=True):
        assert json.loads(written) == json.loads(text)
        assert written == dump_document(json.loads(text, parse_float=shortest))  # JSON of scripts writes 1.0 as 1


def shortest(number: str) -> float | int:
    value = float(number)
    return int(value) if value.is_integer() else value


GESTURES = """async ([start, engine, count, seed]) => {
  const from = (name) => moduleOf(`editor/${name}.js`);
  const [{ Editor }, { TOOLS }, { COMMANDS }, { documentText }] = await Promise.all(
    ["state", "tools", "commands", "document"].map(from));
  let state = seed;
  const draw = () => ((state = (Math.imul(state, 1664525) + 1013904223) >>> 0) / 2 ** 32);
  const pick = (list) => list[Math.floor(draw() * list.length)];
  const editor = new Editor(engine);
  editor.open(start);
  editor.history.past = [];
  const now = () => documentText(editor.document);
  const steps = [now()];
  const used = {};
  const commands = COMMANDS.filter(({ label }) => !["Undo", "Redo"].includes(label));
  for (let k = 0; k < count; k++) {
    if (draw() < 0.3) {
      const command = pick(commands);
      if (command.label === "Delete" && draw() < 0.7) continue; // or there is nothing left soon
      command.run(editor, pick(command.keys));
      used[command.label] = true;
    } else {
      const name = draw() < 0.5 ? "select" : pick(Object.keys(TOOLS));
      editor.use(name);
      const at = () => [5 * draw(), 5 * draw()];
      const pointer = () => ({ at: at(), px: 0.01, thick: 1, add: draw() < 0.2, free: draw() < 0.3 });
      const shape = pick(editor.document.shapes);
      const first = { ...pointer(), ...(shape && draw() < 0.7 ? { at: [...shape.position] } : {}) };
      const gesture = TOOLS[name].down(editor, first);
      const moves = Math.floor(4 * draw());
      let last = first;
      for (let m = 0; m < moves; m++) gesture?.move((last = pointer()));
      if (draw() < 0.05) editor.cancel();
      else gesture?.up(last);
      used[name] = true;
    }
    if (now() !== steps.at(-1)) steps.push(now());
  }
  const shown = [];
  while (editor.history.past.length) { editor.undo(); shown.push(now()); }
  const undone = shown.map((text, k) => text === steps[steps.length - 2 - k]);
  const redone = [];
  while (editor.history.future.length) { editor.redo(); redone.push(now() === steps[redone.length + 1]); }
  const [first, last] = [shown.at(-1) === documentText(start), now() === steps.at(-1)];
  return { first, last, steps: steps.length - 1, undone, redone, used: Object.keys(used) };
}"""


def test_500_random_gestures_are_undone_to_the_first_byte_and_redone(
    server: Server, open_page: Callable[..., Any]
) -> None:
    page = open_page(server, "#/edit")
    start = json.loads((REPOSITORY / "levels" / "l" / "walker.json").read_text())
    for seed in (1, 2):
        done = page.evaluate(GESTURES, [start, json.loads(json.dumps(hello())), 500, seed])
        assert done["first"] and done["last"] and all(done["undone"]) and all(done["redone"]), done
        assert len(done["undone"]) == len(done["redone"]) == done["steps"] > 150 and len(done["used"]) > 30, done


def test_a_wheel_is_what_the_engine_takes_for_one(server: Server, open_page: Callable[..., Any]) -> None:
    """Colours are turned round where all of their wheels have negative speeds: the editor's wheels give the same."""
    drawn = [json.loads(file.read_text()) for file in FILES]
    documents = drawn + [turned_and_reversed(document) for document in drawn]
    num_turned = 0
    for document, wheels in zip(documents, open_page(server, "#/edit").evaluate(WHEELS, documents), strict=True):
        speeds: dict[int, list[float]] = {}
        for joint, wheel in zip(document.get("joints", []), wheels, strict=True):
            motor = joint.get("motor", {"on": False})
            if wheel is not None and motor.get("on", True) and not motor.get("auto", False):
                speed = motor.get("speed", 1.0)
                speeds.setdefault(motor.get("colour", 0), []).append(speed if wheel == "b" else -speed)
        expected = [colour in speeds and max(speeds[colour]) < 0 for colour in range(4)]
        assert turned_colours_of(document).tolist() == expected, document["name"]
        num_turned += sum(expected)
    assert num_turned > 10
