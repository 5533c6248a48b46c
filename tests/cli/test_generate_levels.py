"""`kinetix-dist levels generate`: valid levels that do not solve themselves, by generator, autoencoder and teacher."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.checkpoint import flatten_arrays, save_checkpoint
from kinetix_dist.cli.main import main
from kinetix_dist.config import to_dict
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig
from kinetix_dist.curator.teacher import PARAMS_PREFIX, Teacher
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import PpoAgents
from tests.helpers import REPOSITORY
from tests.runtime.runs import tiny_config

NUM_LEVELS = 6


def generate(capsys: pytest.CaptureFixture[str], out: Path, *argv: str) -> list[str]:
    """Lines of stdout."""
    assert main(["levels", "generate", str(out), "--count", str(NUM_LEVELS), *argv]) == 0
    return capsys.readouterr().out.splitlines()


def refusal(capsys: pytest.CaptureFixture[str], out: Path, *argv: str) -> str:
    assert main(["levels", "generate", str(out), *argv]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def assert_playable(out: Path, size: str) -> None:
    """All are valid files of a size that do not solve themselves, and no two alike."""
    files = sorted(out.iterdir())
    assert len(files) == NUM_LEVELS
    assert {load_level(file)[1].size for file in files} == {size}
    levels, _ = load_level_set(str(out), size)
    assert not np.asarray(noop_solved(levels)).any()
    assert len({level.tobytes() for level in np.asarray(levels.position)}) == NUM_LEVELS


def run_with_teacher(directory: Path, scale: float) -> Path:
    """A run directory with a checkpoint of a teacher that has learned nothing, and chooses almost evenly, or, with its
    parameters scaled, has its mind made up."""
    config = tiny_config(num_updates=1)
    curriculum = CurriculumConfig(name="paired", paired=PairedConfig(hidden_size=16))
    config = dataclasses.replace(
        config,
        curriculum=curriculum,
        env=dataclasses.replace(config.env, max_steps=config.rollout.num_steps),  # what PAIRED asks for
    )
    env = Environment(config.env)
    agents = PpoAgents(config, env, make_policy(config.policy, env.action_distribution.head_sizes), data_mesh())
    teacher = Teacher(SIZES[config.env.size], curriculum.generator, curriculum.paired, agents)
    arrays = flatten_arrays({"curriculum": {"teacher": teacher.init()}})
    arrays |= {name: scale * array for name, array in arrays.items() if name.startswith(PARAMS_PREFIX)}
    save_checkpoint(directory / "checkpoints", 1, arrays, {"num_updates": 1, "config": to_dict(config)}, keep=1)
    return directory


def test_random_levels_are_those_of_the_generator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    [line] = generate(capsys, tmp_path / "random", "--size", "s", "--generator", "locomotion")
    assert line.startswith(f"wrote {NUM_LEVELS} levels of size s to {tmp_path / 'random'}; of ")
    assert_playable(tmp_path / "random", "s")


def test_levels_of_goal_following_have_the_size_of_the_body(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for body, size in (("car", "m"), ("snake", "l")):
        [line] = generate(capsys, tmp_path / body, "--body", body)
        assert f"levels of size {size} to" in line
        assert_playable(tmp_path / body, size)
    assert "unknown morphology 'cra'; there are car" in refusal(capsys, tmp_path / "no", "--body", "cra")
    assert "'snake' needs 5 polygons, there are 2" in refusal(capsys, tmp_path / "no", "--body", "snake", "--size", "m")
    assert "both say where levels come from" in refusal(capsys, tmp_path / "no", "--body", "car", "--like", "x")


@pytest.mark.long
def test_levels_like_those_of_a_directory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate(capsys, tmp_path / "random", "--size", "s")
    training, loss, wrote = generate(capsys, tmp_path / "like", "--like", str(tmp_path / "random"), "--steps", "100")
    assert training == f"training on {NUM_LEVELS} levels of size s: 100 steps"
    first, last = (float(word) for word in loss.split() if word[0].isdigit())
    assert last < first / 2 and wrote.startswith(f"wrote {NUM_LEVELS} levels of size s")
    assert_playable(tmp_path / "like", "s")


@pytest.mark.long
def test_levels_of_a_teacher_depend_on_what_it_learned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for scale in (1, 10):
        run = run_with_teacher(tmp_path / f"run_{scale}", scale)
        generate(capsys, tmp_path / f"taught_{scale}", "--teacher", str(run))
        assert_playable(tmp_path / f"taught_{scale}", "s")
    one, other = ((tmp_path / f"taught_{scale}" / "taught_0.json").read_text() for scale in (1, 10))
    assert one != other


def test_what_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert "--like and --teacher both say where levels come from" in refusal(
        capsys, out, "--like", "random_s", "--teacher", "runs/x"
    )
    assert "--count is 0; give 1 or more" in refusal(capsys, out, "--count", "0")
    assert "--size is for random levels" in refusal(capsys, out, "--like", "random_s", "--size", "m")
    assert "--steps is for the autoencoder" in refusal(capsys, out, "--steps", "3")
    assert "VaeConfig.num_steps is 0" in refusal(capsys, out, "--like", "random_s", "--steps", "0")
    assert "unknown generator 'fair'" in refusal(capsys, out, "--generator", "fair")
    assert "all_designed_s: hop_home: 1 of 1 levels have" in refusal(capsys, out, "--like", "all_designed_s")
    assert "is not a directory" in refusal(capsys, out, "--teacher", str(tmp_path / "none"))
    file = tmp_path / "a.json"
    file.write_text("{}")
    assert "is a file; give a directory" in refusal(capsys, file)
    assert "is not empty; name a new directory" in refusal(capsys, tmp_path)


KILLED = """
import os, signal
from kinetix_dist.cli.main import main
from kinetix_dist.level import schema

def save(level, path, info, save_level=schema.save_level):
    if path.name == "random_3.json":
        os.kill(os.getpid(), signal.SIGKILL)
    save_level(level, path, info)

schema.save_level = save
main(["levels", "generate", {out!r}, "--count", "6", "--size", "s"])
"""


@pytest.mark.parametrize("exists", [False, True])
def test_a_killed_command_leaves_no_levels_and_the_same_command_succeeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], exists: bool
) -> None:
    out = tmp_path / "levels"
    if exists:
        out.mkdir()
    code = KILLED.format(out=str(out))
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob("**/random_*.json"))) == 3, "three levels were on the disk"
    assert not list(out.glob("*.json"))
    generate(capsys, out, "--size", "s")
    assert sorted(path.name for path in out.iterdir()) == [f"random_{number}.json" for number in range(NUM_LEVELS)]
    assert [path.name for path in tmp_path.iterdir()] == ["levels"]
