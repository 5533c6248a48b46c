"""Benchmarks of training: what they run, how they count, and their records from real runs of seconds."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
from pathlib import Path

import pytest

from kinetix_dist.benchmarks import curator_refresh, scaling, training_speed
from kinetix_dist.benchmarks.training_options import shares_of_time, shortened, speeds, with_fields
from kinetix_dist.benchmarks.training_run import RunFailedError, UpdateLines, environment_of, run_in_process
from kinetix_dist.child_python import command_of
from kinetix_dist.cli.main import main
from kinetix_dist.config import ConfigError, TrainConfig, to_dict
from kinetix_dist.recipes import RECIPES, recipe
from kinetix_dist.runtime import RunDirectory, train
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig
from kinetix_dist.telemetry.json_lines import read_lines
from tests.helpers import PATIENCE_S, python_path


def bench(json_file: Path, *arguments: str) -> list[dict]:
    assert main(["bench", *arguments, "--recipe", "tiny", "--json", str(json_file)]) == 0
    return json.loads(json_file.read_text())


def fields(record_type: type) -> set[str]:
    return {field.name for field in dataclasses.fields(record_type)}


# What is run


def test_fields_of_a_recipe_are_set_by_name() -> None:
    config = with_fields(
        recipe("tiny"),
        ("ppo.epochs=3", "policy.network=flat", "env.observation=flat", "curriculum.generator.triangle_chance=0.5"),
    )
    assert (config.ppo.epochs, config.policy.network, config.curriculum.generator.triangle_chance) == (3, "flat", 0.5)
    assert with_fields(recipe("tiny"), ()) == recipe("tiny")


@pytest.mark.parametrize("assignment", ["ppo.epoch=3", "epochs=3", "ppo.epochs", "ppo.epochs.more=1"])
def test_what_is_no_field_of_a_recipe_is_refused(assignment: str) -> None:
    with pytest.raises(ValueError, match="--set has"):
        with_fields(recipe("tiny"), (assignment,))


@pytest.mark.parametrize("name", RECIPES)
def test_a_shortened_run_computes_what_the_recipe_computes(name: str) -> None:
    config, short = recipe(name), shortened(recipe(name), 7)
    assert short.hash == config.hash
    assert short.run.total_env_steps == 7 * config.rollout.steps_per_update
    assert short.run.only_updates


def test_a_point_of_scaling_has_as_many_workers_as_devices() -> None:
    options = scaling.Options(recipe="tiny", devices=(1, 2, 4))
    worlds = recipe("tiny").rollout.num_envs
    colocated = scaling.config_of(options, "colocated", 4)
    assert (colocated.run.num_workers, colocated.rollout.num_envs) == (4, worlds)
    split = scaling.config_of(options, "split", 3)
    assert (split.run.placement, split.run.num_rollout_actors) == ("split", 2)
    weak = scaling.config_of(dataclasses.replace(options, mode="weak"), "local", 4)
    assert (weak.run.placement, weak.rollout.num_envs) == ("local", 4 * worlds)
    assert weak.run.total_env_steps == 8 * weak.rollout.steps_per_update


def test_a_process_sees_as_many_devices_as_it_is_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5,7")
    assert environment_of("local", 2, on_gpu=True) == {"CUDA_VISIBLE_DEVICES": "3,5"}
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert environment_of("colocated", 2, on_gpu=True) == {"CUDA_VISIBLE_DEVICES": "0,1"}
    monkeypatch.setenv("XLA_FLAGS", "--other")
    on_cpu = environment_of("local", 2, on_gpu=False)
    assert on_cpu["XLA_FLAGS"] == "--other --xla_force_host_platform_device_count=2"
    assert "XLA_FLAGS" not in environment_of("colocated", 2, on_gpu=False)


@pytest.mark.parametrize(
    "wanted", ["evaluation.every=2", "evaluation.every_seconds=2.0", "recording.num_rollouts=1", "recording.every=1"]
)
def test_a_run_of_updates_alone_neither_evaluates_nor_records(wanted: str) -> None:
    name, _, _ = wanted.partition("=")
    with pytest.raises(ConfigError, match=f"^run.only_updates leaves out {name};"):
        with_fields(shortened(recipe("tiny"), 3), (wanted,))


# How it is counted


def row(update: int, speed: float, **shares: float) -> dict[str, float]:
    times = {f"time/{role}": share for role, share in shares.items()}
    return {"update": update, "progress/env_steps_per_second": speed, **times}


def test_the_first_two_updates_do_not_count() -> None:
    rows = [row(1, 1.0, learn=1.0), row(2, 2.0, learn=1.0), row(3, 300.0, learn=0.2), row(4, 100.0, learn=0.6)]
    assert speeds(rows) == [300.0, 100.0]
    # Of 1/300 + 1/100 seconds a step: a quarter and three quarters.
    assert shares_of_time(rows) == {"learn": pytest.approx(0.25 * 0.2 + 0.75 * 0.6)}


def test_refreshes_are_told_from_updates_by_their_number() -> None:
    """Updates 0, 4 and 8 ask for a refresh, 1 and 5 adopt it; that of 8 has a probe, which compiles, that of 16 too."""
    speed = [1.0, 90.0, 10.0, 20.0, 5.0, 90.0, 40.0, 50.0, 2.0]  # env steps/s of 100 steps
    rows = [row(number + 1, speed, curate=0.6) for number, speed in enumerate(speed)]
    none = CurriculumLogConfig(probe_levels=0)
    refreshes, probed, updates = curator_refresh.seconds_of(rows, 100, none)
    assert refreshes == pytest.approx([0.6 * 20.0, 0.6 * 50.0]) and not probed
    assert updates == pytest.approx([10.0, 5.0, 2.5, 2.0])
    rows += [row(number + 1, 4.0, curate=0.6) for number in range(9, 17)]
    refreshes, probed, _ = curator_refresh.seconds_of(rows, 100, CurriculumLogConfig(probe_every=2))
    assert refreshes == pytest.approx([0.6 * 20.0, 0.6 * 25.0]) and probed == pytest.approx([0.6 * 25.0])


def test_lines_say_what_a_measured_run_does() -> None:
    lines: list[str] = []
    progress = UpdateLines(lines.append, num_updates=3, num_warm=2)
    progress.set_phase("compiling")
    for update in (1, 2, 3):
        progress.write(update, {"progress/env_steps_per_second": 1000.0 * update, "progress/seconds": 12.34})
    assert [line.strip() for line in lines] == [
        "compiling: the first update compiles, and is not measured",
        "update 1 of 3: 12.3 s, not measured",
        "update 2 of 3: 2,000 env steps/s, not measured",
        "measuring 1 updates",
        "update 3 of 3: 3,000 env steps/s",
    ]


# Real runs


class Phases(UpdateLines):
    """Phases of a run."""

    def __init__(self) -> None:
        super().__init__(lambda line: None, num_updates=3, num_warm=2)
        self.phases: list[str] = []

    def set_phase(self, phase: str) -> None:
        self.phases += [] if phase in self.phases else [phase]


def trained(config: TrainConfig, folder: Path) -> tuple[RunDirectory, list[str]]:
    """The directory of a run, and its phases."""
    run, progress = RunDirectory.create(folder, numbered=False), Phases()
    try:
        train(config, run, resume=False, console=progress)
    finally:
        run.close()
    return run, progress.phases


def test_a_measured_run_compiles_and_updates_and_does_nothing_else(tmp_path: Path) -> None:
    run, phases = trained(shortened(recipe("tiny"), 3), tmp_path / "run")
    assert phases[0] == "compiling" and not {"evaluating", "recording"} & set(phases)
    assert [row["update"] for row in read_lines(run.metrics / "metrics.jsonl").rows] == [1, 2, 3]
    events = {row["event"] for row in read_lines(run.events).rows}
    assert "run_finished" in events and not events & {"evaluated", "checkpoint_saved", "checkpoint_failed"}
    for path in (run.checkpoints, run.evaluations_path, run.evaluation_rows, run.recordings):
        assert not path.exists(), path
    report = json.loads(run.report_path.read_text())
    assert set(report["solve_rate"].values()) == {None} and report["seconds_by_role"]["evaluate"] == 0.0


@pytest.mark.gpu
@pytest.mark.parametrize("placement", ["local", "colocated"])
def test_a_recipe_for_the_cpu_is_measured_on_a_machine_with_a_gpu(placement: str, tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    arguments = ["bench", "train", "--recipe", "tiny", "--updates", "3", "--placement", placement]
    done = subprocess.run(
        command_of("kinetix_dist.cli.main", *arguments),
        env=environment | {"PYTHONPATH": python_path()},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    assert "update 3 of 3" in done.stdout


@pytest.mark.long
def test_training_is_measured_and_its_run_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    (record,) = bench(tmp_path / "train.json", "train", "--updates", "4", "--set", "run.keep_checkpoints=2")
    assert set(record) == fields(training_speed.TrainingRecord)
    assert (record["recipe"], record["overrides"], record["placement"]) == ("tiny", ["run.keep_checkpoints=2"], "local")
    assert (record["platform"], record["gpus"], record["worlds"], record["updates"]) == ("cpu", 0, 16, 2)
    assert 0 < record["slowest"] <= record["env_steps_per_second"] <= record["fastest"]
    assert sum(record["share_of_time"].values()) == pytest.approx(1.0, abs=0.01)
    assert record["share_of_time"]["learn"] > 0
    assert record["unmeasured_seconds"] > 0 and 0 < record["first_update_seconds"] < record["wall_seconds"]
    assert not list(folder.glob("kinetix-bench-*"))


def test_a_run_that_fails_in_its_process_says_why() -> None:
    config = shortened(recipe("tiny"), 3)
    broken = dataclasses.replace(config, run=dataclasses.replace(config.run, start_from="nosuch"))
    with pytest.raises(RunFailedError, match="there is no checkpoint nosuch"):
        run_in_process(broken, {"JAX_PLATFORMS": "cpu"}, timeout_seconds=300)


def test_a_run_that_takes_too_long_is_ended() -> None:
    with pytest.raises(RunFailedError, match=r"not done after 0\.1 s"):
        run_in_process(shortened(recipe("tiny"), 3), {}, timeout_seconds=0.1)


def test_more_devices_than_blocks_of_worlds_are_left_out_of_scaling(tmp_path: Path) -> None:
    first, second = bench(tmp_path / "scaling.json", "scaling", "--devices", "5", "--placements", "local", "colocated")
    assert set(first) == fields(scaling.ScalingRecord)
    assert (first["placement"], first["devices"], first["env_steps_per_second"]) == ("local", 5, None)
    assert "5 devices cannot share 4 blocks of worlds" in first["left_out"] and second["left_out"]


@pytest.mark.slow
def test_scaling_measures_every_point(tmp_path: Path) -> None:
    arguments = ("--devices", "1", "2", "--placements", "local", "colocated", "split", "--updates", "4")
    records = bench(tmp_path / "scaling.json", "scaling", *arguments)
    found = {(record["placement"], record["devices"]): record for record in records}
    assert "split needs 2 devices" in found.pop(("split", 1))["left_out"]
    assert set(found) == {("local", 1), ("local", 2), ("colocated", 1), ("colocated", 2), ("split", 2)}
    for record in found.values():
        assert record["left_out"] is None and record["runs"] == 1
        assert record["env_steps_per_second"] > 0 and record["efficiency"] > 0
    assert found["local", 1]["efficiency"] == 1.0


@pytest.mark.slow
def test_a_curator_is_measured_by_size(tmp_path: Path) -> None:
    records = bench(tmp_path / "curator.json", "curator", "--sizes", "s", "m", "--refreshes", "2")
    assert [record["size"] for record in records] == ["s", "m"]
    curriculum = recipe("tiny").curriculum
    for record in records:
        assert set(record) == fields(curator_refresh.CuratorRecord)
        assert (record["num_candidates"], record["refresh_every"]) == (16, curriculum.refresh_every)
        assert record["refreshes"] == 3  # beside two with a probe
        assert (record["probe_seconds"] is not None, record["probe_every"]) == (True, 1)
        assert 0 < record["fastest"] <= record["refresh_seconds"] <= record["slowest"]
        assert record["candidates_per_second"] == pytest.approx(16 / record["refresh_seconds"], rel=0.01)
        training = curriculum.refresh_every * record["update_seconds"]
        curated = record["refresh_seconds"] + record["probe_seconds"]
        share = curated / (curated + training)
        assert record["share_of_training_time"] == pytest.approx(share, abs=0.01)


def test_the_run_of_a_curator_is_of_the_size_and_has_its_refreshes() -> None:
    config = curator_refresh.config_of(recipe("tiny"), "m", refreshes=2)
    assert (config.env.size, config.run.placement) == ("m", "local")
    updates = config.run.total_env_steps // config.rollout.steps_per_update
    due = [number for number in range(updates) if config.refresh_times.is_due(number)]
    assert due == [0, 4, 8, 12, 16, 20, 24]  # two with a probe, but for the first, and those between them
    without = dataclasses.replace(recipe("tiny"), curriculum_log=CurriculumLogConfig(probe_levels=0))
    config = curator_refresh.config_of(without, "m", refreshes=2)
    updates = config.run.total_env_steps // config.rollout.steps_per_update
    assert [number for number in range(updates) if config.refresh_times.is_due(number)] == [0, 4, 8]
    assert to_dict(config)["curriculum"]["num_candidates"] == recipe("tiny").curriculum.num_candidates
