"""A small data set that the tests of this folder share: random actions on two levels of S, episodes of 8 steps."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.data.rollout import Disturbance
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.level.sets import load_level_set

NUM_SHARDS = 3


@pytest.fixture(scope="session")
def collection() -> Collection:
    env = Environment(EnvConfig(size="s", max_steps=8))
    names = ("s/hop_home", "s/aim_rocket", "s/unicycle_dash")
    loaded = [load_level_set(name, "s") for name in names]
    levels = jax.tree.map(lambda *xs: np.concatenate(xs), *(levels for levels, _ in loaded))
    return Collection(
        env=env,
        player=Player(RandomPolicy(env.action_space)),
        policy={"name": "random", "version": -1, "sha256": "", "greedy": False},
        levels=levels,
        level_names=[name for _, names in loaded for name in names],
        level_set="three",
        disturbance=Disturbance(sticky=0.25, noise=0.25),
        num_worlds=4,
        num_steps=20,
        seed=3,
    )


@pytest.fixture(scope="session")
def collected(collection: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set; tests that change it take `data`."""
    folder = tmp_path_factory.mktemp("collected") / "data"
    collect(collection, folder, NUM_SHARDS)
    return folder


@pytest.fixture
def data(collected: Path, tmp_path: Path) -> Path:
    """A copy of the data set."""
    return Path(shutil.copytree(collected, tmp_path / "data"))
