"""The Python of docs/engine.md runs as one program from top to bottom, and its comments are true."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from jax2d import EFFECTS, effects_of
from kinetix_dist.level.level import SIZES
from tests.helpers import REPOSITORY

PAGE = (REPOSITORY / "docs/engine.md").read_text()
MILLION = "num_worlds = 1_000_000"


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Names that the blocks leave, run in order in one namespace, in a folder for the files that they write."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert sum(MILLION in code for code in blocks) == 1
    names: dict = {"__name__": "engine_page"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("engine_page"))
        for number, code in enumerate(blocks):
            exec(compile(code.replace(MILLION, "num_worlds = 64"), f"docs/engine.md, block {number}", "exec"), names)
        names["film"] = Path("run.gif").read_bytes()
    return names


def test_the_ball_falls_and_touches_the_floor(names: dict) -> None:
    ball, floor = names["ball"], names["floor"]
    assert names["touches"][:, floor, ball].all()
    assert names["highest"].shape == (60,) and int(names["overflow"].sum()) == 0
    assert np.asarray(names["ends"].position)[:, ball, 1] == pytest.approx(0.1, abs=0.01)  # 64 worlds at rest


def test_the_recording_is_a_film_and_the_policy_hovers(names: dict) -> None:
    assert names["trajectory"].position.shape == (301, 3, 2, 2)
    assert names["film"].startswith(b"GIF")
    assert names["hovering"].position[-100:, :, names["ball"], 1].max() > 0.5  # two of three lie still without it


def test_machine_springs_and_wind_do_what_is_said_of_them(names: dict) -> None:
    moved = names["moved"]
    assert float(moved.angle[names["arm"]]) == pytest.approx(0.5, abs=1e-4)
    assert float(moved.position[names["cart"], 0]) == pytest.approx(1.5, abs=1e-3)
    lengths = names["ride"].spring_lengths()[-1]
    assert lengths[[1, 3, 5]] == pytest.approx([1.3314, 1.3314, 1.5264], abs=1e-3)  # rods
    assert lengths[4] <= 1.2 + 1e-3  # the rope
    assert float(names["blown"].position[names["lift"], 1]) == pytest.approx(1.0, abs=1e-4)
    assert float(names["blown"].position[names["drone"], 0]) > 0.3
    assert len(names["tiles"]) == 40


def test_rays_meet_the_floor_and_contacts_bear_the_ball(names: dict) -> None:
    hits = names["hits"]
    assert np.asarray(hits.shape)[1:-1].tolist() == [names["floor"]] * 30
    weight = np.pi * 0.1**2 * 9.81
    assert np.asarray(names["weights"])[:, names["ball"], 1] == pytest.approx(weight, rel=1e-3)


def test_effects_are_those_of_the_scene(names: dict) -> None:
    used = {name for name in EFFECTS if getattr(names["effects"], name)}
    assert used == {
        "polygon_circle_pairs",
        "friction",
        "restitution",
        "continuous_collision",
        "thrusters",
        "gravity",
    }
    assert names["lean"].effects == effects_of(names["scene"])


def test_table_of_sizes_is_that_of_the_levels() -> None:
    rows = re.findall(r"^\| ([SML]) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", PAGE, re.MULTILINE)
    sizes = {name.upper(): (c.polygons, c.circles, c.joints, c.thrusters, c.contact_slots) for name, c in SIZES.items()}
    assert {name: tuple(map(int, numbers)) for name, *numbers in rows} == sizes


def test_table_of_presets_counts_failures_as_the_table_of_hard_scenes() -> None:
    hard = (REPOSITORY / "docs/hard_scenes.md").read_text()
    scenes = hard[hard.index("| scene | figure, at most |") :].split("\n\n", maxsplit=1)[0].splitlines()
    assert f"hard scenes failed, of {len(scenes) - 3}" in PAGE  # but for header, line and the row of failures
    failures = dict(zip(("standard", "fine", "draft", "paper"), re.findall(r"\d+", scenes[-1]), strict=True))
    for name, number in failures.items():
        [row] = re.findall(rf"^\| \**`{name}`\** ?(?:\(default\) )?\|.*", PAGE, re.MULTILINE)
        assert re.match(r"\D*(\d+)", row.split("|")[-2]).group(1) == number, row  # type: ignore[union-attr]
