"""Reader of data sets.

    data = open_dataset("data")
    rows = data.read()                      # everything, or data.read([0, 1]): some shards
    for batch in data.batches(256, seed=0): # one pass in random order, a few shards in memory at a time
        ...

Each shard is held to its SHA-256 when it is read.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from kinetix_dist.data.columns import Transitions, from_parquet, joined, picked
from kinetix_dist.data.level_file import Levels, read_levels
from kinetix_dist.data.manifest import DatasetError, check_env, env_config_of, observation_shapes, read_manifest
from kinetix_dist.data.shards import INDEX, Shard, read_content, read_index
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.fingerprints import is_in_order
from kinetix_dist.level.level import Level


class Dataset:
    """A folder of shards. What is damaged raises `DatasetError`, one line, or is skipped and counted on request."""

    def __init__(self, folder: Path, *, skip_damaged: bool = False) -> None:
        self.folder = folder
        self.manifest = read_manifest(folder)
        self.env_config = env_config_of(self.manifest, folder)
        self.shards: list[Shard] = read_index(folder)
        self.skipped: list[str] = []  # shards that were missing or damaged when they were read, a line each
        self._skip_damaged = skip_damaged
        if not self.shards:
            raise DatasetError(
                f"data set {folder} has no whole shard ({INDEX}); `kinetix-dist collect` goes on with it"
            )

    def __len__(self) -> int:
        """Transitions, by the index."""
        return sum(shard.rows for shard in self.shards)

    @functools.cached_property
    def levels(self) -> Levels:
        """Levels with their static observations and masks."""
        return read_levels(self.folder, self._env, self.manifest["levels"]["sha256"])

    @functools.cached_property
    def _env(self) -> Environment:
        return Environment(self.env_config)

    @functools.cached_property
    def _shapes(self) -> Any:
        return observation_shapes(self._env)[1]

    def check_env(self, config: EnvConfig) -> None:
        """Raises DatasetError, naming it, where size, observation, actions or physics are others than these."""
        check_env(self.manifest, config, self.folder)

    def check_levels(self, name: str, levels: Level) -> None:
        """Raises DatasetError where these levels of the set `name` are not those that were played."""
        theirs = self.manifest["levels"]
        number = int(np.shape(levels.angle)[0])
        text = f"data set {self.folder} is of level set {theirs['set']!r} ({theirs['number']} levels)"
        if number != theirs["number"]:
            raise DatasetError(f"{text}, not of {name!r} ({number} levels); give that one, or another data set")
        if not is_in_order(levels, theirs["fingerprint"]):
            raise DatasetError(f"{text}, and {name!r} has other levels; give that one, or another data set")

    def read(self, shards: Sequence[int] | None = None) -> Transitions:
        """Transitions of all shards, or of those at these places of `shards`; episodes are contiguous."""
        parts = self._parts(range(len(self.shards)) if shards is None else shards)
        if not parts:
            raise DatasetError(f"data set {self.folder}: all {len(self.skipped)} shards to read are damaged or missing")
        return joined(parts)

    def batches(self, batch_size: int, *, seed: int, shards_at_once: int = 4) -> Iterator[Transitions]:
        """One pass over all transitions in random order, in batches of one size; the rows that fill none are left out.

        Shards come in random order, and rows of `shards_at_once` of them are mixed: that many are in memory.
        """
        rng = np.random.default_rng(seed)
        order, rest = rng.permutation(len(self.shards)), None
        for start in range(0, len(order), shards_at_once):
            found = [*([] if rest is None else [rest]), *self._parts(order[start : start + shards_at_once])]
            if not found:
                continue
            rows = joined(found)
            rows = picked(rows, rng.permutation(len(rows.level)))
            num_whole = len(rows.level) // batch_size * batch_size
            for first in range(0, num_whole, batch_size):
                yield picked(rows, slice(first, first + batch_size))
            rest = picked(rows, slice(num_whole, None))

    def _parts(self, numbers: Iterable[int]) -> list[Transitions]:
        """Rows of each of these shards but for those that are skipped, read by several threads."""
        chosen = [self.shards[number] for number in numbers]
        static_obs, shapes = self.levels.static_obs, self._shapes  # without levels no shard can be read
        with ThreadPoolExecutor() as pool:
            reading = [pool.submit(self._part, shard, static_obs, shapes) for shard in chosen]
        found = []
        for part in reading:
            try:
                found.append(part.result())
            except DatasetError as error:
                if not self._skip_damaged:
                    raise
                if str(error) not in self.skipped:
                    self.skipped.append(str(error))
        return found

    def _part(self, shard: Shard, static_obs: Any, shapes: Any) -> Transitions:
        content = read_content(self.folder, shard)
        try:
            return from_parquet(content, static_obs, shapes)
        except (KeyError, ValueError, pa.ArrowException) as error:
            raise DatasetError(f"shard {self.folder / shard.file} is of another version: {error}") from None


def open_dataset(folder: str | Path, *, skip_damaged: bool = False) -> Dataset:
    """A data set that `kinetix-dist collect` wrote.

    skip_damaged: shards that are missing or damaged are left out, and listed in `Dataset.skipped`. Raises
    `DatasetError`, a ValueError of one line, for everything that cannot be read.
    """
    return Dataset(Path(folder), skip_damaged=skip_damaged)
