"""`kinetix-dist replay`: the rollout taken, the file written, the line for bad input."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.evaluation.recordings import decode_level
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.sinks.mcap import RolloutWriter

LEVEL = {
    "format": "kinetix-dist-level",
    "version": 1,
    "name": "two_discs",
    "size": "s",
    "shapes": [
        {"id": "ball", "type": "circle", "radius": 0.3, "position": [1.0, 2.0], "role": "green"},
        {"id": "goal", "type": "circle", "radius": 0.4, "position": [4.0, 1.0], "role": "blue", "fixed": True},
    ],
    "joints": [],
    "thrusters": [],
}


def still_rollout(num_steps: int, *, solved: bool) -> Rollout:
    """Nothing moves: replaying needs no physics."""
    level = decode_level(json.dumps(LEVEL))

    def repeated(values: np.ndarray, count: int) -> np.ndarray:
        return np.tile(np.asarray(values, np.float32), (count, *[1] * np.ndim(values)))

    return Rollout(
        level=level,
        level_json=json.dumps(LEVEL),
        level_name="two_discs",
        position=repeated(level.position, num_steps + 1),
        angle=repeated(level.angle, num_steps + 1),
        velocity=repeated(level.velocity, num_steps + 1),
        angular_velocity=repeated(level.angular_velocity, num_steps + 1),
        actions=np.zeros((num_steps, 6), np.float32),
        motor=np.zeros((num_steps, *level.scene.joints.active.shape), np.float32),
        thruster=np.zeros((num_steps, *level.scene.thrusters.active.shape), np.float32),
        reward=np.zeros(num_steps, np.float32),
        solved=solved,
        failed=False,
        policy_version=7,
        seed=0,
        step_seconds=1 / 30,
    )


@pytest.fixture
def run_directory(tmp_path: Path) -> Path:
    """A run with two recordings: rollouts of 3 (solved), 4 (not) and 5 (not) steps."""
    run = tmp_path / "run"
    (run / "recordings").mkdir(parents=True)
    for k, lengths in enumerate(((3, 4), (5,))):
        path = run / "recordings" / f"update_{k}.mcap"
        writer = RolloutWriter(path)
        for length in lengths:
            writer.write(still_rollout(length, solved=length == 3))
        writer.finish()
        os.utime(path, (k, k))
    return run


def test_the_last_rollout_is_replayed_beside_its_recording(
    run_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(run_directory)]) == 0
    assert (run_directory / "recordings" / "update_1_000.rrd").stat().st_size > 1000
    out = capsys.readouterr().out
    assert "out of time after 5 steps" in out and "policy version 7" in out


def test_a_solved_one_is_found_and_a_picture_needs_no_rrd(
    run_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(run_directory), "--solved", "--picture", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert "solved after 3 steps" in capsys.readouterr().out
    assert not list(run_directory.rglob("*.rrd"))


def test_a_recording_replays_without_its_run(run_directory: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.mcap"
    shutil.move(run_directory / "recordings" / "update_0.mcap", moved)
    shutil.rmtree(run_directory)
    assert main(["replay", str(moved), "--index", "0", "--to", str(tmp_path / "a.rrd")]) == 0
    assert (tmp_path / "a.rrd").exists()


def test_list_names_every_rollout(run_directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(run_directory), "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1", "2"]


def test_a_cut_recording_replays_and_says_so(run_directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run_directory / "recordings" / "update_0.mcap"
    path.write_bytes(path.read_bytes()[:-200])
    assert main(["replay", str(path), "--index", "0"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "ends without an index" in line


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["missing.mcap"], "does not exist"),
        (["{run}", "--index", "9"], "rollouts 0 to 2"),
        (["{run}", "--solved", "--failed"], "exclude each other"),
        (["{run}/empty"], "holds no recordings"),
        (["{run}/notes.mcap"], "no MCAP file"),
        (["{run}", "--to", "{run}/nowhere/a.rrd"], "--to a file in a directory that exists"),
        (["{run}", "--picture", "{run}/nowhere/a.png"], "--picture a file in a directory that exists"),
        (["{run}/recordings/update_1.mcap", "--solved"], "none of the 1 rollouts"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    run_directory: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], expected: str
) -> None:
    (run_directory / "empty").mkdir()
    (run_directory / "notes.mcap").write_text("notes")
    assert main(["replay", *[argument.format(run=run_directory) for argument in arguments]]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line


def test_view_without_a_display_writes_the_file_and_says_what_to_do(
    run_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["replay", str(run_directory), "--view", "--to", str(tmp_path / "a.rrd")]) == 2
    assert (tmp_path / "a.rrd").exists()
    assert "no display" in capsys.readouterr().err
