"""The examples run and draw what they promise."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from tests.helpers import REPOSITORY


def run_example(name: str, *arguments: str) -> str:
    """Output of a script of examples/."""
    command = [sys.executable, str(REPOSITORY / "examples" / name), *arguments]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_drawn(*pictures: Path) -> None:
    for path in pictures:
        with Image.open(path) as image:
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 5  # something is drawn


@pytest.mark.long
def test_catapult_draws_the_best_throw_and_the_map(tmp_path: Path) -> None:
    picture = tmp_path / "throw.png"
    assert "36 variations" in run_example("engine/catapult.py", "--to", str(picture), "--per-axis", "6")
    assert_drawn(picture, tmp_path / "throw_map.png")


@pytest.mark.long
def test_belt_lift_and_platform_carry_both_boxes_away(tmp_path: Path) -> None:
    picture = tmp_path / "platforms.png"
    assert "2 boxes ride on the platform at 0.70 m/s" in run_example("engine/platforms.py", "--to", str(picture))
    assert_drawn(picture)


@pytest.mark.long
def test_rover_drives_and_its_lidar_sees_the_ground(tmp_path: Path) -> None:
    picture = tmp_path / "rover.png"
    assert "rays meet something" in run_example("engine/rover.py", "--to", str(picture))
    assert_drawn(picture)


def test_the_engine_steps_pendulums(tmp_path: Path) -> None:
    picture = tmp_path / "pendulum.png"
    printed = run_example("step_engine.py", "--to", str(picture), "--worlds", "8")
    assert "period from 0.05 rad: 2.00 s" in printed
    assert_drawn(picture)


@pytest.mark.long
def test_a_level_is_written_trained_on_and_watched(tmp_path: Path) -> None:
    printed = run_example("level_to_training.py", "--to", str(tmp_path), "--steps", "8192")
    assert "generalist solves 100% of its attempts" in printed and "the trained policy solves" in printed
    assert (tmp_path / "trained.gif").stat().st_size > 1000


@pytest.mark.slow
def test_a_level_leads_to_a_delay_curve(tmp_path: Path) -> None:
    printed = run_example("delay_curve.py", "--small", "--to", str(tmp_path))
    assert "35 points of a delay curve" in printed  # five methods of the flow, two of the specialist, five delays
    assert {(each["method"], each["delay"]) for each in json.loads((tmp_path / "delay.json").read_text())} == {
        (method, delay)
        for method in ("synchronous", "naive", "bidirectional", "rtc", "training_time_rtc")
        for delay in range(5)
    }
    assert_drawn(tmp_path / "delay.png")


@pytest.mark.long
def test_a_network_of_ones_own_is_trained(tmp_path: Path) -> None:
    """The other two parts of a user are trained with in tests/runtime/test_ray_run.py."""
    options = ("--curriculum.name", "domain_randomization", "--run.total_env_steps", "256")
    assert "env steps/s in training" in run_example("own_network.py", "--run", str(tmp_path / "run"), *options)


def leveldb_log(data: bytes, *, start: int) -> Iterator[bytes]:
    """Records of a log of LevelDB: blocks of 32 KiB, of pieces with CRC (4 bytes), length (2) and kind (1)."""
    block, head = 32768, 7
    at, record = start, b""
    while at + head <= len(data):
        left = block - at % block
        length, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        if left < head or kind == 0:  # the rest of a block is empty
            at += left
            continue
        record += data[at + head : at + head + length]
        at += head + length
        if kind in (1, 4):  # whole, or the last piece; 2 and 3: the first and those between
            yield record
            record = b""


@pytest.mark.long
def test_a_sink_of_ones_own_gets_metrics_evaluations_events_and_the_configuration(tmp_path: Path) -> None:
    """W&B offline, read back from the file that `wandb sync` uploads."""
    messages = pytest.importorskip(
        "wandb.proto.wandb_internal_pb2", reason="W&B is no dependency of the project, 63 MB; pip install wandb"
    )
    options = ("--curriculum.name", "domain_randomization", "--run.total_env_steps", "256")
    run_example("own_sink.py", "--run", str(tmp_path / "run"), *options)
    [file] = (tmp_path / "run" / "wandb").glob("offline-run-*/run-*.wandb")
    records = [messages.Record.FromString(data) for data in leveldb_log(file.read_bytes(), start=len(b":W&B") + 3)]
    logged: dict[str, list[float]] = {}
    for record in records:
        for item in record.history.item:
            logged.setdefault(item.key or "/".join(item.nested_key), []).append(json.loads(item.value_json))
    written = [json.loads(line) for line in (tmp_path / "run" / "metrics" / "metrics.jsonl").read_text().splitlines()]
    assert logged["progress/updates"] == [row["update"] for row in written]
    assert len(logged["evaluation/random_s/solve_rate"]) == 2  # before and after
    configured = {item.key: json.loads(item.value_json) for record in records for item in record.run.config.update}
    assert configured["config_hash"] == json.loads((tmp_path / "run" / "config.json").read_text())["hash"]
    summary = {
        (item.key or "/".join(item.nested_key)): json.loads(item.value_json)
        for record in records
        for item in record.summary.update
    }
    assert summary["events/run_finished"] == 1


@pytest.mark.parametrize(("page", "size"), [("README.md", "num_envs=16"), ("docs/tutorial.md", "num_envs=64")])
def test_the_python_of_a_page_runs(page: str, size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    [code] = re.findall(r"```python\n(.*?)```", (REPOSITORY / page).read_text(), re.DOTALL)
    assert size in code
    names: dict = {}
    exec(compile(code.replace(size, "num_envs=4"), page, "exec"), names)
    assert names["image"].dtype == "uint8" and names["solved"].any()
