"""Cores that Ray processes of tests hold: each does one thing, and does it for real."""

from __future__ import annotations

import os
import time
from typing import Any


class Told:
    """Says what its process was told."""

    def devices(self) -> str | None:
        return os.environ.get("CUDA_VISIBLE_DEVICES")


class Greedy:
    """Asks JAX for more memory than there is."""

    def call(self) -> Any:
        import jax.numpy as jnp

        return jnp.zeros(1 << 50, jnp.int8).sum()


def build_told(index: int, num_processes: int) -> Told:
    del index, num_processes
    return Told()


def build_greedy(index: int, num_processes: int) -> Greedy:
    del index, num_processes
    return Greedy()


def build_from_missing_levels(index: int, num_processes: int, path: str) -> Any:
    """Fails as a process does on whose host a level set is not there."""
    del index, num_processes
    from kinetix_dist.level.sets import load_level_set

    return load_level_set(path, "s")


class Sleeper:
    """Does nothing, for as long as it is told."""

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


def build_sleeper(index: int, num_processes: int) -> Sleeper:
    del index, num_processes
    return Sleeper()
