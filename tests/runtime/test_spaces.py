"""Policies of every observation are trained in every action space."""

from __future__ import annotations

import dataclasses
import math

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.env import device_memory
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.worker import Worker

pytestmark = pytest.mark.long

NETWORK_OF = {"entity": "transformer", "entity_kinetix": "transformer_kinetix", "flat": "flat", "pixels": "cnn"}
# Entropy of the first policy, nearly: of six uniform choices, of one of eleven, of six truncated normals whose spread
# is half of half the range (scipy.stats.truncnorm), four of them on a range of 2 and two on a range of 1.
FIRST_ENTROPY = {
    "multi_discrete": 4 * math.log(3) + 2 * math.log(2),
    "discrete": math.log(11),
    "continuous": 6 * 0.5661 - 2 * math.log(2),
}
PLAIN = {("entity", "continuous"), ("flat", "discrete"), ("pixels", "multi_discrete")}
COMBINATIONS = [
    pytest.param(observation, space, marks=[] if (observation, space) in PLAIN else pytest.mark.slow)
    for observation in NETWORK_OF
    for space in ACTION_SPACES
]


def config_of(observation: str, space: str) -> TrainConfig:
    tiny = recipe("tiny")
    return dataclasses.replace(
        tiny,
        env=dataclasses.replace(tiny.env, observation=observation, action_space=space, max_steps=4),
        # Every head learns, and the entropy is that of all.
        ppo=dataclasses.replace(tiny.ppo, mask_unbound_heads=False),
        policy=dataclasses.replace(tiny.policy, network=NETWORK_OF[observation], flat_size=16),
        # Few samples: for pictures each takes a tenth of a second to learn from without most optimisations.
        rollout=dataclasses.replace(tiny.rollout, num_envs=4, num_steps=4),
        curriculum=CurriculumConfig(name="fixed", levels="s/hop_home"),
    )


@pytest.mark.parametrize(("observation", "space"), COMBINATIONS)
def test_a_policy_is_trained(observation: str, space: str):
    worker = Worker(config_of(observation, space), data_mesh())
    worker.start(None)
    before = worker.weights()
    for update in range(3):
        metrics, *_ = worker.run_update(update)
        assert all(np.isfinite(value) for value in metrics.values()), metrics
        assert metrics["learner/skipped_steps"] == 0 and metrics["learner/grad_norm"] > 0
        assert metrics["physics/invalid_actions"] == 0
        if not update:
            assert metrics["learner/entropy"] == pytest.approx(FIRST_ENTROPY[space], abs=0.05)
            # What is learned from has the probabilities that it was played with.
            assert abs(metrics["learner/approx_kl"]) < 0.05
    towers = jax.tree.map(
        lambda new, old: bool((new != old).any()), worker.weights()["params"]["towers"], before["params"]["towers"]
    )
    assert all(jax.tree.leaves(towers))


@pytest.mark.slow
@pytest.mark.parametrize(("observation", "space"), [("pixels", "continuous"), ("flat", "discrete")])
def test_a_run_with_evaluation_and_recordings(observation: str, space: str, tmp_path):
    options = f"--env.observation {observation} --env.action_space {space} --policy.network {NETWORK_OF[observation]}"
    sections = "--recording.num_rollouts 2 --run.total_env_steps 256 --evaluation.min_attempts 10"
    sections += " --ppo.mask_unbound_heads False"
    arguments = [*options.split(), *sections.split(), "--evaluation.sets", "s/hop_home"]
    assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *arguments]) == 0
    assert main(["eval", "--run", str(tmp_path / "run"), "--levels", "s/hop_home"]) == 0
    assert list((tmp_path / "run" / "recordings").glob("*.mcap"))


def test_a_batch_of_pictures_that_does_not_fit_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(device_memory, "device_bytes", lambda: 10 * 2**20)
    options = "--env.observation pixels --policy.network cnn --ppo.minibatches 1"
    arguments = ["train", "--recipe", "tiny", "--run", str(tmp_path / "run"), *options.split()]
    assert main(arguments) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "samples of a minibatch on a device: 128 take 0.1 GiB at once" in line
    assert "at most 12 fit; raise ppo.minibatches" in line


def test_an_observation_that_the_network_does_not_take_is_refused_with_one_that_does(capsys):
    assert main(["train", "--recipe", "tiny", "--env.observation", "pixels"]) == 2
    assert "gives image, but policy.network 'transformer' takes entities; use policy.network 'cnn'" in (
        capsys.readouterr().err
    )
