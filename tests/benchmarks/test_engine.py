"""Benchmarks of the engine: their records, and the published engine where it is installed."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from jax2d import JointDrive, JointKind
from jax2d.effects import EFFECTS, EXTENDED, effects_of
from jax2d.world_order import structure_of
from kinetix_dist.benchmarks import engine_growth
from kinetix_dist.benchmarks.effect_cases import ADDED, without
from kinetix_dist.benchmarks.engine_worlds import ORDERS, levels_of_worlds
from kinetix_dist.benchmarks.growth_report import exponent
from kinetix_dist.benchmarks.growth_scenes import SCENES
from kinetix_dist.cli.main import main
from kinetix_dist.level.sets import load_level_set
from tests.helpers import REPOSITORY

EFFECTS_OF_LEVELS = [name for name in EFFECTS if name not in ("springs", *EXTENDED)]  # levels have no room for those
FIELDS = {"engine", "backend", "preset", "size", "worlds", "order", "device", "physics_steps_per_second"}


def bench(json_file: Path, *arguments: str) -> list[dict]:
    assert main(["bench", "engine", *arguments, "--sizes", "s", "--json", str(json_file)]) == 0
    return json.loads(json_file.read_text())


@pytest.mark.long
@pytest.mark.parametrize("words", [["speed"], []], ids=["speed", "no word"])
def test_records_of_speed_have_exactly_the_documented_fields(words: list[str], tmp_path: Path) -> None:
    file = tmp_path / "new" / "bench.json"
    records = bench(file, *words, "--steps", "2", "--worlds", "2", "5", "--presets", "standard")
    assert [record["worlds"] for record in records] == [2, 5]
    for record in records:
        assert set(record) == FIELDS
        assert (record["engine"], record["size"], record["preset"], record["order"]) == (
            "ours",
            "s",
            "standard",
            "drawn",
        )
        assert record["physics_steps_per_second"] > 0


@pytest.mark.slow
def test_both_orders_are_timed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ("speed", "--steps", "2", "--worlds", "40", "--presets", "standard")
    records = bench(tmp_path / "bench.json", *arguments, "--orders", "drawn", "sorted")
    assert all(set(record) == FIELDS and record["physics_steps_per_second"] > 0 for record in records)
    found = [(record["engine"], record["order"]) for record in records]
    assert found == [("ours", "drawn"), ("ours", "sorted")]
    rows = [line for line in capsys.readouterr().out.splitlines() if "physics steps/s" in line]
    assert [row.split()[-4] for row in rows] == ["drawn", "sorted"]


def test_sorted_worlds_are_the_drawn_ones_with_like_ones_side_by_side() -> None:
    levels, names = load_level_set("designed_s")
    drawn, by_structure = (np.asarray(levels_of_worlds(levels, 3 * len(names) + 1, order)) for order in ORDERS)
    np.testing.assert_array_equal(drawn, np.arange(3 * len(names) + 1) % len(names))
    assert sorted(by_structure) == sorted(drawn) and list(by_structure) != list(drawn)
    counts = np.asarray(structure_of(levels.scene))[by_structure].tolist()
    assert counts == sorted(counts)


@pytest.mark.long
def test_growth_measures_worlds_and_shapes_and_says_what_it_left_out(tmp_path: Path) -> None:
    file = tmp_path / "growth.json"
    one, three, *shapes = bench(
        file, "growth", "--worlds", "1", "3", "--shapes", "4", "--point-seconds", "1e-9", "--order", "sorted"
    )
    fields = {field.name for field in dataclasses.fields(engine_growth.Point)}
    assert all(set(record) == fields for record in (one, three, *shapes))
    assert (one["swept"], one["size"], one["worlds"], one["left_out"]) == ("worlds", "s", 1, None)
    assert all(record["order"] == "sorted" for record in (one, three, *shapes))
    assert one["physics_steps_per_second"] == pytest.approx(1e6 / one["us_per_world_step"], abs=0.1)
    assert (three["worlds"], three["us_per_world_step"]) == (3, None)
    assert "--point-seconds" in three["left_out"]
    assert [record["scene"] for record in shapes] == ["row", "platforms", "heap"]
    assert all(record["us_per_world_step"] > 0 and record["shapes"] == 4 for record in shapes)
    assert file.with_suffix(".png").stat().st_size > 0
    table = file.with_suffix(".md").read_text()
    assert "| worlds, sorted |" in table and "| 3 | left out |" in table and "| S (7) |" in table


def test_the_exponent_of_growth_is_that_of_the_power_law() -> None:
    assert exponent([16, 64, 512], [3 * n**1.5 for n in (16, 64, 512)]) == pytest.approx(1.5)


@pytest.mark.parametrize("shapes", [4, 5, 33])
@pytest.mark.parametrize("scene", SCENES)
def test_worlds_of_growth_have_as_many_shapes_as_asked_for(scene: str, shapes: int) -> None:
    world = SCENES[scene](shapes)
    assert world.scene.shapes.active.all() and world.scene.shapes.active.size == shapes


@pytest.mark.parametrize("effect", EFFECTS_OF_LEVELS)
def test_levels_edited_to_do_without_an_effect_do_not_call_for_it(effect: str) -> None:
    scene = load_level_set("designed_l")[0].scene
    everything_meets = np.broadcast_to(
        ~np.eye(scene.shapes.can_touch.shape[-1], dtype=bool), scene.shapes.can_touch.shape
    )
    bounces = np.full_like(scene.shapes.restitution, 0.5)
    a_motor = tuple(np.argwhere(scene.joints.motor_on & scene.joints.has_limits)[0])
    kinds = np.array(scene.joints.kind)
    kinds[a_motor] = JointKind.PRISMATIC  # with motor and limits: no designed level has a slider
    drives = np.where(scene.joints.motor_on, JointDrive.BRAKE, scene.joints.drive).astype(np.int32)
    scene = scene.replace(
        shapes={"can_touch": everything_meets, "restitution": bounces, "kinematic": scene.shapes.inverse_mass == 0},
        joints={"kind": kinds, "drive": drives},
    )
    before, after = effects_of(scene), effects_of(without(scene, effect))
    # All that may touch calls for continuous collision; brakes are motors.
    gone = set() if effect == "continuous_collision" else {effect}
    gone |= {"brakes_and_servos"} if effect == "motors" else set()
    assert all(getattr(before, name) for name in EFFECTS_OF_LEVELS)
    assert {name for name in EFFECTS_OF_LEVELS if not getattr(after, name)} == gone


@pytest.mark.slow
def test_every_effect_is_measured_with_and_without_its_code(tmp_path: Path) -> None:
    records = bench(tmp_path / "effects.json", "effects", "--steps", "2", "--worlds", "4", "--order", "sorted")
    fields = {"size", "effect", "engine", "worlds", "order", "device", "us_per_world_step", "relative_to_full"}
    assert all(set(record) == fields for record in records)
    assert {record["order"] for record in records} == {"sorted"}
    measured = [(record["effect"], record["engine"]) for record in records]
    assert len(set(measured)) == len(measured)
    assert {effect for effect, engine in measured if engine == "without"} == set(EFFECTS_OF_LEVELS)
    assert {effect for effect, engine in measured if engine == "full"} == {
        "all", "bouncing everywhere", "empty scene", "one falling box", *EFFECTS_OF_LEVELS
    } - {"continuous_collision"}  # fmt: skip
    assert ("all", "specialised") in measured
    assert {effect for effect, engine in measured if engine == "larger"} == {"all", *ADDED}
    assert records[0]["relative_to_full"] == 1.0


def test_our_own_engine_is_not_taken_for_the_published_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KINETIX_PEER_PYTHON", sys.executable)
    monkeypatch.setenv("KINETIX_PEER_PYTHONPATH", str(REPOSITORY))
    assert main(["bench", "engine", "--sizes", "s", "--peers"]) == 2
    assert "setup.sh" in capsys.readouterr().err


@pytest.mark.slow
def test_the_published_engine_is_measured_next_to_ours(tmp_path: Path, public_levels: Path) -> None:
    installed = REPOSITORY / "bench" / ".peers" / "jax2d" / "bin" / "python"
    if "KINETIX_PEER_PYTHON" not in os.environ and not installed.exists():
        pytest.skip("the published jax2d is not installed: bash bench/peers/setup.sh")
    arguments = ("--steps", "2", "--worlds", "4", "--presets", "paper", "--peers")
    records = bench(tmp_path / "bench.json", "speed", *arguments)
    assert [record["engine"] for record in records] == ["ours", "published"]
    assert all(set(record) == FIELDS for record in records)
