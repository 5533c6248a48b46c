"""Cloning a data set: what is learned from, how it is weighed, when it stops, and that it solves more levels."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.cli.main import main
from kinetix_dist.config import ConfigError, ImitationConfig, TrainConfig
from kinetix_dist.data import DatasetError, Transitions, open_dataset
from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.data.rollout import ChosenBy
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.policies import NoopPolicy, Player
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime import make_environment
from kinetix_dist.runtime.cores.dataset_samples import returns_of, source_of_dataset, usable_samples
from kinetix_dist.runtime.cores.imitation import Best, Imitated, _log_probs, class_weights, imitate


def config_of(data: Path, env: EnvConfig | None = None, **imitation: Any) -> TrainConfig:
    """Recipe `tiny`, whose network compiles fast, in the environment of the small data set."""
    base = recipe("tiny")
    return dataclasses.replace(
        base,
        env=env or EnvConfig(size="s", max_steps=8),
        ppo=dataclasses.replace(base.ppo, discount=0.5),
        imitation=dataclasses.replace(ImitationConfig(data=str(data), held_out=0.3, batch_size=16), **imitation),
        run=dataclasses.replace(base.run, imitation_steps=20),
    )


def rows_of(**columns: list[Any]) -> Transitions:
    number = len(columns["rewards"])
    zeros = dict.fromkeys(Transitions._fields, np.zeros(number))
    return Transitions(**zeros | {name: np.array(column) for name, column in columns.items()})


def test_returns_are_discounted_to_the_end_of_the_episode_where_that_was_seen() -> None:
    rows = rows_of(
        rewards=[1.0, 2.0, 4.0, 8.0, 8.0],
        done=[False, False, True, False, False],
        episode=[0, 0, 0, 3, 3],
        step=[0, 1, 2, 0, 1],
    )
    returns, is_known = returns_of(rows, 0.5)
    np.testing.assert_array_equal(returns, [1 + 1 + 1, 2 + 2, 4, 8 + 4, 8])
    np.testing.assert_array_equal(is_known, [True, True, True, False, False])


def test_rows_of_two_shards_are_not_taken_for_one_episode() -> None:
    """An episode that was cut at the end of a shard, and rows that are missing in between."""
    rows = rows_of(rewards=[1.0, 1.0], done=[False, True], episode=[5, 5], step=[2, 7])
    np.testing.assert_array_equal(returns_of(rows, 0.5)[1], [False, True])


def test_a_share_of_the_levels_is_held_out_and_the_rest_is_what_the_policy_chose(collected: Path) -> None:
    source = source_of_dataset(config_of(collected))
    rows = open_dataset(collected).read()
    samples, count = next(source.pools)
    assert source.held_out is not None
    [held_out] = np.unique(source.held_out.level)
    learned = (rows.level != held_out) & (rows.chosen_by == ChosenBy.POLICY)
    assert count == len(samples.level) == learned.sum()
    np.testing.assert_array_equal(samples.actions, rows.actions[learned])
    np.testing.assert_array_equal(samples.dynamic_obs.bodies, rows.dynamic_obs.bodies[learned])
    assert source.about() == {"data": str(collected), "transitions": 240, "held_out_levels": 1, "skipped_shards": 0}
    others = {
        int(np.unique(source_of_dataset(_with_seed(collected, seed)).held_out.level)[0])  # pyrefly: ignore
        for seed in range(6)
    }
    assert len(others) > 1, "they are drawn from the seed"


def _with_seed(data: Path, seed: int) -> TrainConfig:
    config = config_of(data)
    return dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))


def test_a_data_set_of_noise_alone_is_refused(collected: Path) -> None:
    data = open_dataset(collected)
    rows = data.read()
    with pytest.raises(DatasetError, match="has nothing that its policy chose; collect it with less noise"):
        usable_samples(data, rows._replace(chosen_by=np.full_like(rows.chosen_by, ChosenBy.NOISE)), 0.5)


def test_a_large_data_set_is_learned_from_in_pools_of_one_shape(collected: Path) -> None:
    source = source_of_dataset(config_of(collected, held_out=0.0), pool_rows=100)
    pools = [next(source.pools) for _ in range(6)]
    assert source.steps_per_pool == 80 // 16 and {len(samples.level) for samples, _ in pools} == {80}
    for three in (pools[:3], pools[3:]):  # each pass has every row once
        learned = np.concatenate([samples.actions[:count] for samples, count in three])
        rows = open_dataset(collected).read()
        assert len(learned) == (rows.chosen_by == ChosenBy.POLICY).sum()


def test_damaged_shards_are_counted_where_they_are_skipped(data: Path) -> None:
    (data / "shard-000000.parquet").unlink()
    with pytest.raises(DatasetError, match=r"shard-000000.parquet is missing"):
        source_of_dataset(config_of(data))
    assert source_of_dataset(config_of(data, skip_damaged=True)).about()["skipped_shards"] == 1


def test_a_rare_choice_weighs_more_by_its_frequency(collection: Collection, collected: Path) -> None:
    samples, _ = next(source_of_dataset(config_of(collected, held_out=0.0)).pools)
    few = samples._replace(
        level=np.zeros(4, np.int32),
        actions=np.array([[0, 1, 0, 0, 0, 0]] * 3 + [[0, 2, 0, 0, 0, 0]], np.int8),
        bound_heads=np.array([[False, True, False, False, False, False]]),
    )
    space = collection.env.action_space

    def weights_at(class_balance: float) -> np.ndarray:
        found = class_weights(space, few, 4, ImitationConfig(class_balance=class_balance))
        assert found is not None
        return np.asarray(found)

    np.testing.assert_allclose(weights_at(1.0)[1], [0.0, 2 / 3, 2.0], rtol=1e-6)  # 3 of one weigh as 1 of the other
    half = weights_at(0.5)[1]
    assert half[2] / half[1] == pytest.approx(3**0.5) and (3 * half[1] + half[2]) / 4 == pytest.approx(1.0)
    np.testing.assert_array_equal(weights_at(1.0)[0], 1.0)  # nothing obeys it
    assert class_weights(space, few, 4, ImitationConfig()) is None


def test_weights_multiply_the_log_probability_of_their_choice(collection: Collection) -> None:
    outputs = tuple(jnp.asarray(np.random.default_rng(k).normal(size=(5, k)), jnp.float32) for k in (3, 3, 3, 3, 2, 2))
    actions = jnp.asarray(np.random.default_rng(0).integers(0, 2, (5, 6)), jnp.int8)
    bound = {"bound": jnp.asarray(np.random.default_rng(1).random((5, 6)) < 0.6)}
    plain = _log_probs(collection.env, outputs, actions, bound, None)
    np.testing.assert_allclose(_log_probs(collection.env, outputs, actions, bound, jnp.ones((6, 3))), plain, rtol=1e-5)
    np.testing.assert_allclose(
        _log_probs(collection.env, outputs, actions, bound, 2 * jnp.ones((6, 3))), 2 * plain, rtol=1e-5
    )


def _imitated(config: TrainConfig) -> Imitated:
    env = make_environment(config)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    shapes = jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), env.observation_space)
    params = init_params(policy, shapes, prng.key(0))
    return imitate(env, policy, params, source_of_dataset(config), config.imitation, steps=20, seed=0)


def test_the_best_is_kept_and_it_is_enough_after_as_many_that_are_no_better() -> None:
    best = Best(patience=2)
    scores = [0.5, 0.6, 0.6, 0.7, float("nan"), 0.1]
    assert [best.is_enough(score, number) for number, score in enumerate(scores)] == [False] * 5 + [True]
    assert best.kept == 3


@pytest.mark.long  # two more programs are compiled
def test_the_parameters_are_those_with_the_most_actions_alike_on_held_out_levels(collected: Path) -> None:
    """A rate at which anything but the first steps does harm."""
    stopped = _imitated(config_of(collected, learning_rate=1.0, every=2, patience=2))
    steps, alike = ([point[name] for point in stopped.curve] for name in ("step", "accuracy"))
    assert stopped.steps == steps[int(np.argmax(alike))], stopped.curve
    assert steps[-1] == 20 or steps[-1] - stopped.steps == 2 * 2
    whole = _imitated(config_of(collected, learning_rate=1.0, every=2))
    assert whole.steps == whole.curve[-1]["step"] == 20, "it is scored, and does not stop"
    assert whole.curve[: len(stopped.curve)] == stopped.curve


@pytest.mark.long  # another action space: its programs are compiled
def test_continuous_actions_are_imitated(collection: Collection, tmp_path: Path) -> None:
    """Actions that are 0 in all dimensions."""
    env = Environment(EnvConfig(size="s", max_steps=8, action_space="continuous"))
    player = Player(NoopPolicy(env.action_space))
    continuous = dataclasses.replace(collection, env=env, player=player)
    collect(continuous, tmp_path / "data", 1)
    rows = open_dataset(tmp_path / "data").read()
    assert rows.actions.dtype == np.float32
    of_policy = rows.chosen_by == ChosenBy.POLICY
    assert np.all(rows.log_prob[of_policy] == 0.0) and np.all(
        np.isneginf(rows.log_prob[rows.chosen_by == ChosenBy.NOISE])
    )
    config = config_of(tmp_path / "data", env.config, learning_rate=0.02, every=5)
    found = _imitated(config)
    assert found.curve[-1]["loss"] < found.curve[0]["loss"], found.curve


@pytest.mark.parametrize(
    ("imitation", "run", "text"),
    [
        ({}, {"imitation_steps": 0}, "imitation.data is .* but run.imitation_steps is 0"),
        ({}, {"placement": "colocated"}, "needs run.placement 'local', not 'colocated'"),
        ({"held_out": 1.0}, {}, "ImitationConfig.held_out is 1.0; it must be 0 or more and below 1"),
        ({"patience": -1}, {}, "ImitationConfig.patience is -1; it must be 0 or more"),
    ],
)
def test_settings_that_cannot_clone_are_refused(
    tmp_path: Path, imitation: dict[str, Any], run: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigError, match=text):
        config = config_of(tmp_path, **imitation)
        dataclasses.replace(config, run=dataclasses.replace(config.run, **run))


def test_class_weights_are_for_choices(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"with imitation.class_balance 1 needs env.action_space 'multi_discrete', no"
    ):
        config_of(tmp_path, EnvConfig(size="s", max_steps=8, action_space="continuous"), class_balance=1.0)


def test_too_few_levels_to_hold_any_out_are_refused(collected: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"imitation.held_out 0.9 of 3 levels leaves none to learn from; set it to 0"
    ):
        source_of_dataset(config_of(collected, held_out=0.9))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--recipe", "clone_m"], "is of env.size 's', not 'm'; set env.size to that, or give another data set"),
        (["--recipe", "clone_s", "--env.frame_skip", "4"], "is of env.frame_skip"),
        (["--recipe", "tiny"], "but run.imitation_steps is 0"),
    ],
)
def test_a_command_refuses_another_data_set_in_one_line(
    collected: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], text: str
) -> None:
    run = tmp_path / "run"
    assert main(["train", *options, "--data", str(collected), "--run", str(run), "--run.device", "cpu"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert text in line and not run.exists()


SMALL = ["--policy.network", "transformer", "--policy.read_out", "pooled", "--policy.max_qk_norm", "0"]
SMALL += ["--policy.encoder_size", "32", "--policy.num_layers", "1", "--policy.hidden_size", "64"]
SMALL += ["--policy.hidden_layers", "1", "--policy.dtype", "float32", "--run.device", "cpu"]
LEVEL = "s/hop_home"


@pytest.mark.long  # a pretrained network plays, and another learns from it
def test_a_clone_solves_what_the_policy_of_the_data_solves(tmp_path: Path) -> None:
    data, run = tmp_path / "data", tmp_path / "run"
    sizes = ["--transitions", "16384", "--worlds", "32", "--shard-transitions", "8192"]
    assert main(["collect", "--policy", "generalist", "--levels", LEVEL, "--out", str(data), *sizes]) == 0
    clone = ["--recipe", "clone_s", *SMALL, "--imitation.batch_size", "128", "--imitation.held_out", "0"]
    clone += ["--evaluation.sets", LEVEL, "--evaluation.min_attempts", "100", "--run.imitation_steps", "400"]
    assert main(["train", *clone, "--data", str(data), "--run", str(run)]) == 0
    rates = json.loads((run / "report.json").read_text())["solve_rate"]
    before, after = (rates[phase][LEVEL] for phase in ("before", "after"))
    assert before["high"] < after["low"], (before, after)


@pytest.mark.long  # PPO is compiled
def test_ppo_goes_on_from_the_clone_and_a_resumed_run_does_not_clone_again(collected: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = ["--run.imitation_steps", "20", "--env.max_steps", "8", "--imitation.held_out", "0.3"]
    start = ["train", "--recipe", "tiny", *options, "--data", str(collected), "--run", str(run)]
    assert main([*start, "--run.total_env_steps", "128"]) == 0
    assert main(["train", "--run", str(run), "--resume", "--run.total_env_steps", "256"]) == 0
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    [imitated] = [event for event in events if event["event"] == "imitated"]
    assert imitated["transitions"] == 240 and len(imitated["curve"]) == 1
    assert json.loads((run / "report.json").read_text())["policy_updates"] == 2
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"00000000", "00000001", "00000002"}
