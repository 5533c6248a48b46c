"""The exported rollout: bit for bit the traced one, and a second process reads it instead of tracing."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curricula import CURRICULA
from kinetix_dist.curator.plr import Plr, RobustPlr
from kinetix_dist.env import device_memory
from kinetix_dist.env.device_memory import DeviceMemoryError
from kinetix_dist.env.observations import OBSERVATIONS, EntityObservation
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.program_cache import ProgramKey
from kinetix_dist.runtime.cores import rollout_core as module
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.rollout_core import CACHE
from tests.helpers import compile_cache, environment_of_cpus
from tests.runtime import closures_program, exported_rollout_program
from tests.runtime.runs import tiny_config

LIMIT_S = 300.0  # of a process that compiles


@pytest.mark.long
def test_another_process_reads_it_and_plays_the_same_bits(tmp_path: Path) -> None:
    with compile_cache(tmp_path):
        module._cached.cache_clear()
        traced, exported = (exported_rollout_program.play(is_exported=is_exported) for is_exported in (False, True))
        module._cached.cache_clear()
    assert exported["content"] == traced["content"]
    assert exported["traced"] == 1
    (file,) = (tmp_path / CACHE).iterdir()
    written = file.stat().st_mtime_ns
    command = [sys.executable, exported_rollout_program.__file__, str(tmp_path)]
    found = subprocess.run(
        command, env=environment_of_cpus(1), check=True, capture_output=True, text=True, timeout=LIMIT_S
    ).stdout
    assert json.loads(found.splitlines()[-1]) == {"traced": 0, "content": traced["content"]}
    assert [file.stat().st_mtime_ns for file in (tmp_path / CACHE).iterdir()] == [written]


@pytest.mark.slow
def test_all_code_that_runs_while_a_program_is_traced_is_part_of_its_key() -> None:
    """Imports are followed by the text of sources: code that is reached otherwise could change unseen."""
    command = [sys.executable, closures_program.__file__]
    environment = environment_of_cpus(1) | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    found = subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True, timeout=5 * LIMIT_S
    ).stdout
    assert json.loads(found.splitlines()[-1]) == {"levels": [], "rollouts": [], "updates": []}


class OfAUser(EntityObservation):
    """Whose code may change."""


@pytest.fixture
def key_of(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Key of the program of a configuration; None: it is traced in every process."""

    def find(config: TrainConfig) -> ProgramKey | None:
        found: list[ProgramKey | None] = []
        monkeypatch.setattr(module, "_cached", lambda *parts, key, **others: found.append(key))
        Playing(config, data_mesh(jax.devices()[:1])).rollout(config)
        return found[0]

    return find


def test_what_is_not_of_this_project_is_traced_in_every_process(key_of: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny_config(num_updates=1)
    assert key_of(config) is not None
    plugins = dataclasses.replace(config.run, plugins=("examples.own_curriculum",))
    assert key_of(dataclasses.replace(config, run=plugins)) is None
    given = CurriculumConfig(name="fixed", levels="designed_s")  # files, which may change too
    assert key_of(dataclasses.replace(config, curriculum=given)) is None
    monkeypatch.setattr(OBSERVATIONS, "_parts", {**OBSERVATIONS._parts, "of_a_user": OfAUser()})
    of_a_user = dataclasses.replace(config.env, observation="of_a_user")
    assert key_of(dataclasses.replace(config, env=of_a_user)) is None


def test_a_curriculum_of_the_same_name_is_another_program(key_of: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    found = set()
    for one in (Plr, RobustPlr):
        monkeypatch.setattr(CURRICULA, "_parts", {**CURRICULA._parts, "mine": one})
        found.add(key_of(dataclasses.replace(tiny_config(num_updates=1), curriculum=CurriculumConfig(name="mine"))))
    assert len(found) == 2 and None not in found


def test_worlds_that_do_not_fit_are_refused_also_where_the_program_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny_config(num_updates=1)
    pictures = dataclasses.replace(config.env, observation="pixels")
    config = dataclasses.replace(
        config, env=pictures, policy=dataclasses.replace(config.policy, network="cnn", kernels="xla")
    )
    monkeypatch.setattr(device_memory, "device_bytes", lambda: 1000)
    with pytest.raises(DeviceMemoryError, match="play fewer worlds at once"):
        Playing(config, data_mesh(jax.devices()[:1])).rollout(config)


def test_what_changes_a_rollout_makes_another_program(key_of: Any) -> None:
    config = tiny_config(num_updates=1)
    longer = dataclasses.replace(config.run, total_env_steps=config.run.total_env_steps * 2)
    assert key_of(dataclasses.replace(config, run=longer)) == key_of(config)
    another_seed = dataclasses.replace(config.run, seed=config.run.seed + 1)
    penalty = dataclasses.replace(config.env, failure_penalty=config.env.failure_penalty + 0.5)
    generator = dataclasses.replace(config.curriculum.generator, thruster_chance=0.5)
    changed = [
        dataclasses.replace(config, run=another_seed),
        dataclasses.replace(config, env=penalty),
        dataclasses.replace(config, curriculum=dataclasses.replace(config.curriculum, generator=generator)),
        dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, num_groups=2)),
    ]
    assert len({key_of(one) for one in (config, *changed)}) == 1 + len(changed)


def test_functions_that_a_curriculum_is_given_are_part_of_the_key(key_of: Any) -> None:
    """It summarises with them what it sees, inside of the rollout."""
    given = {"kinetix_dist.runtime.cores.curriculum_state", "kinetix_dist.env.noop", "kinetix_dist.learner.gae"}
    assert given <= set(key_of(tiny_config(num_updates=1)).closure.modules)
