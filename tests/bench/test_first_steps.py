"""Every program of bench/ prints its help, takes a minimal command line and performs its first step on tiny input.

Programs that measure for minutes get so little to do that they end in seconds. Programs for a GPU, a browser or a
published package end with the line that names it, after the steps before.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import shutil
import subprocess
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from bench import (
    compare_revisions,
    compile_time,
    editor,
    engine_worker,
    mixed_cost,
    policy_rounding,
    step_profile,
    training_with_dashboard,
)
from bench.dashboard import serving, write_judged, write_run
from bench.fault_run import FaultRun
from bench.worker_client import Client
from jax2d.fidelity.records import setting_label
from jax2d.settings import PRESETS
from kinetix_dist.child_python import command_of
from kinetix_dist.level.level import SIZES
from kinetix_dist.models.kernels import support
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.trained_policy import checkpoint_at
from tests.bench.test_command_lines import end_of
from tests.helpers import PATIENCE_S, REPOSITORY, environment_of_cpus

PROGRAMS = sorted(path.stem for path in (REPOSITORY / "bench").glob("*.py") if "__main__" in path.read_text())
WITHOUT_OPTIONS = ("revision_runner",)  # it answers requests on stdin
ABSENT = "absent"  # a program that no machine has


class Bench:
    """Calls programs of bench/ in this process, with a folder of the test."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def run(self, name: str, *arguments: object) -> int:
        """Return the exit code of a program."""
        return end_of(importlib.import_module(f"bench.{name}").main, [*map(str, arguments)], self._monkeypatch)

    def refuses(self, name: str, *arguments: object) -> str:
        """Return the line with which a program ends, by exit code 2."""
        self._capsys.readouterr()
        assert self.run(name, *arguments) == 2
        return self._capsys.readouterr().err.splitlines()[-1]

    def output(self) -> str:
        """Return the output of the programs so far."""
        return self._capsys.readouterr().out


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for variable in ("KINETIX_PEER_PYTHON", "KINETIX_PACKAGE_PYTHON", "KINETIX_BOX2D_PYTHON"):
        monkeypatch.setenv(variable, ABSENT)
    precision = jax.config.read("jax_enable_x64")
    yield Bench(tmp_path, monkeypatch, capsys)
    jax.config.update("jax_enable_x64", precision)


Step = Callable[[Bench], None]
STEPS: dict[str, list[Any]] = {}


def step_of(program: str, *marks: pytest.MarkDecorator) -> Callable[[Step], Step]:
    """Register a step of a program."""

    def register(step: Step) -> Step:
        of_program = STEPS.setdefault(program, [])
        of_program.append(pytest.param(step, marks=marks, id=step.__name__))
        return step

    return register


@pytest.mark.parametrize("program", [name for name in PROGRAMS if name not in WITHOUT_OPTIONS])
def test_a_program_prints_its_help(program: str, bench: Bench) -> None:
    assert bench.run(program, "--help") == 0
    assert bench.output().startswith("usage: ")


# Programs that end in seconds, on tiny input


@step_of("compare_revisions")
def export_a_revision(bench: Bench) -> None:
    if not (REPOSITORY / ".git").exists():
        pytest.skip("not a git checkout")
    assert bench.run("compare_revisions", "export", "HEAD", "--folder", bench.folder / "revisions") == 0
    assert (bench.folder / "revisions" / "revisions.json").is_file()


@step_of("compare_revisions")
def write_worlds(bench: Bench) -> None:
    file = bench.folder / "s.npz"
    capacity, _ = compare_revisions.write_worlds("s", None, 2, "drawn", file)
    assert file.is_file() and capacity == SIZES["s"]


@step_of("compile_time")
def find_a_capacity(bench: Bench) -> None:
    assert compile_time.capacity_named("s") == SIZES["s"]


@step_of("dashboard")
def serve_judged_runs(bench: Bench) -> None:
    write_judged(write_run(bench.folder / "runs" / "run_0", 32), 32)
    with serving(bench.folder / "runs") as (address, server), urllib.request.urlopen(address) as page:
        assert page.status == 200 and server.is_running()


@step_of("dashboard")
@step_of("editor")
@step_of("page_pictures")
@step_of("training_with_dashboard")
def name_the_absent_browser(bench: Bench) -> None:
    for name, arguments in (
        ("dashboard", []),
        ("editor", []),
        ("page_pictures", ["--runs", bench.folder, "--run", "run", "--to", bench.folder]),
        ("training_with_dashboard", ["--updates", 4]),
    ):
        assert f"--browser {ABSENT} is no file" in bench.refuses(name, "--browser", ABSENT, *arguments)


