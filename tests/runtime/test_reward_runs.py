"""Runs with a reward: those of the package, and one of a user in a file outside of it, by the command line."""

import json

import numpy as np
import pytest

from kinetix_dist.cli.main import main

SHORT = ["--run.total_env_steps", "256", "--evaluation.sets", "s/hop_home", "--evaluation.min_attempts", "4"]
OWN = """
import jax.numpy as jnp
from kinetix_dist.env.rewards import REWARDS, Reward

class Still(Reward):
    uses_dense_scale = uses_discount = False

    def reward(self, step):
        return {expression}

REWARDS.register("{name}", Still())
"""


def metrics(run):
    return [json.loads(line) for line in (run / "metrics" / "metrics.jsonl").read_text().splitlines()]


def own_reward(tmp_path, monkeypatch, name, expression):
    """Options that choose a reward whose module is written into a folder outside of the package."""
    (tmp_path / f"{name}.py").write_text(OWN.format(name=name, expression=expression))
    monkeypatch.syspath_prepend(tmp_path)
    return ["--run.plugins", name, "--env.reward", name]


@pytest.mark.parametrize("reward", [pytest.param("sparse", marks=pytest.mark.long), "shaped"])
def test_a_reward_by_name(tmp_path, reward):
    options = ["--env.reward", reward, "--ppo.bootstrap_timeouts", "False", *SHORT]
    assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *options]) == 0
    rows = metrics(tmp_path / "run")
    assert len(rows) == 2 and all(row["learner/skipped_steps"] == 0 for row in rows)
    assert all(np.isfinite(row["learner/value_loss"]) and row["physics/invalid_rewards"] == 0 for row in rows)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["env"]["reward"] == reward


def test_a_reward_of_a_user_is_trained_resumed_and_evaluated(tmp_path, monkeypatch):
    options = own_reward(tmp_path, monkeypatch, "one_a_step", "jnp.ones_like(step.distance_after)")
    run = str(tmp_path / "run")
    assert main(["train", "--recipe", "tiny", "--run", run, *options, *SHORT]) == 0
    assert main(["train", "--run", run, "--resume", "--run.total_env_steps", "384"]) == 0
    assert [row["train/mean_reward"] for row in metrics(tmp_path / "run")] == [1.0] * 3
    assert main(["eval", "--run", run, "--levels", "s/hop_home", "--attempts", "2"]) == 0


def test_a_reward_of_a_user_that_is_not_finite_is_warned_of(tmp_path, monkeypatch, capsys):
    options = own_reward(tmp_path, monkeypatch, "root", "jnp.sqrt(step.distance_after - step.distance_before)")
    assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *options, *SHORT]) == 0
    rows = metrics(tmp_path / "run")
    assert rows[0]["physics/invalid_rewards"] > 0 and rows[0]["learner/skipped_steps"] == 0
    printed = capsys.readouterr()
    said = " ".join((printed.out + printed.err).split())
    assert "rewards were not finite and counted as 0" in said and "correct the reward that env.reward names" in said


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--env.reward sprse", "sprse"),
        ("--env.reward shaped", "ppo.bootstrap_timeouts does not; set that to False"),
        ("--env.dense_reward_scale 0", "EnvConfig.dense_reward_scale is 0; choose reward 'sparse'"),
    ],
)
def test_what_is_no_reward_is_refused_in_one_line(tmp_path, capsys, options, says):
    assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *options.split()]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert says in lines[-1] and len(lines) == 1
