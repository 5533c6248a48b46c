"""Specialists at play as one moving picture: each level before training on the left, and after it on the right.

    played = play_specialists(out, records)        from what `kinetix-dist finetune --each` stored in `out`
    write_moving_picture("policies.gif", played)

Each shows one of `NUM_ATTEMPTS` attempts, the first that is solved where there is one; its caption says how many
are. All attempts of all specialists are played by one compiled program.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from jax2d.scene import index_worlds
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.runtime import make_environment
from kinetix_dist.stored_specialists import Record, level_set_of, policy_path
from kinetix_dist.telemetry.pictures import grid_scale, write_grid_gif
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.trained_policy import Trained, checkpoint_at

NUM_ATTEMPTS = 8
MAX_LEVELS = 12  # of a picture; more would be too small to see


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlayedLevel:
    """One rollout of a policy on a level, as it is drawn."""

    level: str
    moment: str  # "before", or "after 65,536 steps"
    rollout: Rollout
    num_solved: int  # of NUM_ATTEMPTS

    @property
    def caption(self) -> str:
        return f"{self.level} {self.moment}: {self.num_solved} of {NUM_ATTEMPTS} solved"


def play_specialists(path: Path, records: Sequence[Record]) -> list[PlayedLevel]:
    """How at most `MAX_LEVELS` specialists of one start play: before and after where the start is a checkpoint that can
    still be read, else after alone. Raises UserError for a policy or a level that cannot be read."""
    records = records[:MAX_LEVELS]
    specialists = [checkpoint_at(policy_path(path, record)) for record in records]
    config, level_set = specialists[0].config, level_set_of(path)  # of all
    with user_errors(ValueError, OSError):
        levels, names = load_level_set(level_set, config.env.size)
    if missing := [record["level"] for record in records if record["level"] not in names]:
        raise UserError(f"{level_set} has no level {missing[0]!r} any more; it cannot be shown")
    env = make_environment(config)
    start = _start_of(records[0])
    played = []
    for record, specialist in zip(records, specialists):
        name = record["level"]
        level = index_worlds(levels, names.index(name))
        if start is not None:
            played.append(_play(env, start, level, name, "before"))
        played.append(_play(env, specialist, level, name, f"after {record['env_steps']:,} steps"))
    return played


def write_moving_picture(file: str | os.PathLike[str], played: Sequence[PlayedLevel]) -> None:
    """Writes a GIF in real time, each below its caption."""
    rollouts = [dataclasses.replace(one.rollout, level_name=one.caption) for one in played]
    columns = num_columns(len(played), in_pairs=any(one.moment == "before" for one in played))
    write_grid_gif(file, rollouts, pixels_per_metre=grid_scale(columns, of_one=60.0), columns=columns)


def num_columns(num_pictures: int, *, in_pairs: bool) -> int:
    """Columns of about as many rows; pairs are not torn."""
    if in_pairs:
        return 2 * math.ceil(math.sqrt(num_pictures / 4))
    return math.ceil(math.sqrt(num_pictures))


def _start_of(record: Record) -> Trained | None:
    """The policy that a specialist started from; None: the seed, or a checkpoint that was pruned or moved since."""
    if record["from"] is None:
        return None
    try:
        return checkpoint_at(Path(record["from"]["checkpoint"]))
    except UserError:
        return None


def _play(env: Environment, policy: Trained, level: Level, name: str, moment: str) -> PlayedLevel:
    levels = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], NUM_ATTEMPTS, axis=0), level)
    rollouts = record_rollouts(
        env,
        policy.player(env, levels),
        levels,
        prng.key(0),
        names=[name] * NUM_ATTEMPTS,
        policy_version=policy.num_updates,
    )
    solved = [rollout for rollout in rollouts if rollout.solved]
    return PlayedLevel(level=name, moment=moment, rollout=(solved or rollouts)[0], num_solved=len(solved))
