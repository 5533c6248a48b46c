"""Programs of a learner: an exported update where all code is of this project, another one for other settings of PPO;
and the state that it restores a checkpoint into."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import pytest
from flax import linen as nn

from kinetix_dist.learner.exported_on_mesh import exported_on_mesh
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import NETWORKS, init_params
from kinetix_dist.runtime.cores import learner_core
from kinetix_dist.runtime.cores.learner_core import LearnerCore, initial_state
from kinetix_dist.runtime.cores.playing import Playing, make_environment
from tests.helpers import compile_cache
from tests.runtime.runs import tiny_config


class OfAUser(nn.Module):
    head_sizes: tuple[int, ...]


def test_a_learner_exports_what_is_of_this_project_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of others may change, and no file of the cache would be another."""
    mesh = data_mesh(jax.devices()[:1])

    def is_exported(config: Any) -> bool:
        learner = LearnerCore(config, make_environment(config), Playing(config, mesh).policy, mesh)
        return learner._update.__module__ == exported_on_mesh.__module__

    config = tiny_config(num_updates=1)
    assert is_exported(config)
    plugins = dataclasses.replace(config.run, plugins=("tests.runtime.fake_curriculum",))
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


def test_shapes_of_a_resumed_state_are_traced_once_and_read_by_the_next_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, mesh = tiny_config(num_updates=1), data_mesh(jax.devices()[:1])
    env, policy = make_environment(config), Playing(config, mesh).policy
    traced = []

    def counting(*arguments: Any) -> Any:
        traced.append(arguments)
        return init_params(*arguments)

    monkeypatch.setattr(learner_core, "init_params", counting)
    expected = jax.eval_shape(lambda: initial_state(config, env, policy))
    with compile_cache(tmp_path):
        for process in range(2):
            assert learner_core._shapes_of_state(config, env, policy) == expected
            assert len(traced) == 2, process
        (file,) = (tmp_path / "shapes").iterdir()
        # Another network has a file of its own, and what is not of this project none.
        deeper = dataclasses.replace(config, policy=dataclasses.replace(config.policy, num_layers=2))
        module = Playing(deeper, mesh).policy
        found = learner_core._shapes_of_state(deeper, env, module)
        assert found == jax.eval_shape(lambda: initial_state(deeper, env, module)) != expected
        plugins = dataclasses.replace(config, run=dataclasses.replace(config.run, plugins=("json",)))
        traced.clear()
        assert learner_core._shapes_of_state(plugins, env, policy) == expected and len(traced) == 1
        assert len(list((tmp_path / "shapes").iterdir())) == 2
        file.write_bytes(file.read_bytes()[:-1])  # a damaged one is written again
        assert learner_core._shapes_of_state(config, env, policy) == expected and len(traced) == 2
