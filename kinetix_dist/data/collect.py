"""Collection of a data set: the device plays a shard while a thread writes the shard before it.

    play (device)  --> at most one shard waits --> writer thread: to the host, columns, zstd, disk, line of the index

The main thread waits for the thread to take a shard; the thread unblocks it, also after a failure. Shard k depends only
on the settings, the seed and k, so a killed collection resumes with the shards that are missing. World w of shard k
plays level number k W + w of a shuffled round over all levels: the same number of worlds plays each level.

If each level has its own players (`Collection.turns`), all worlds of shard k play level k mod L, by player
(k // L) mod n of its n players: one program plays all of them, with other parameters.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist import prng
from kinetix_dist.data import level_file, manifest
from kinetix_dist.data.columns import Transitions, to_parquet
from kinetix_dist.data.manifest import DatasetError
from kinetix_dist.data.rollout import Disturbance, Played, play
from kinetix_dist.data.shards import INDEX, Shard, locked_index, read_index, write_shard
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.level_pool import LevelPool
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.level.fingerprints import fingerprint
from kinetix_dist.level.level import Level

COLLECT_STREAM = 0x434F4C4C  # "COLL": key of actions, and of the order of levels


@dataclasses.dataclass(frozen=True, kw_only=True)
class Turn:
    """Player of a level, for a shard at a time."""

    player: Player
    version: int  # updates that it has learned from


@dataclasses.dataclass(frozen=True, kw_only=True)
class Collection:
    """Settings of a data set, without the number of its shards."""

    env: Environment
    player: Player
    policy: dict[str, Any]  # description for the manifest: name, checkpoint and version
    levels: Level  # [L, ...]
    level_names: list[str]
    level_set: str
    disturbance: Disturbance = dataclasses.field(default_factory=Disturbance)
    num_worlds: int
    num_steps: int  # of each world in a shard
    seed: int = 0
    turns: tuple[tuple[Turn, ...], ...] = ()  # [L], of each level, instead of `player`; (): it plays all levels

    def __post_init__(self) -> None:
        if self.turns and len(self.turns) != len(self.level_names):
            raise ValueError(f"players of {len(self.turns)} levels for {len(self.level_names)}")
        if self.num_steps < (most := self.env.config.max_steps):
            raise DatasetError(
                f"a shard has {self.num_steps} steps of each of {self.num_worlds} worlds, and an episode up to {most}: "
                f"its end would never be seen; use shards of {most * self.num_worlds} transitions or more, or fewer "
                "worlds"
            )

    @property
    def rows_per_shard(self) -> int:
        return self.num_worlds * self.num_steps

    def manifest(self, levels_content: bytes) -> dict[str, Any]:
        return manifest.make_manifest(
            self.env,
            {
                "set": self.level_set,
                "number": len(self.level_names),
                "sha256": hashlib.sha256(levels_content).hexdigest(),
                "fingerprint": fingerprint(self.levels),
            },
            {
                "policy": self.policy,
                "noise": self.disturbance.noise,
                "sticky": self.disturbance.sticky,
                "seed": self.seed,
                "worlds": self.num_worlds,
                "shard_transitions": self.rows_per_shard,
            },
        )

    def level_numbers(self, shard: int) -> np.ndarray:
        """[W] int32 level of each world."""
        num_levels = len(self.level_names)
        if self.turns:
            return np.full(self.num_worlds, shard % num_levels, np.int32)
        slots = shard * self.num_worlds + np.arange(self.num_worlds)
        rounds = {turn: self._order(turn) for turn in set((slots // num_levels).tolist())}
        return np.array([rounds[slot // num_levels][slot % num_levels] for slot in slots.tolist()], np.int32)

    def turn(self, shard: int) -> Turn:
        """Player of a shard."""
        if not self.turns:
            return Turn(player=self.player, version=self.policy["version"])
        own = self.turns[shard % len(self.turns)]
        return own[shard // len(self.turns) % len(own)]

    def _order(self, turn: int) -> np.ndarray:
        return np.random.default_rng((self.seed, COLLECT_STREAM, turn)).permutation(len(self.level_names))


def collect(
    collection: Collection, folder: Path, num_shards: int, on_shard: Callable[[Shard, float], None] = lambda *_: None
) -> list[Shard]:
    """Make the missing shards of a data set of `num_shards` or more, and return all of its shards.

    Args:
        collection: the settings.
        folder: of the data set, which may exist.
        num_shards: the data set has at least this number at the end.
        on_shard: called with each new shard and the seconds since the start of the first one.

    Raises:
        DatasetError: the folder holds something else.
        OSError: a shard cannot be written. The shards before it stay valid.
    """
    described = level_file.describe_levels(collection.env, collection.levels, collection.level_names)
    content = level_file.encode_levels(described)
    with opened_folder(folder, collection.manifest(content), content, num_shards):
        missing = missing_shards(folder, num_shards, collection.rows_per_shard)
        pool = LevelPool(collection.env, collection.levels)
        began = time.monotonic()
        # A thread, not a process: Arrow, zstd, SHA-256 and the disk run without Python's lock.
        with concurrent.futures.ThreadPoolExecutor(max_workers=1) as writer:
            writing: concurrent.futures.Future[Shard] | None = None
            for number in missing:
                played = _play(collection, pool, number)  # returns before the device is done
                if writing is not None:
                    on_shard(writing.result(), time.monotonic() - began)
                writing = writer.submit(_write, collection, folder, number, played)
            if writing is not None:
                on_shard(writing.result(), time.monotonic() - began)
    return read_index(folder, collection.rows_per_shard).shards


@contextmanager
def opened_folder(folder: Path, wanted: dict[str, Any], levels_content: bytes, num_shards: int) -> Iterator[None]:
    """Hold a folder with this manifest and these levels, which no other process writes to.

    The manifest notes the number of shards that the command is to make, unless it notes a larger one.

    Raises:
        DatasetError: the folder holds something else, or another process writes to it.
    """
    _check_folder(folder, wanted)
    folder.mkdir(parents=True, exist_ok=True)
    with locked_index(folder, wanted["shard_transitions"]):
        stored = _check_folder(folder, wanted)
        if stored is None:
            level_file.write_levels(folder, levels_content)
        if stored is None or stored.get(manifest.SHARDS, 0) < num_shards:
            # Last: with it the folder is a data set.
            manifest.write_manifest(folder, (stored or wanted) | {manifest.SHARDS: num_shards})
        yield


def _check_folder(folder: Path, wanted: dict[str, Any]) -> dict[str, Any] | None:
    """Return the manifest of the folder, `None` without one. Raise DatasetError if the folder holds something else."""
    if (folder / manifest.FILE).exists():
        stored = manifest.read_manifest(folder)
        manifest.check_same_collection(stored, wanted, folder)
        return stored
    own = {level_file.FILE, INDEX}  # of a collection that was killed as it began
    found = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if others := [name for name in found if name not in own and not name.startswith(".")]:
        raise DatasetError(
            f"{folder} holds other files ({others[0]}) and no data set; give --out a directory of its own"
        )
    return None


def missing_shards(folder: Path, num_shards: int, max_rows: int) -> list[int]:
    """Return the numbers below `num_shards` whose shards are missing. max_rows: as of `read_index`."""
    there = {shard.shard for shard in read_index(folder, max_rows).shards if _is_there(folder, shard)}
    return [number for number in range(num_shards) if number not in there]


def _is_there(folder: Path, shard: Shard) -> bool:
    """Return whether the file of a shard has its size. A reader checks its content."""
    path = folder / shard.file
    return path.is_file() and path.stat().st_size == shard.bytes


def _play(collection: Collection, pool: LevelPool, number: int) -> Played:
    key = prng.fold_in(prng.fold_in(prng.key(collection.seed), COLLECT_STREAM), number)
    prepared = pool.select(collection.level_numbers(number))
    policy, params = collection.turn(number).player
    return play(collection.env, policy, collection.disturbance, collection.num_steps, params, prepared, key)


def _write(collection: Collection, folder: Path, number: int, played: Played) -> Shard:
    rows = rows_of(collection, number, jax.device_get(played))
    counts = {"rows": len(rows.done), "episodes": int(rows.done.sum()), "solved": int(rows.solved.sum())}
    return write_shard(folder, number, to_parquet(rows), counts)


def rows_of(collection: Collection, number: int, played: Played) -> Transitions:
    """Return the rows of shard `number`, world after world, sorted by episode and step."""
    num_worlds, num_steps = collection.num_worlds, collection.num_steps
    first = np.ones((num_worlds, num_steps), bool)
    first[:, 1:] = played.done[:, :-1]
    row = np.arange(num_worlds * num_steps).reshape(num_worlds, num_steps)
    begin = np.maximum.accumulate(np.where(first, row, 0), axis=1)
    flat: Played = jax.tree.map(lambda x: x.reshape(num_worlds * num_steps, *x.shape[2:]), played)
    return Transitions(
        static_obs=None,
        dynamic_obs=flat.dynamic_obs,
        level=np.repeat(collection.level_numbers(number), num_steps),
        actions=flat.actions,
        rewards=flat.rewards,
        done=flat.done,
        solved=flat.solved,
        timed_out=flat.timed_out,
        first=first.reshape(-1),
        log_prob=flat.log_prob,
        chosen_by=flat.chosen_by,
        episode=begin.reshape(-1) + np.int64(number) * collection.rows_per_shard,
        step=(row - begin).astype(np.int32).reshape(-1),
        policy_version=np.full(num_worlds * num_steps, collection.turn(number).version, np.int32),
    )