@step_of("editor")
def serve_the_level(bench: Bench) -> None:
    with serving(editor.LEVEL, name="edit") as (address, _), urllib.request.urlopen(address) as page:
        assert page.status == 200


@step_of("page_film")
def serve_an_empty_level(bench: Bench) -> None:
    line = bench.refuses("page_film", "--to", bench.folder / "film.gif", "--browser", ABSENT)
    assert f"--browser {ABSENT} is no file" in line


@step_of("training_with_dashboard")
def read_the_newest_row(bench: Bench) -> None:
    file = bench.folder / "metrics.jsonl"
    assert training_with_dashboard.newest_update(file) == 0
    sink = JsonlSink(file)
    for update in (1, 2):
        sink.write(update, {"progress/env_steps": 10.0 * update})
        assert training_with_dashboard.newest_update(file) == update
    sink.close()


@step_of("training_with_dashboard")
def compare_updates(bench: Bench) -> None:
    records = [{"with": is_with, "cpu_seconds": 2.0 if is_with else 1.0} for is_with in training_with_dashboard.ORDER]
    assert training_with_dashboard.ratio(records, "cpu_seconds") == pytest.approx((2.0, 2.0, 2.0))


@step_of("export_policy")
def export_a_policy(bench: Bench) -> None:
    assert bench.run("export_policy", "random_only", bench.folder / "policy") == 0
    assert checkpoint_at(bench.folder / "policy").num_updates >= 0


@step_of("fault_tests")
def start_and_end_a_run(bench: Bench) -> None:
    run = FaultRun(bench.folder / "run", "colocated")
    run.start("--run.total_env_steps", "128")
    assert run.is_alive
    run.end()
    assert not run.is_alive and run.updates() == []


@step_of("frontier_sets")
def leave_known_sets(bench: Bench) -> None:
    file = bench.folder / "sets.json"
    shutil.copy(REPOSITORY / "levels" / "frontier_sets.json", file)
    assert bench.run("frontier_sets", "--sizes", "s", "m", "--policies", "random_only", "--json", file) == 0
    assert bench.output().count("stays as it is") == 2


@step_of("learnability")
def describe_refreshes(bench: Bench) -> None:
    write_judged(write_run(bench.folder / "run", 32), 32)
    assert bench.run("learnability", bench.folder / "run", "--json", bench.folder / "found.json") == 0
    assert json.loads((bench.folder / "found.json").read_text())[0]["kind"] == "refresh"


def write_study(file: Path) -> Path:
    """A study of accuracy with one setting, preset draft."""
    record = {"scene": "a", "preset": "draft", "backend": "warp", "dtype": "float32", "device": "cpu"}
    record |= {"setting": setting_label(PRESETS["draft"]), "metric": "m", "error": 0.1, "us_per_world_second": 10.0}
    file.write_text(json.dumps([record]))
    return file


@step_of("mixed_cost")
def read_a_study(bench: Bench) -> None:
    (draft,) = mixed_cost.candidates_of(write_study(bench.folder / "study.json"))
    assert draft.is_preset and draft.study_cost == pytest.approx(10.0)


@step_of("policy_rounding")
def configure_variants(bench: Bench) -> None:
    arguments = argparse.Namespace(recipe="tiny", envs=16, steps=2, minibatches=1)
    config = policy_rounding.config_of(checkpoint_at(Path("random_only")), arguments)
    variant = policy_rounding.variant_of(config, "float32", "xla", is_masked=True)
    assert (variant.rollout.num_steps, variant.policy.dtype, variant.ppo.mask_unbound_heads) == (2, "float32", True)


