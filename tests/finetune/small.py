"""Specialists of the recipe `tiny` on two levels: all tests of a process share what is compiled for them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, save_alone
from kinetix_dist.config import EvaluationConfig, TrainConfig, to_dict
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
from kinetix_dist.finetune.results import Key, ResultsDirectory, design_of
from kinetix_dist.finetune.specialists import SCRATCH, Point, Specialist, Specialists
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.policy import make_policy
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.curriculum_state import some_observation

NAMES = ("hop_home", "kick")
NUM_UPDATES = 3
OPTIONS = (
    *("--recipe", "tiny", "--evaluation.every", "2", "--evaluation.min_attempts", "8"),
    *("--run.total_env_steps", str(NUM_UPDATES * 16 * 8)),
)


def level_directory(folder: Path) -> Path:
    """Two levels of size S."""
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.json").write_bytes((levels_root() / "s" / f"{name}.json").read_bytes())
    return folder


def config_of(levels: Path, **sections) -> TrainConfig:
    """Configuration of OPTIONS."""
    config = recipe("tiny")
    return dataclasses.replace(
        config,
        curriculum=CurriculumConfig(name="fixed", levels=str(levels)),
        evaluation=EvaluationConfig(sets=(str(levels),), every=2, min_attempts=8),
        run=dataclasses.replace(config.run, total_env_steps=NUM_UPDATES * config.rollout.steps_per_update),
        **sections,
    )


@functools.cache
def shared_specialists(config: TrainConfig, *, stop_at: float = 0.0, together: int = 1) -> Specialists:
    return Specialists(config, stop_at=stop_at, together=together)


def write_specialists(out: Path, config: TrainConfig, rates: Mapping[tuple[str, int], float]) -> Path:
    """Results of specialists that learned nothing, with final rates by level and seed, of the levels of `config`."""
    levels, names = load_level_set(config.curriculum.levels, config.env.size)
    results = ResultsDirectory(out, design_of(config, levels, names, stop_at=0.0, has_seeds=True))
    for (name, seed), rate in rates.items():
        points = (Point(updates=7 + seed, env_steps=700, solved=round(100 * rate), attempts=100),)
        own = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        specialist = Specialist(
            points=points,
            params=drawn_params(own, seed),
            training_seconds=0.0,
            evaluation_seconds=0.0,
            compile_seconds=0.0,
            skipped_steps=0,
        )
        number = names.index(name)
        results.add(Key(SCRATCH, name, seed), specialist, own, jax.tree.map(lambda x, i=number: x[i : i + 1], levels))
    results.close()
    return out


def write_policy(to: Path, config: TrainConfig) -> Path:
    """A checkpoint of parameters that learned nothing; nothing is compiled for it."""
    params = drawn_params(config, 5)
    arrays = {f"{PARAMS_PREFIX}/{name}": array for name, array in flatten_arrays(params).items()}
    save_alone(to, 7, arrays, {"config": to_dict(config), "config_hash": config.hash, "env_steps": 700})
    return to


def drawn_params(config: TrainConfig, seed: int) -> Any:
    """Parameters of small random numbers."""
    env = Environment(config.env)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    obs = jax.eval_shape(lambda: some_observation(config, env))
    random = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        return (0.1 * random.standard_normal(leaf.shape)).astype(leaf.dtype)

    return jax.tree.map(draw, jax.eval_shape(policy.init, jax.random.key(0), obs))
