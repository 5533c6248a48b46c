"""Random levels at the frontier of the solvable: hard by chance, not impossible.

    levels, names = frontier_levels(frontier_sets()["frontier_s"])

The levels are drawn from a stream of their own: random actions rarely solve them, and some stored policy does. A set
without levels that all or no policies solve separates two policies with fewer attempts. levels/frontier_sets.json has
the indices into the stream and the counts by which they were chosen; `bench.frontier_sets` writes it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.json_text import json_text
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import generator
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.text_files import read_json

FRONTIER_STREAM = 0x46524F4E  # "FRON": a key of its own
FRONTIER_FILE = "frontier_sets.json"
MAX_RANDOM_RATE = 0.2  # of random actions on a level: below it


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrontierSet:
    """The levels of one size, and how they were chosen."""

    size: str
    indices: tuple[int, ...]  # into the stream of the size
    random_solved: tuple[int, ...]  # attempts of random actions that solved each level
    attempts: int  # of random actions, and of each policy at most, on a level
    policies: tuple[str, ...]
    num_drawn: int  # candidates
    fingerprint: str = ""  # see fingerprints.py; "": not checked

    @property
    def name(self) -> str:
        return f"frontier_{self.size}"


def frontier_sets() -> dict[str, FrontierSet]:
    """The sets in the level data, by name."""
    file = levels_root() / FRONTIER_FILE
    return {made.name: made for made in read_frontier_sets(file).values()} if file.is_file() else {}


def read_frontier_sets(file: Path) -> dict[str, FrontierSet]:
    """The sets of a file, by size. Raises OSError and ValueError."""
    sets = {}
    for size, content in read_json(file).items():
        fields: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in content.items()}
        sets[size] = FrontierSet(size=size, **fields)
    return sets


def frontier_text(sets: Mapping[str, FrontierSet]) -> str:
    """Content of a file for `read_frontier_sets`."""
    content = {size: {k: v for k, v in dataclasses.asdict(made).items() if k != "size"} for size, made in sets.items()}
    return json_text(content) + "\n"


def frontier_levels(given: FrontierSet) -> tuple[Level, list[str]]:
    """A batch of the levels in arrays of their size (numpy), and their names."""
    levels = jax.tree.map(np.asarray, stream_levels(given.size, given.indices))
    return levels, [f"{given.name}_{index}" for index in given.indices]


def stream_levels(size: str, indices: Sequence[int]) -> Level:
    """[len(indices), ...] levels of the stream of a size; each depends on its own index alone."""
    key = prng.fold_in(prng.key(FRONTIER_STREAM), list(SIZES).index(size))
    return _levels_of(key, jnp.asarray(indices, jnp.uint32), size)


@functools.partial(jax.jit, static_argnames="size")
def _levels_of(key: Array, indices: Array, size: str) -> Level:
    keys = jax.vmap(prng.fold_in, in_axes=(None, 0))(key, indices)
    config = generator("default")
    return jax.vmap(lambda one: generate_level(one, capacity_of_size(size), config))(keys)
