"""Imitation of proofs before training: what is learned from, that it solves the level, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import index_worlds
from kinetix_dist import prng
from kinetix_dist.cli.main import main
from kinetix_dist.config import ConfigError, ImitationConfig, TrainConfig
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import proof_path, read_proof, write_proof
from kinetix_dist.level.structure import LevelFormatError
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime import make_environment
from kinetix_dist.runtime.cores.imitation import DivergedError, Imitated, imitate, one_pool
from kinetix_dist.runtime.cores.proof_samples import WORLDS, levels_and_proofs, samples_of_proofs

LEVEL = levels_root() / "s" / "hop_home.json"
STEPS = 50


@pytest.fixture
def level(tmp_path: Path) -> Path:
    """A level file of a user, with its proof."""
    file = Path(shutil.copy(LEVEL, tmp_path / "mine.json"))
    shutil.copy(proof_path(LEVEL), proof_path(file))
    return file


def config_of(level: Path, **run: Any) -> TrainConfig:
    """Recipe `teach`, whose own network is small."""
    base = recipe("teach")
    return dataclasses.replace(
        base,
        curriculum=dataclasses.replace(base.curriculum, levels=str(level)),
        evaluation=dataclasses.replace(base.evaluation, sets=(str(level),)),
        run=dataclasses.replace(base.run, imitation_steps=STEPS, **run),
    )


def test_samples_are_the_steps_of_the_proof_from_starts_that_it_solves(level: Path) -> None:
    config = config_of(level)
    proof = read_proof(proof_path(level))
    samples = samples_of_proofs(config, make_environment(config))
    num_samples = len(samples.actions)
    assert num_samples >= WORLDS // 2 * proof.num_steps  # all worlds that begin as the level does, at least
    assert {tuple(action) for action in samples.actions} == {tuple(action) for action in proof.actions}
    # The last step of an episode has the reward of solving, the first one that discounted.
    last, first = samples.returns.max(), samples.returns[: WORLDS // 2]
    assert last > 0.9 and np.all(first < last) and np.all(first > config.ppo.discount**proof.num_steps * 0.9)


def test_the_policy_becomes_likely_to_act_as_the_proof_does(level: Path) -> None:
    config = config_of(level)
    env = make_environment(config)
    samples = samples_of_proofs(config, env)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    static, bound, obs = jax.tree.map(
        jnp.asarray, (index_worlds(samples.static_obs, samples.level), samples.bound_heads[samples.level], samples)
    )
    obs = env.observation.join(static, obs.dynamic_obs)
    params = init_params(policy, jax.tree.map(lambda x: x[:1], obs), prng.key(0))

    def log_prob(params: Any) -> float:
        outputs, _ = policy.apply(params, obs)
        of_actions, _ = env.action_distribution.log_prob_and_entropy(outputs, jnp.asarray(samples.actions), bound=bound)
        return float(of_actions.mean())

    def imitated() -> Imitated:
        return imitate(env, policy, params, one_pool(samples), ImitationConfig(), steps=STEPS, seed=0)

    after, steps, loss, curve = imitated()
    assert steps == STEPS and not curve  # nothing is held out
    assert log_prob(after) > log_prob(params) + 0.003, (log_prob(params), log_prob(after))  # few steps, from scratch
    again, _, same, _ = imitated()
    assert same == loss and jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), after, again))


@pytest.mark.slow  # a network of the size of pretrained ones learns for minutes; long tests teach by the page
def test_a_level_that_is_never_solved_is_solved_after_imitation_and_ends_the_run(tmp_path: Path) -> None:
    level, run = tmp_path / "mine.json", tmp_path / "run"
    never_solved = levels_root() / "s" / "aim_rocket.json"
    shutil.copy(never_solved, level)
    shutil.copy(proof_path(never_solved), proof_path(level))
    options = ["--recipe", "teach", "--from", "generalist", "--levels", str(level), "--run", str(run)]
    assert main(["finetune", *options, "--run.imitation_steps", "150", "--run.stop_at", "0.5"]) == 0
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    [imitated] = [event for event in events if event["event"] == "imitated"]
    assert imitated["steps"] == 150 and imitated["loss"] < 0.1
    rows = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    solved = {(row["phase"], row["update"]): sum(row["sets"][str(level)]["solved"]) for row in rows}
    assert solved["before", 0] < 6 and solved["training", 0] == solved["after", 0] > 32, solved
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["00000000"]  # without any update


@pytest.mark.parametrize("every", [5, 1000])
def test_imitation_that_diverges_names_the_gradient_step(level: Path, every: int) -> None:
    config = config_of(level)
    env = make_environment(config)
    samples = samples_of_proofs(config, env)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    obs = env.observation.join(
        jax.tree.map(lambda x: x[:1], samples.static_obs), jax.tree.map(lambda x: x[:1], samples.dynamic_obs)
    )
    settings = dataclasses.replace(config.imitation, learning_rate=1e30, every=every)
    with pytest.raises(DivergedError, match=r"diverged at gradient step [1-5]: its loss is not finite"):
        imitate(env, policy, init_params(policy, obs, prng.key(0)), one_pool(samples), settings, steps=20, seed=0)


def test_a_run_whose_imitation_diverges_ends_in_one_line_without_a_checkpoint(
    level: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    words = ["--recipe", "teach", "--curriculum.levels", str(level), "--evaluation.sets", str(level), "--run", str(run)]
    words += ["--imitation.learning_rate", "1e30", "--run.imitation_steps", "8", "--run.placement", "local"]
    assert main(["train", *words]) == 1
    assert "diverged at gradient step" in (line := capsys.readouterr().err.splitlines()[-1])
    assert "lower imitation.learning_rate" in line
    assert not list((run / "checkpoints").glob("*")) and not (run / "report.json").exists()


def test_levels_without_a_proof_are_refused_in_one_line(level: Path) -> None:
    proof_path(level).unlink()
    config = config_of(level)
    with pytest.raises(FileNotFoundError, match=r"has no proof .*`levels solve` searches for one"):
        levels_and_proofs(config, make_environment(config))


def test_proofs_of_another_level_or_of_other_settings_are_refused(level: Path) -> None:
    config = config_of(level)
    document = json.loads(level.read_text())
    level.write_text(json.dumps(document | {"gravity": [0.0, -5.0]}))
    with pytest.raises(LevelFormatError, match="the proof is of another level"):
        levels_and_proofs(config, make_environment(config))
    level.write_text(json.dumps(document))
    other = dataclasses.replace(config, env=dataclasses.replace(config.env, frame_skip=4))
    with pytest.raises(LevelFormatError, match="frame_skip: is 2, requested is 4"):
        levels_and_proofs(other, make_environment(other))


def test_a_proof_that_does_not_solve_its_level_is_refused(level: Path) -> None:
    proof = read_proof(proof_path(level))
    write_proof(proof_path(level), dataclasses.replace(proof, actions=np.zeros_like(proof.actions)))
    config = config_of(level)
    with pytest.raises(ValueError, match="its proof does not solve it; find it again: `levels solve --again`"):
        samples_of_proofs(config, make_environment(config))


@pytest.mark.parametrize(
    ("section", "change", "text"),
    [
        ("run", {"placement": "colocated"}, "needs run.placement 'local', not 'colocated'"),
        ("curriculum", {"name": "sfl", "levels": ""}, "needs curriculum.name 'fixed', not 'sfl'"),
        ("policy", {"recurrent": "gru"}, "needs policy.recurrent 'none', not 'gru'"),
    ],
)
def test_settings_that_cannot_imitate_are_refused(level: Path, section: str, change: dict[str, str], text: str) -> None:
    config = config_of(level)
    with pytest.raises(ConfigError, match=text):
        dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), **change)})


def test_the_steps_are_part_of_what_a_run_is_known_by(level: Path) -> None:
    config = config_of(level)
    assert config.hash != dataclasses.replace(config, run=dataclasses.replace(config.run, imitation_steps=0)).hash