def write_published(file: Path) -> None:
    """One level of the public package: a square that a joint and a thruster hold."""
    capacity, random = SIZES["s"], np.random.default_rng(0)
    shape: dict[str, tuple[int, ...]] = {
        "position": (2,),
        "rotation": (),
        "density": (),
        "friction": (),
        "restitution": (),
        "inverse_mass": (),
    }
    joint: dict[str, tuple[int, ...]] = {
        "a_relative_pos": (2,),
        "b_relative_pos": (2,),
        "rotation": (),
        "motor_speed": (),
        "motor_power": (),
    }
    joint |= {"min_rotation": (), "max_rotation": ()}
    thruster: dict[str, tuple[int, ...]] = {"relative_position": (2,), "rotation": (), "power": ()}
    flags: dict[str, Any] = {"active": bool}
    numbers: dict[str, Any] = {"role": np.int32, "collision_mode": np.int32}
    joints: dict[str, Any] = {"is_fixed_joint": bool, "motor_on": bool, "motor_has_joint_limits": bool}
    joints |= {"a_index": np.int32, "b_index": np.int32, "motor_binding": np.int32}
    kinds: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
        "polygon": (capacity.polygons, shape, flags | numbers),
        "circle": (capacity.circles, shape, flags | numbers),
        "joint": (capacity.joints, joint, flags | joints),
        "thruster": (capacity.thrusters, thruster, flags | {"object_index": np.int32, "binding": np.int32}),
    }
    data: dict[str, Any] = {}
    for kind, (number, floats, others) in kinds.items():
        data |= {f"{kind}_{name}": random.uniform(0.1, 1, (1, number, *sizes)) for name, sizes in floats.items()}
        data |= {f"{kind}_{name}": np.zeros((1, number), dtype) for name, dtype in others.items()}
        data[f"{kind}_active"][0, : 2 if kind == "polygon" else 1] = True
    data["joint_b_index"][:] = 1
    square = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]], np.float32)
    data["polygon_vertices"] = np.broadcast_to(square, (1, capacity.polygons, 4, 2))
    data["polygon_n_vertices"] = np.full((1, capacity.polygons), 4, np.int32)
    data["circle_radius"] = np.full((1, capacity.circles), 0.5, np.float32)
    np.savez(file, allow_pickle=False, **data)


@step_of("published_levels")
def describe_a_public_level(bench: Bench) -> None:
    write_published(bench.folder / "levels_s.npz")
    to = bench.folder / "described.json"
    assert bench.run("published_levels", bench.folder / "levels_s.npz", "--to", to) == 0
    assert set(json.loads(to.read_text())["sizes"]) == {"s"}


@step_of("published_steps")
def write_an_excerpt(bench: Bench) -> None:
    file = bench.folder / "excerpt.npz"
    assert bench.run("published_steps", REPOSITORY / "tests" / "engine" / "published_steps_m.npz", file) == 0
    assert file.stat().st_size > 0


@step_of("recovery")
def lose_a_worker_too_late(bench: Bench) -> None:
    file = bench.folder / "records.json"
    assert bench.run("recovery", "--losses", "worker", "--seconds", "0.2", "--json", file) == 1
    wrong = [line for record in json.loads(file.read_text()) for line in record["wrong"]]
    assert any("the first update did not come" in line for line in wrong), wrong


@step_of("revision_runner")
def describe_the_engine(bench: Bench) -> None:
    done = subprocess.run(
        command_of("bench.revision_runner"),
        input=json.dumps({"do": "describe"}) + "\n",
        env=environment_of_cpus(1),
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    )
    answer = json.loads(done.stdout.splitlines()[-1])
    assert answer["ok"] and Path(answer["jax2d"]) == REPOSITORY / "jax2d"


@step_of("set_fingerprints")
def leave_known_fingerprints(bench: Bench) -> None:
    file = bench.folder / "fingerprints.json"
    shutil.copy(REPOSITORY / "levels" / "fingerprints.json", file)
    assert bench.run("set_fingerprints", "--json", file) == 0
    assert bench.output().count("stays as it is") == len(json.loads(file.read_text()))


@step_of("set_fingerprints", pytest.mark.long)
def make_one_fingerprint(bench: Bench) -> None:
    """A level of 256 may differ with the rounding of another compiler."""
    file, stored = bench.folder / "fingerprints.json", REPOSITORY / "levels" / "fingerprints.json"
    known = json.loads(stored.read_text())
    file.write_text(json.dumps({name: lines for name, lines in known.items() if name != "random_s"}))
    assert bench.run("set_fingerprints", "--json", file) == 0
    codes, expected = (set(content["random_s"].split()) for content in (json.loads(file.read_text()), known))
    assert len(codes & expected) > 0.95 * len(expected)


@step_of("smoke")
def end_every_command_at_once(bench: Bench) -> None:
    file = bench.folder / "smoke.json"
    assert bench.run("smoke", "--seconds", "0.01", "--updates", "2", "--json", file) == 1
    records = json.loads(file.read_text())
    assert [record["command"] for record in records] == ["train", "resume", "eval", "bench tiny"]
    assert all("more than 0.01 s" in record["wrong"][0] for record in records)


@step_of("step_profile")
def configure_a_profile(bench: Bench) -> None:
    options = argparse.Namespace(worlds=16_384, steps=64, repeats=1, rows=1, network=None, kernels="xla", text=None)
    options.recipes = ["pretrain_s"]
    step_profile.check(options)
    assert step_profile.profiled("pretrain_s", options).rollout.num_steps == 64


# Programs for a published package, a GPU or its compiler


