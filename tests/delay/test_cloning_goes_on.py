"""`clone-flow` after a kill, a stop or more steps: the same bytes as without them; one line for what cannot go on."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from kinetix_dist.checkpoint import CheckpointError, list_checkpoints, load_checkpoint, save_checkpoint, store
from kinetix_dist.child_python import command_of
from kinetix_dist.cli.main import main
from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.delay import cloning
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.level.sets import load_level_set
from tests.helpers import REPOSITORY

STEPS = 200
SMALL = {
    "horizon": 4,
    "max-delay": 1,
    "width": 8,
    "token-width": 4,
    "num-layers": 1,
    "batch": 8,
    "held-out": 0.2,
    "report-every": 10,
    "save-seconds": 0,
    "encoder.flat-size": 8,
}
DEADLINE_S = 240.0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    env = Environment(EnvConfig(size="s", max_steps=8, action_space="continuous", observation="flat"))
    levels, names = load_level_set("s/kick", "s")
    folder = tmp_path_factory.mktemp("collected") / "data"
    collection = Collection(
        env=env,
        player=Player(RandomPolicy(env.action_space)),
        policy={"name": "random", "version": -1, "sha256": "", "greedy": False},
        levels=levels,
        level_names=names,
        level_set="s/kick",
        num_worlds=4,
        num_steps=16,
    )
    collect(collection, folder, 2)
    return folder


def command(data: Path, run: Path, *options: str, steps: int = STEPS) -> list[str]:
    words = [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]
    return ["clone-flow", "--data", str(data), "--run", str(run), "--steps", str(steps), *words, *options]


@pytest.fixture(scope="module")
def unbroken(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("unbroken") / "run"
    assert main(command(data, run)) == 0
    return run


def arrays_of(run: Path, folder: str) -> dict[str, dict[str, np.ndarray]]:
    return {path.name: load_checkpoint(path).arrays for path in list_checkpoints(run / folder)}


def progress_of(run: Path) -> list[dict]:
    """Without the seconds of each command."""
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def assert_same(run: Path, unbroken: Path) -> None:
    for folder in ("checkpoints", "state"):
        ours, theirs = arrays_of(run, folder), arrays_of(unbroken, folder)
        assert list(ours) == list(theirs)
        for step, arrays in theirs.items():
            assert ours[step].keys() == arrays.keys()
            for name, array in arrays.items():
                np.testing.assert_array_equal(ours[step][name], array, err_msg=f"{step} {name}")
    assert progress_of(run) == progress_of(unbroken)


def stopped(data: Path, run: Path, number: signal.Signals) -> int:
    """Exit status of a process that gets a signal once two states are there, and has not ended then."""
    errors_file = run.parent / "errors"  # no pipe, which nobody reads meanwhile and what a compiler says may fill
    with errors_file.open("wb") as errors_out:
        process = subprocess.Popen(
            command_of("kinetix_dist.cli.main", *command(data, run)),
            cwd=REPOSITORY,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
            stdout=subprocess.DEVNULL,
            stderr=errors_out,
        )
    try:
        deadline = time.monotonic() + DEADLINE_S
        while len(list_checkpoints(run / "state")) < 2:
            assert process.poll() is None and time.monotonic() < deadline, errors_file.read_text()[-2000:]
            time.sleep(0.01)
        process.send_signal(number)
        process.wait(timeout=60)
    finally:
        process.kill()
    errors = errors_file.read_bytes()
    assert not (run / "checkpoints" / f"{STEPS:08d}").exists()
    assert (b"the same command goes on" in errors) == (number == signal.SIGTERM)
    return process.returncode


@pytest.mark.long
def test_a_killed_training_goes_on_to_the_same_bytes(
    data: Path, unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert stopped(data, run, signal.SIGKILL) == -signal.SIGKILL
    # What a kill may leave besides: a line and a checkpoint behind the newest state, a draft, half a line.
    newest = int(list_checkpoints(run / "state")[-1].name)
    with (run / "progress.jsonl").open("a") as file:
        file.write(json.dumps({"step": newest + 10, "seconds": 1.0, "loss": 9.0, "held_out_loss": 9.0}) + '\n{"st')
    (run / "state" / ".saving-00000150-1@elsewhere").mkdir(exist_ok=True)
    assert main(command(data, run)) == 0
    assert f"goes on after step {newest} of {STEPS}" in capsys.readouterr().out
    assert_same(run, unbroken)
    assert not list((run / "state").glob(".saving*"))


@pytest.mark.long
def test_a_stopped_training_saves_and_goes_on_to_the_same_bytes(data: Path, unbroken: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert stopped(data, run, signal.SIGTERM) == 75
    assert main(command(data, run)) == 0
    assert_same(run, unbroken)


def test_a_damaged_state_is_passed_over_for_the_one_before(
    data: Path, unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(unbroken, tmp_path / "run")
    (run / "state" / f"{STEPS:08d}" / "manifest.json").write_text("{")
    assert main(command(data, run)) == 0
    printed = capsys.readouterr().out
    assert f"{STEPS:08d} passed over: " in printed and f"goes on after step {STEPS - 10} of {STEPS}" in printed
    assert_same(run, unbroken)


def test_more_steps_train_it_further(data: Path, unbroken: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(command(data, run, steps=STEPS // 2)) == 0
    assert main(command(data, run)) == 0
    for folder in ("checkpoints", "state"):
        ours, theirs = (load_checkpoint(each / folder / f"{STEPS:08d}").arrays for each in (run, unbroken))
        for name, array in theirs.items():
            np.testing.assert_array_equal(ours[name], array)
    assert progress_of(run) == progress_of(unbroken)


def test_a_training_that_diverges_ends_in_one_line_and_stores_no_number_that_is_none(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main([*command(data, run), "--learning-rate", "1e30", "--warmup-steps", "0"]) == 2
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert "training has diverged by step 10 (loss nan, held out nan); lower --learning-rate" in line
    assert "loss nan" not in said.out
    assert not list_checkpoints(run / "state") and not list_checkpoints(run / "checkpoints")
    assert not (run / "progress.jsonl").exists()


def test_what_was_stored_before_a_divergence_stays(
    data: Path, unbroken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(unbroken, tmp_path / "run")
    original = cloning._many_steps

    def diverging(*given: Any) -> Any:
        params, state, loss = original(*given)
        return jax.tree.map(lambda x: x * np.nan, params), state, loss

    monkeypatch.setattr(cloning, "_many_steps", diverging)
    assert main(command(data, run, steps=STEPS + 40)) == 2
    assert f"training has diverged by step {STEPS + 10}" in capsys.readouterr().err
    assert_same(run, unbroken)


def test_a_policy_that_is_not_finite_is_not_played(
    unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(unbroken, tmp_path / "run")
    shutil.rmtree(run / "checkpoints")
    newest = load_checkpoint(list_checkpoints(unbroken / "checkpoints")[-1])
    arrays = {name: array * np.float32(np.nan) for name, array in newest.arrays.items()}
    with pytest.raises(CheckpointError, match="is not finite"):
        save_checkpoint(run / "checkpoints", STEPS, arrays, newest.description, keep=9)
    with monkeypatch_of_earlier_versions():
        save_checkpoint(run / "checkpoints", STEPS, arrays, newest.description, keep=9)
    written = run / "checkpoints" / f"{STEPS:08d}"
    for path in (written, run):
        assert main(["bench", "delay", "--policy", str(path), "--levels", "s/kick", "--episodes", "1"]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(CheckpointError, match="is not finite, so that no policy plays by it"):
        load_checkpoint(written)


@contextlib.contextmanager
def monkeypatch_of_earlier_versions() -> Iterator[None]:
    """Checkpoints are written without a look at their numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "name_not_finite", lambda arrays: None)
        yield


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--learning-rate", "1e-3"), "holds another training: training.learning_rate 0.001 instead of 0.0003"),
        (("--horizon", "6"), "holds another training: flow.horizon 6 instead of 4"),
        (("--solved-only",), "no episode of the data set ended solved"),
        (("--steps", "100"), "has 200 steps already; give --steps 200 or more"),
        (("--save-seconds", "-1"), "--save-seconds is -1"),
        (("--save-seconds", "nan"), "--save-seconds is nan"),
    ],
)
def test_what_cannot_go_on_is_one_line(
    options: tuple[str, ...], message: str, data: Path, unbroken: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in unbroken.rglob("*") if path.is_file() and path.name != "lock"}
    assert main([*command(data, unbroken), *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_other_data_or_a_directory_of_something_else_is_one_line(
    data: Path, unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command(data, unbroken), "--data", str(data), str(data)]) == 2
    assert "holds another training: data.1 " in (error := capsys.readouterr().err) and error.count("\n") == 1
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    assert main(command(data, tmp_path / "run")) == 2
    assert "is not empty, and holds no training of clone-flow; choose another --run" in capsys.readouterr().err
    assert main([*command(data, tmp_path / "new"), "--horizon", "4", "--max-delay", "8"]) == 2
    assert (
        "--max-delay is 8, but a chunk has 4 actions" in (error := capsys.readouterr().err) and error.count("\n") == 1
    )
    shutil.copytree(unbroken, tmp_path / "copy")
    (tmp_path / "copy" / "clone_flow.json").write_text("{")
    assert main(command(data, tmp_path / "copy")) == 2
    assert "clone_flow.json cannot be read" in (error := capsys.readouterr().err) and error.count("\n") == 1
