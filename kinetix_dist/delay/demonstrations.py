"""Samples for cloning from data sets that `kinetix-dist collect` wrote: one, or several such as one a specialist."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from kinetix_dist.data import Dataset, Transitions, open_dataset
from kinetix_dist.data.rollout import ChosenBy
from kinetix_dist.delay.chunk_policy import ChunkPolicy
from kinetix_dist.delay.windows import Samples, steps_left
from kinetix_dist.env.env_config import EnvConfig


class Demonstrations(NamedTuple):
    """Data sets, opened, of one kind of environment."""

    datasets: list[Dataset]

    @property
    def env_config(self) -> EnvConfig:
        return self.datasets[0].env_config

    @property
    def description(self) -> list[dict[str, Any]]:
        """JSON of what they are."""
        return [
            {"path": str(each.folder), "transitions": len(each), "policy": each.manifest["policy"]}
            for each in self.datasets
        ]


def open_demonstrations(folders: Sequence[Path], *, skip_damaged: bool = False) -> Demonstrations:
    """Raises DatasetError, one line, for one that cannot be read or is of another environment than the first."""
    datasets = [open_dataset(folder, skip_damaged=skip_damaged) for folder in folders]
    for other in datasets[1:]:
        other.check_env(datasets[0].env_config)
    return Demonstrations(datasets)


def samples_of(demonstrations: Demonstrations, policy: ChunkPolicy, *, solved_only: bool = False) -> Samples:
    """Every transition; solved_only: of episodes that ended solved. Raises ValueError where there is none."""
    parts, num_levels, num_rows = [], 0, 0
    for dataset in demonstrations.datasets:
        rows, levels = dataset.read(), dataset.levels
        parts.append(
            (
                rows._replace(static_obs=None, level=rows.level + num_levels, episode=rows.episode + num_rows),
                rows.static_obs,
                levels.bound_heads,
            )
        )
        num_levels, num_rows = num_levels + len(levels.names), num_rows + int(rows.episode.max()) + 1
    rows, static_obs, bound = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
    if solved_only:
        rows = _solved_episodes(rows)
        if not len(rows.level):
            raise ValueError("no episode of the data set ended solved; give another one, or use all episodes")
    return Samples(
        static_obs=static_obs,
        bound=bound,
        dynamic_obs=rows.dynamic_obs,
        level=rows.level.astype(np.int32),
        actions=np.asarray(policy.units(rows.actions.astype(np.float32))),
        left=steps_left(rows.episode),
        counts=rows.chosen_by == ChosenBy.POLICY,
    )


def _solved_episodes(rows: Transitions) -> Transitions:
    is_solved = np.isin(rows.episode, rows.episode[rows.solved])
    return jax.tree.map(lambda x: x[is_solved], rows)
