"""The collection of the small data set of these tests: random actions on three levels of S, episodes of 8 steps."""

from __future__ import annotations

import errno
from typing import Any

import jax
import numpy as np
import pytest

from kinetix_dist import atomic_files
from kinetix_dist.data.collect import Collection
from kinetix_dist.data.rollout import Disturbance
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.level.sets import load_level_set

NUM_SHARDS = 3


def fill_disc_at(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """From now on files with this in their name find no space on the disc."""
    flush = atomic_files.flush_to_disk

    def full(file: Any) -> None:
        if name in file.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(file)

    monkeypatch.setattr(atomic_files, "flush_to_disk", full)


def make_collection() -> Collection:
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
