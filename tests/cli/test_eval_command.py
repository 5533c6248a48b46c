"""`kinetix-dist eval`: the table, the JSON file, and one line for whatever is wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.settings import preset
from kinetix_dist.checkpoint import flatten_arrays, save_checkpoint
from kinetix_dist.cli.eval_command import table
from kinetix_dist.cli.main import main
from kinetix_dist.cli.text_table import MAX_ROWS
from kinetix_dist.config import RunConfig, TrainConfig, to_dict
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.evaluate import SolveRate, SolveRates
from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.recordings import read_rollouts
from kinetix_dist.learner.state import adam, init_learner_state
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy
from tests.env.worlds import batch, small_level
from tests.helpers import REPOSITORY

LEVELS = str(REPOSITORY / "levels" / "s")
SHORT = EnvConfig(size="s", max_steps=8)


def save_run(run: Path, policy: PolicyConfig, env_config: EnvConfig = SHORT) -> Path:
    """A run directory with one checkpoint of a policy that has not learned anything; returns the checkpoint."""
    if policy.network == "flat":
        env_config = dataclasses.replace(env_config, observation="flat")
    config = TrainConfig(env=env_config, policy=policy, run=RunConfig(total_env_steps=1))
    env = Environment(env_config)
    prepared = env.prepare(batch(small_level()))
    module = make_policy(policy, env.action_distribution.head_sizes)
    params = init_params(module, env.observe(prepared, prepared.initial_obs), jax.random.key(0))
    state = init_learner_state(params, adam(1e-3, epsilon=1e-5), jax.random.key(1))
    arrays = flatten_arrays({"learner": state})
    description = {"config": to_dict(config)}
    return save_checkpoint(run / "checkpoints", 7, arrays, description, keep=1)


TINY_POLICY = PolicyConfig(encoder_size=8, hidden_size=8, hidden_layers=1, num_layers=1, attention_features=8)


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "small"
    save_run(run, TINY_POLICY)
    return run


def test_a_run_is_evaluated_level_by_level_next_to_the_baselines(
    run_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "rates.json"
    arguments = ["--run", str(run_directory), "--levels", LEVELS, "--attempts", "2", "--json", str(target)]
    assert main(["eval", *arguments]) == 0
    printed = capsys.readouterr().out
    names = sorted(file.stem for file in Path(LEVELS).glob("*.json"))
    for text in (*names, "all, trained", "all, random", "all, noop", "95 % interval"):
        assert text in printed
    content = json.loads(target.read_text())
    assert list(content["solve_rate"]) == ["trained", "random", "noop"]
    assert content["policy_version"] == 7
    trained = content["solve_rate"]["trained"]
    assert trained["attempts"] == 2 * len(names)
    assert [level["name"] for level in trained["levels"]] == names
    assert 0 <= trained["low"] <= trained["rate"] <= trained["high"] <= 1
    solved = [level["solved"] for level in trained["levels"]]
    assert trained["best_of"] == {"1": pytest.approx(trained["rate"]), "2": np.mean(np.array(solved) > 0)}
    assert trained["worst_tenth"] == min(solved) / 2
    random = content["solve_rate"]["random"]["rate"]
    assert content["above_random"]["trained"] == pytest.approx((trained["rate"] - random) / (1 - random))
    assert content["above_random"]["random"] is None and "random: worst tenth of the levels" in printed


def test_a_policy_plays_levels_of_a_larger_size_than_its_own(
    run_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = next((run_directory / "checkpoints").iterdir())
    arguments = ["--checkpoint", str(checkpoint), "--levels", LEVELS, "--size", "m", "--attempts", "20", "--greedy"]
    target = tmp_path / "rates.json"
    assert main(["eval", *arguments, "--no-baselines", "--json", str(target)]) == 0
    printed = capsys.readouterr().out
    assert "all, trained" in printed and "all, random" not in printed
    assert "one attempt each (all 20 are the same, since nothing is drawn: n is the number of levels)" in printed
    content = json.loads(target.read_text())
    trained = content["solve_rate"]["trained"]
    assert content["attempts_per_level"] == 1 and trained["attempts"] == len(trained["levels"])
    assert (trained["low"], trained["high"]) == wilson_interval(trained["solved"], trained["attempts"])


def test_a_long_table_says_what_it_leaves_out() -> None:
    level = SolveRate(
        name="level", rate=0.5, attempts=2, low=0.1, high=0.9, solved=1, failed=1, timed_out=0, unstable=0,
        mean_return=0.0, mean_length=3.0,
    )  # fmt: skip
    lines = table("random", {"random": SolveRates(total=level, levels=(level,) * (MAX_ROWS + 3))}).splitlines()
    assert sum(line.startswith("level ") for line in lines) == 1 + MAX_ROWS
    assert "... 3 more levels; --json FILE has all" in lines


def test_a_run_directory_given_as_a_checkpoint_is_pointed_out(
    run_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "give it as --run" in refusal(capsys, "--levels", LEVELS, "--checkpoint", str(run_directory))


def test_what_was_played_can_be_recorded(
    run_directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "played.mcap"
    arguments = ["--run", str(run_directory), "--levels", LEVELS, "--attempts", "1", "--no-baselines"]
    assert main(["eval", *arguments, "--json", str(tmp_path / "rates.json"), "--record", str(target)]) == 0
    assert f"kinetix-dist replay {target} --list" in capsys.readouterr().out
    rollouts = read_rollouts(target).rollouts
    levels = json.loads((tmp_path / "rates.json").read_text())["solve_rate"]["trained"]["levels"]
    assert [rollout.level_name for rollout in rollouts] == [level["name"] for level in levels]
    assert [rollout.solved for rollout in rollouts] == [bool(level["solved"]) for level in levels]
    assert {rollout.policy_version for rollout in rollouts} == {7}


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Line of an evaluation that must not start; its exit status is 2."""
    assert main(["eval", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--levels", LEVELS], "--run or --checkpoint, neither was given"),
        (["--levels", LEVELS, "--run", "a", "--checkpoint", "b"], "both were given"),
        (["--levels", LEVELS, "--run", "a", "--policy", "noop"], "plays without --run"),
        (["--levels", LEVELS, "--run", "no/such/run"], "no/such/run is not a directory"),
        (["--levels", LEVELS, "--checkpoint", "no/such"], "there is no checkpoint no/such"),
        (["--levels", "hopscotch", "--policy", "random"], "unknown level set 'hopscotch'"),
        (["--levels", LEVELS, "--policy", "random", "--size", "xl"], "unknown size 'xl'"),
        (["--levels", LEVELS, "--policy", "random", "--attempts", "0"], "--attempts is 0"),
        (["--levels", LEVELS, "--policy", "random", "--attempts", str(10**12)], "; give 1,000,000 or less"),
        (["--levels", LEVELS, "--policy", "random", "--max-worlds", str(10**30)], "; give 16,777,216 or less"),
        (["--levels", LEVELS, "--policy", "random", "--json", "no/such/file.json"], "cannot write no/such/file.json"),
        (["--levels", LEVELS, "--policy", "random", "--record", "no/such/file.mcap"], "cannot write no/such/file.mcap"),
        (["--levels", LEVELS, "--policy", "random", "--record", "README.md"], "README.md exists and recordings are"),
        (["--levels", LEVELS, "--policy", "clever"], "clever"),
    ],
)
def test_bad_requests_get_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in refusal(capsys, *arguments)


