"""Offline data of the public Kinetix package as a data set of this project's.

A trajectory becomes its rows, in its order, and its level becomes one of `levels.npz`. What the source does not have:

    rewards        of the reward "sparse": 1 where an episode ends solved. Released trajectories are successful ones
                   alone, so that an episode that ends before the time limit was solved
    log_prob       NaN
    policy_version -1

An episode begins where `timestep` is 0. The loaders of the package do not say whether `done` of a step is of the
episode that ends with it or of one that ended before it; the timesteps of the data tell, and must agree with one.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jax2d.settings import preset
from kinetix_dist.data import level_file, manifest
from kinetix_dist.data.collect import missing_shards, opened_folder
from kinetix_dist.data.columns import Transitions, to_parquet
from kinetix_dist.data.kinetix_offline import STATE, STATE_FIELDS, KinetixOffline
from kinetix_dist.data.kinetix_states import capacity_counts, level_of, moving_of, same_level, stacked
from kinetix_dist.data.manifest import DatasetError
from kinetix_dist.data.rollout import ChosenBy
from kinetix_dist.data.shards import Shard, read_index, write_shard
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.fingerprints import fingerprint
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, SIZES, Level
from kinetix_dist.level.structure import LevelFormatError

NUM_DIMENSIONS = NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS
PHYSICS = "paper"  # preset: the solver of the package, which the states are of
READ_AT_ONCE = 256  # trajectories whose levels are read at a time
STATE_NAMES = tuple(STATE + name for name in STATE_FIELDS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chosen:
    """Trajectories that can be imported, and why the others cannot."""

    env: Environment
    numbers: np.ndarray  # [N] int64 of trajectories of the source
    levels: Level  # [N, ...]
    done_is_of_step: bool  # `done` is True in the last step of an episode, not in the first one after it
    left_out: tuple[str, ...]  # a line for each trajectory that was not taken

    @property
    def names(self) -> list[str]:
        return [f"kinetix-offline/{number}" for number in self.numbers]


def choose(source: KinetixOffline, start: int, stop: int, observation: str) -> Chosen:
    """Trajectories start to stop - 1 whose levels can be read. Raises DatasetError where there are none."""
    config = _env_config(source, observation)
    numbers, levels, left_out, after, before = [], [], [], True, True
    for first in range(start, stop, READ_AT_ONCE):
        end = min(first + READ_AT_ONCE, stop)
        read = source.read(first, end, ("done", *STATE_NAMES))
        states = _states(read)
        begins = states["timestep"] == 0
        complaints = _complaints(states, begins)
        taken = np.array([not text for text in complaints])
        after &= bool((read["done"][taken, :-1] == begins[taken, 1:]).all())
        before &= bool((read["done"][taken, 1:] == begins[taken, 1:]).all())
        for row, text in enumerate(complaints):
            if not text:
                try:
                    levels.append(level_of({name: array[row, 0] for name, array in states.items()}))
                    numbers.append(first + row)
                    continue
                except LevelFormatError as error:
                    text = str(error)
            left_out.append(f"{source.name(first + row)}: {text}")
    if not numbers:
        raise DatasetError(f"{source.folder}: none of {stop - start} trajectories can be read; {left_out[0]}")
    if not after and not before:
        raise DatasetError(
            f"{source.folder}: `done` marks neither the last step of an episode nor the first one after it "
            "(env_state/timestep is 0); these data are of another layout"
        )
    return Chosen(
        env=Environment(config),
        numbers=np.array(numbers),
        levels=stacked(levels),
        done_is_of_step=after,
        left_out=tuple(left_out),
    )


def import_offline(
    source: KinetixOffline,
    chosen: Chosen,
    folder: Path,
    per_shard: int,
    on_shard: Callable[[Shard, int], None] = lambda *_: None,
) -> list[Shard]:
    """All shards of a data set of the chosen trajectories, `per_shard` of them in each; those missing are made.

    on_shard: called with each new one and the number of all. Raises DatasetError where the folder holds something
    else, and OSError where a shard cannot be written: what is there stays valid then.
    """
    described = level_file.describe_levels(chosen.env, chosen.levels, chosen.names)
    content = level_file.encode_levels(described)
    num_shards = -(-len(chosen.numbers) // per_shard)
    max_rows = per_shard * source.num_steps
    with opened_folder(folder, _manifest(source, chosen, content, per_shard), content, num_shards):
        for number in missing_shards(folder, num_shards, max_rows):
            rows = rows_of(source, chosen, number * per_shard, min((number + 1) * per_shard, len(chosen.numbers)))
            counts = {"rows": len(rows.done), "episodes": int(rows.done.sum()), "solved": int(rows.solved.sum())}
            on_shard(write_shard(folder, number, to_parquet(rows), counts), num_shards)
    return read_index(folder, max_rows).shards


def rows_of(source: KinetixOffline, chosen: Chosen, start: int, stop: int) -> Transitions:
    """Rows of chosen trajectories start to stop - 1, which stand in the data set from row start * steps on."""
    numbers = chosen.numbers[start:stop]
    read = source.read(int(numbers[0]), int(numbers[-1]) + 1)
    read = {name: array[numbers - numbers[0]] for name, array in read.items()}
    states = _states(read)
    levels = jax.tree.map(lambda x: x[start:stop], chosen.levels)
    actions = _executed(read["action"], chosen.env.action_space, source.folder)
    first = states["timestep"] == 0
    done = np.zeros_like(first)
    done[:, :-1] = first[:, 1:]
    timed_out_next = states["timestep"] + 1 >= chosen.env.config.max_steps
    done[:, -1] = timed_out_next[:, -1]  # what comes after the last state is not in the data
    if chosen.done_is_of_step:
        done[:, -1] |= read["done"][:, -1].astype(bool)
    num_rows, num_steps = done.size, source.num_steps
    row = np.arange(num_rows).reshape(done.shape)
    begin = np.maximum.accumulate(np.where(first, row, 0), axis=1)
    timed_out = done & timed_out_next
    solved = (done & ~timed_out).reshape(-1)
    dynamic = jax.jit(chosen.env.observation.dynamic)(moving_of(states, levels))
    return Transitions(
        static_obs=None,
        dynamic_obs=jax.device_get(dynamic),
        level=np.repeat(np.arange(start, stop, dtype=np.int32), num_steps),
        actions=actions.reshape(num_rows, NUM_DIMENSIONS),
        rewards=solved.astype(np.float32),
        done=done.reshape(-1),
        solved=solved,
        timed_out=timed_out.reshape(-1),
        first=first.reshape(-1),
        log_prob=np.full(num_rows, np.nan, np.float32),
        chosen_by=np.full(num_rows, ChosenBy.POLICY, np.int8),
        episode=begin.reshape(-1) + np.int64(start) * num_steps,
        step=(row - begin).astype(np.int32).reshape(-1),
        policy_version=np.full(num_rows, -1, np.int32),
    )


def _env_config(source: KinetixOffline, observation: str) -> EnvConfig:
    """Environment that the trajectories are of. Raises DatasetError for sizes and actions that are not here."""
    read = source.read(0, 1, ("action", *STATE_NAMES))
    counts = capacity_counts(_states(read))
    sizes = [size for size, capacity in SIZES.items() if all(getattr(capacity, n) == c for n, c in counts.items())]
    if not sizes:
        found = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise DatasetError(f"{source.folder} has levels of {found}, which is none of the sizes {', '.join(SIZES)}")
    actions = read["action"]
    if actions.shape[2:] != (NUM_DIMENSIONS,):
        raise DatasetError(
            f"{source.folder} has actions of shape {list(actions.shape[2:])}; multi-discrete and continuous ones, of "
            f"{NUM_DIMENSIONS} numbers, can be read"
        )
    space = "continuous" if actions.dtype.kind == "f" else "multi_discrete"
    return EnvConfig(
        size=sizes[0], physics=preset(PHYSICS), reward="sparse", action_space=space, observation=observation
    )


def _complaints(states: Mapping[str, np.ndarray], begins: np.ndarray) -> list[str]:
    """Reason why a trajectory cannot be taken, of each; "": none."""
    step = states["timestep"]
    goes_on = (step[:, 1:] == step[:, :-1] + 1) | begins[:, 1:]
    starts = {name: array[:, :1] for name, array in states.items()}
    is_same = same_level(states, starts) | ~begins
    texts = []
    for row in range(len(step)):
        if not begins[row, 0]:
            texts.append(f"begins at step {step[row, 0]} of an episode, so that its level is not known")
        elif not goes_on[row].all():
            texts.append(f"skips steps of an episode after step {int(np.argmin(goes_on[row]))}")
        elif not is_same[row].all():
            texts.append(f"begins another level at step {int(np.argmin(is_same[row]))}")
        else:
            texts.append("")
    return texts


def _executed(actions: np.ndarray, space: ActionSpace, folder: Path) -> np.ndarray:
    """Actions as they are stored. The package clips continuous ones to their range as it executes them.

    Raises DatasetError for numbers that are no actions.
    """
    low, high = np.array(space.low), np.array(space.high)
    if not space.is_integer:
        actions = np.clip(actions.astype(np.float32), low, high)
    is_valid = (actions >= low) & (actions <= high)  # False of NaN
    if not is_valid.all():
        wrong = tuple(int(i) for i in np.argwhere(~is_valid)[0])
        raise DatasetError(
            f"{folder}: an action has {actions[wrong]} for {space.action_names[wrong[2]].name}, and {low[wrong[2]]:g} "
            f"to {high[wrong[2]]:g} is possible; these data are of another layout"
        )
    return actions.astype(space.stored_dtype)


def _manifest(source: KinetixOffline, chosen: Chosen, levels_content: bytes, per_shard: int) -> dict[str, Any]:
    return manifest.make_manifest(
        chosen.env,
        {
            "set": "kinetix-offline",
            "number": len(chosen.numbers),
            "sha256": hashlib.sha256(levels_content).hexdigest(),
            "fingerprint": fingerprint(chosen.levels),
        },
        {
            "policy": {"name": manifest.UNKNOWN_POLICY, "version": -1, "sha256": "", "greedy": False},
            "noise": 0.0,
            "sticky": 0.0,
            "seed": 0,
            "worlds": per_shard,
            "shard_transitions": per_shard * source.num_steps,
            "trajectories": [int(chosen.numbers[0]), int(chosen.numbers[-1])],
        },
    )


def _states(read: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.removeprefix(STATE): array for name, array in read.items() if name.startswith(STATE)}
