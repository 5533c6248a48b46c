"""The update of a learner: an exported one of parts of this project, another one for other settings of PPO."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import pytest
from flax import linen as nn

from kinetix_dist import program_cache
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import NETWORKS
from kinetix_dist.runtime.cores.learner_core import LearnerCore
from kinetix_dist.runtime.cores.playing import Playing, make_environment
from tests.runtime.runs import tiny_config


class OfAUser(nn.Module):
    head_sizes: tuple[int, ...]


def test_a_learner_exports_what_is_of_this_project_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of others may change, and no file of the cache would be another."""
    mesh = data_mesh(jax.devices()[:1])

    def is_exported(config: Any) -> bool:
        learner = LearnerCore(config, make_environment(config), Playing(config, mesh).policy, mesh)
        return learner._update.__module__ == program_cache.__name__

    config = tiny_config(num_updates=1)
    assert is_exported(config)
    plugins = dataclasses.replace(config.run, plugins=("examples.own_curriculum",))
    assert not is_exported(dataclasses.replace(config, run=plugins))
    of_a_user = dataclasses.replace(NETWORKS["transformer"], build=lambda config, head_sizes: OfAUser(head_sizes))
    monkeypatch.setattr(NETWORKS, "_parts", {**NETWORKS._parts, "transformer": of_a_user})
    assert not is_exported(config)


def test_phases_with_other_settings_of_ppo_are_other_programs() -> None:
    config, mesh = tiny_config(num_updates=1), data_mesh(jax.devices()[:1])
    learner = LearnerCore(config, make_environment(config), Playing(config, mesh).policy, mesh)
    before = learner._update
    learner.set_ppo(dataclasses.replace(config.ppo, clip=0.1))
    assert learner._update is not before
    learner.set_ppo(config.ppo)
    assert learner._update is before