def test_a_run_without_checkpoints_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no checkpoint that can be used" in refusal(capsys, "--levels", LEVELS, "--run", str(tmp_path))


def test_a_damaged_checkpoint_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = save_run(tmp_path, PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1))
    (checkpoint / "checkpoint.json").write_text("{}")
    error = refusal(capsys, "--levels", LEVELS, "--checkpoint", str(checkpoint))
    assert "is damaged" in error and "checkpoint.json" in error


def test_a_flat_policy_cannot_play_another_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = save_run(tmp_path, PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1))
    error = refusal(capsys, "--levels", LEVELS, "--checkpoint", str(checkpoint), "--size", "m")
    assert "does not fit levels of size m: array" in error


def test_a_policy_plays_with_its_physics_or_with_another_preset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = save_run(tmp_path, TINY_POLICY, dataclasses.replace(SHORT, physics=preset("draft")))
    options = ["--checkpoint", str(checkpoint), "--levels", "s/kick", "--attempts", "1", "--no-baselines"]
    assert main(["eval", *options]) == 0
    assert "physics draft\n" in capsys.readouterr().out
    assert main(["eval", *options, "--env.preset", "fine", "--json", str(tmp_path / "rates.json")]) == 0
    assert json.loads((tmp_path / "rates.json").read_text())["physics"] == "fine"
    assert main(["eval", *options, "--env.preset", "perfect"]) == 2
    assert "unknown preset 'perfect'" in capsys.readouterr().err