@step_of("paper_single_steps")
@step_of("public_package")
@step_of("rl_loop")
def name_the_absent_package(bench: Bench) -> None:
    (bench.folder / "s").mkdir()
    (bench.folder / "s" / "level.json").write_text("{}")
    levels = ("--levels", bench.folder, "--sizes", "s")
    for name, arguments in (
        ("paper_single_steps", [*levels, "--steps", bench.folder / "steps"]),
        ("public_package", [*levels, "--policies", 1, "--played", bench.folder / "played"]),
        ("rl_loop", ["--size", "s", "--worlds", 1, "--steps", 1, "--repeats", 1]),
    ):
        assert f"{ABSENT} does not exist; run `bash bench/peers/setup" in bench.refuses(name, *arguments)


@step_of("sanitize_kernels")
def name_the_absent_gpu(bench: Bench) -> None:
    if not support.why_no_device():
        pytest.skip("the kernels run on this machine, for minutes")
    assert "the kernels do not run here" in bench.refuses("sanitize_kernels")


@step_of("learner_traffic")
@step_of("training_memory")
def name_the_absent_compiler(bench: Bench) -> None:
    if importlib.util.find_spec("jax_cuda13_plugin") is not None:
        pytest.skip("this machine compiles for an H200, for minutes")
    for name, arguments in (
        ("learner_traffic", ["--sizes", "s", "--networks", "flat", "--minibatch", 2048, "--encoder-size", 8]),
        ("training_memory", ["--recipes", "tiny", "--worlds", 64]),
    ):
        assert "cannot compile for CUDA here" in bench.refuses(name, *arguments)


# Programs that compile or play for longer


@step_of("compile_time", pytest.mark.long)
def time_a_first_step(bench: Bench) -> None:
    assert bench.run("compile_time", "--in-this-process", "s", "--first-step") == 0
    assert json.loads(bench.output())["seconds"] > 0


@step_of("control_plane", pytest.mark.long)
def start_one_process(bench: Bench) -> None:
    assert bench.run("control_plane", "--processes", 1, "--json", bench.folder / "found.json") == 0


@step_of("engine_promises", pytest.mark.long)
def check_a_promise(bench: Bench) -> None:
    assert bench.run("engine_promises", "--only", "double pendulum with a light bar") == 0


@step_of("engine_worker", pytest.mark.long)
def check_a_level(bench: Bench) -> None:
    client = Client(log=bench.folder / "log")
    try:
        assert client.request("check", document=engine_worker.level_of("s")["document"])
    finally:
        client.close()


@step_of("frontier_sets", pytest.mark.long)
def try_four_levels(bench: Bench) -> None:
    few = ("--num-levels", 1, "--max-drawn", 4, "--batch", 4, "--attempts", 1)
    file = bench.folder / "sets.json"
    assert bench.run("frontier_sets", "--sizes", "s", "--policies", "random_only", "--json", file, *few) in (0, 2)
    assert "of 4 levels" in bench.output()


@step_of("kernel_profile", pytest.mark.long)
def measure_divergence(bench: Bench) -> None:
    few = ("--sizes", "s", "--worlds", 32, "--repeats", 1, "--json", bench.folder / "profile.json")
    assert bench.run("kernel_profile", "--parts", "divergence", "speed", *few) == 0


@step_of("mixed_cost", pytest.mark.long)
def time_one_setting(bench: Bench) -> None:
    few = ("--sizes", "m", "--worlds", 1, "--seconds", 0.04, "--repeats", 1, "--json", bench.folder / "cost.json")
    assert bench.run("mixed_cost", "--study", write_study(bench.folder / "study.json"), *few) == 0


@step_of("policy_rounding", pytest.mark.long)
def round_one_variant(bench: Bench) -> None:
    few = ("--envs", 16, "--steps", 2, "--minibatches", 1, "--dtypes", "float32", "--heads", "all")
    assert bench.run("policy_rounding", "--checkpoint", "random_only", "--recipe", "tiny", *few) == 0


@step_of("shots", pytest.mark.long)
def fly_one_shot(bench: Bench) -> None:
    assert bench.run("shots", "--shots", 1, "--json", bench.folder / "shots.json") == 0


@step_of("soak", pytest.mark.long)
def play_one_world(bench: Bench) -> None:
    assert bench.run("soak", "--steps", 1, "--worlds", 1, "--sizes", "s", "--json", bench.folder / "soak.json") == 0


@pytest.mark.parametrize("step", {id(param.values[0]): param for steps in STEPS.values() for param in steps}.values())
def test_a_program_performs_its_first_step(step: Step, bench: Bench) -> None:
    step(bench)


def test_every_program_has_a_step() -> None:
    assert sorted(STEPS) == PROGRAMS
