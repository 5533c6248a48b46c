"""Level sets of an evaluation, each in the arrays that it is played in.

A set that fits the size a policy was trained on is played in arrays of that size; a larger one in arrays of its own,
which only networks take whose parameters do not depend on how much there is in a level (`Network.plays_all_sizes`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.sets import load_level_set, size_of_drawn_set
from kinetix_dist.models.policy import NETWORKS


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationSet:
    """Levels of a set in the arrays that they are played in."""

    name: str
    size: str  # of the arrays
    levels: Level  # [L, ...]
    level_names: tuple[str, ...]


def load_evaluation_set(name: str, size: str) -> EvaluationSet:
    """Set to be played by a policy trained on `size`. Raises as `load_level_set`."""
    played = size_played(name, size)
    levels, names = load_level_set(name, played)
    return EvaluationSet(name=name, size=played, levels=levels, level_names=tuple(names))


def size_played(name: str, size: str) -> str:
    """Size of the arrays in which a policy trained on `size` plays a set: that, or the set's own where it is larger.

    Sets of files are read for it; those that are drawn are not drawn. Raises as `load_level_set`.
    """
    own = size_of_drawn_set(name)
    if own is None:
        capacity = capacity_of(load_level_set(name)[0])
        own = next(known for known in SIZES if SIZES[known] == capacity)
    return max(size, own, key=list(SIZES).index)


def largest_size_played(names: Iterable[str], size: str) -> str:
    """Size of the largest arrays in which a policy trained on `size` plays these sets."""
    return max([size, *(size_played(name, size) for name in names)], key=list(SIZES).index)


def check_evaluation_sets(names: Iterable[str], size: str, network: str) -> None:
    """Raises ValueError or OSError, one line, for a set that is not there, or that a network trained on `size` cannot
    play."""
    for name in names:
        own = size_played(name, size)
        if own != size and not NETWORKS[network].plays_all_sizes:
            raise ValueError(
                f"level set {name!r} does not fit size {size!r}, and policy.network {network!r} plays levels of the "
                f"size that it was trained on alone; choose a larger env.size, or another set"
            )
