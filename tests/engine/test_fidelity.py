"""The accuracy study: the Pareto set by hand, records, and what the command refuses."""

from __future__ import annotations

import csv
import json
import math

import pytest

from jax2d import PRESETS, preset
from jax2d.fidelity.__main__ import main, parse
from jax2d.fidelity.frontier import pareto_set, points_of, slope
from jax2d.fidelity.records import Record, setting_label
from jax2d.fidelity.report import beaten_scenes
from jax2d.fidelity.simulator import Simulator
from jax2d.fidelity.sweep import sweep

FIELDS = ("scene", "preset", "backend", "dtype", "device", "setting", "metric", "error", "us_per_world_second")


# Points


def test_pareto_set_of_five_points():
    # (2, 3) is beaten by (1, 3); (4, 1) equals another and counts once; (5, 2) is beaten by (4, 1).
    assert pareto_set([(2, 3), (1, 3), (4, 1), (5, 2), (4, 1)]) == [1, 2]
    assert pareto_set([]) == []


def test_slope_of_error_that_halves_when_the_cost_doubles():
    assert slope([1, 2, 4], [0.4, 0.2, 0.1]) == pytest.approx(-1.0)
    assert math.isnan(slope([1.0], [0.1]))


def record(scene: str, name: str, setting: str, error: float | None, cost: float) -> Record:
    return Record(
        scene=scene,
        preset=name,
        backend="warp",
        dtype="float32",
        device="cpu",
        setting=setting,
        metric="m",
        error=error,
        us_per_world_second=cost,
    )


def test_points_are_geometric_means_over_the_scenes_that_all_settings_have():
    records = [
        record("a", "x", "1", 0.01, 10.0),
        record("b", "x", "1", None, 40.0),  # not finite: counts as 1
        record("only x", "x", "1", 1e-5, 1.0),
        record("a", "y", "1", 0.0, 9.0),  # exact: counts as 1e-6
        record("b", "y", "1", 0.01, 9.0),
    ]
    x, y = points_of(records)
    assert (x.cost, x.error) == (pytest.approx(20.0), pytest.approx(0.1))
    assert (y.cost, y.error) == (pytest.approx(9.0), pytest.approx(1e-4))


def test_a_preset_is_beaten_only_where_another_is_better_in_one_and_worse_in_none():
    own = setting_label(preset("standard"))
    records = [
        record("faster only", "standard", own, 0.1, 10.0),
        record("faster only", "box2d", "1", 0.2, 5.0),
        record("both", "standard", own, 0.1, 10.0),
        record("both", "box2d", "1", 0.1, 5.0),
        record("swept", "standard", "dt 1/999, 4 substeps", 0.1, 10.0),
        record("swept", "box2d", "1", 0.01, 5.0),
    ]
    assert beaten_scenes(records, "standard", "box2d") == ["both"]


def test_sweep_has_each_preset_as_it_is_and_nothing_twice():
    cases = sweep(list(PRESETS), ["warp"], quick=True)
    labels = [(case.settings.solver, setting_label(case.settings)) for case in cases]
    assert len(set(labels)) == len(labels)
    for name in set(PRESETS) - {"reference"}:
        assert preset(name) in [case.settings for case in cases if case.preset == name]
    assert {round(1 / case.settings.dt) for case in cases} == {30, 60, 120, 240, 480}
    full = sweep(list(PRESETS), ["warp"], quick=False)
    assert len(full) > len(cases)
    for some, names in ((cases, {"standard", "paper"}), (full, {"draft", "standard", "fine", "paper"})):
        assert {case.preset for case in some if not case.settings.warm_start} == names


# The command


def test_study_writes_records_table_and_picture(tmp_path, capsys):
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "free_fall", "stack_rest"]
    assert main([*arguments, "--presets", "standard", "--peers", "--worlds", "8"]) == 0
    records = json.loads(file.read_text())
    assert {tuple(record) for record in records} == {FIELDS}
    assert {record["scene"] for record in records} == {"free_fall", "stack_rest"}
    for entry in records:
        assert isinstance(entry["error"], float) and entry["us_per_world_second"] > 0
    falls = {r["setting"]: r["error"] for r in records if r["scene"] == "free_fall"}
    # Semi-implicit Euler falls g t h / 2 farther, h / t of the height.
    assert falls["dt 1/60, 4 substeps"] == pytest.approx(1 / 240 / 1.5, rel=0.02)
    with file.with_suffix(".csv").open(newline="") as table:
        assert [row["scene"] for row in csv.DictReader(table)] == [record["scene"] for record in records]
    assert file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert "free_fall" in capsys.readouterr().out


def test_quick_parses_and_leaves_the_slow_parts_out(tmp_path):
    quick = parse(["--quick", "--json", str(tmp_path / "a.json")])
    full = parse(["--json", str(tmp_path / "a.json")])
    assert (quick.backends, quick.peers) == (["warp"], ["box2d"])
    assert (full.backends, full.peers) == (["warp", "xla"], ["box2d", "published"])
    assert quick.picture == tmp_path / "a.png"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--worlds", "0"], "--worlds is 0"),
        (["--repeats", "2"], "--repeats is 2"),
        (["--scenes", "perpetual_motion"], "perpetual_motion"),
        (["--presets", "best"], "best"),
        (["--peers", "bullet"], "bullet"),
        (["--json", "/dev/null/study.json"], "cannot write"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(arguments: list[str], says: str, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and says in lines[0]


def test_peer_that_is_not_installed_is_left_out_with_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("KINETIX_BOX2D_PYTHON", str(tmp_path / "no" / "python"))
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers", "box2d"]) == 0
    said = capsys.readouterr().out
    assert "box2d left out: not installed; run `bash bench/peers/setup_box2d.sh`" in said
    assert {record["preset"] for record in json.loads(file.read_text())} == {"standard"}


def test_a_setting_that_fails_costs_no_other_its_records(tmp_path, monkeypatch, capsys):
    whole = Simulator.run

    def run(self, scenarios, settings):
        if settings.dt == 1 / 480:
            raise MemoryError("out of memory\nwhile trying")
        return whole(self, scenarios, settings)

    monkeypatch.setattr(Simulator, "run", run)
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "1 measurement failed" in line and "dt 1/480" in line and "out of memory while trying" in line
    rates = {record["setting"].split(",")[0] for record in json.loads(file.read_text())}
    assert rates == {"dt 1/30", "dt 1/60", "dt 1/120", "dt 1/240"}


def test_a_peer_whose_process_fails_is_a_failure_and_the_rest_is_written(tmp_path, monkeypatch, capsys):
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho boom >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setenv("KINETIX_BOX2D_PYTHON", str(fake))
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers", "box2d"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "box2d failed: boom" in line
    assert {record["preset"] for record in json.loads(file.read_text())} == {"standard"}
