"""Reader of data sets.

    data = open_dataset("data")
    rows = data.read()                      # everything, or data.read([0, 1]): some shards
    for batch in data.batches(256, seed=0): # one pass in random order, a few shards in memory at a time
        ...

Each shard is held to its SHA-256 when it is read.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from kinetix_dist.data.columns import Transitions, from_parquet, joined, picked
from kinetix_dist.data.level_file import Levels, read_levels
from kinetix_dist.data.manifest import (
    SHARDS,
    DatasetError,
    check_env,
    env_config_of,
    knows_policy,
    observation_shapes,
    quoted,
    read_manifest,
)
from kinetix_dist.data.row_checks import fault_of_rows
from kinetix_dist.data.shards import INDEX, REMEDY, Shard, read_content, read_index
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import one_line
from kinetix_dist.level.fingerprints import is_in_order
from kinetix_dist.level.level import Level


class Dataset:
    """A folder of shards. Damaged parts raise `DatasetError`, one line, or are skipped and counted on request."""

    def __init__(self, folder: Path, *, skip_damaged: bool = False) -> None:
        self.folder = folder
        self.manifest = read_manifest(folder)
        self.env_config = env_config_of(self.manifest, folder)
        index = read_index(folder, self.manifest["shard_transitions"])
        self.shards: list[Shard] = index.shards
        # One line for each shard that was missing or damaged when it was read, and for each fault of the index.
        self.skipped: list[str] = index.faults
        self._skip_damaged = skip_damaged
        if index.faults and not skip_damaged:
            more = f" and {len(index.faults) - 1} more faults" if len(index.faults) > 1 else ""
            raise DatasetError(
                f"{index.faults[0]}{more}; run the command that made the data set again, or leave the rows out with "
                "skip_damaged"
            )
        if not self.shards:
            raise DatasetError(
                f"data set {folder} has no whole shard ({INDEX}); `kinetix-dist collect` goes on with it"
            )

    def __len__(self) -> int:
        """Transitions, by the index."""
        return sum(shard.rows for shard in self.shards)

    @property
    def shortfall(self) -> str:
        """Return a line about shards that the command of the data set was to make and did not; "" if it made all."""
        wanted = self.manifest.get(SHARDS, 0)
        if len(self.shards) >= wanted:
            return ""
        return (
            f"data set {self.folder} has {len(self.shards)} of the {wanted} shards that its command was to make; the "
            "same command goes on"
        )

    @functools.cached_property
    def levels(self) -> Levels:
        """Levels with their static observations and masks."""
        return read_levels(self.folder, self._env, self.manifest["levels"])

    @functools.cached_property
    def _env(self) -> Environment:
        return Environment(self.env_config)

    @functools.cached_property
    def _shapes(self) -> Any:
        return observation_shapes(self._env)[1]

    @property
    def _action_shape(self) -> jax.ShapeDtypeStruct:
        space = self._env.action_space
        return jax.ShapeDtypeStruct(space.shape(1), space.stored_dtype)

    def check_env(self, config: EnvConfig) -> None:
        """Raises DatasetError, which names the setting, if size, observation, actions or physics differ."""
        check_env(self.manifest, config, self.folder)

    def check_levels(self, name: str, levels: Level) -> None:
        """Raises DatasetError if the data set is of other levels than these of the set `name`."""
        theirs = self.manifest["levels"]
        number = int(np.shape(levels.angle)[0])
        text = f"data set {self.folder} is of level set {quoted(theirs['set'])} ({theirs['number']} levels)"
        if number != theirs["number"]:
            raise DatasetError(f"{text}, not of {name!r} ({number} levels); give that one, or another data set")
        if not is_in_order(levels, theirs["fingerprint"]):
            raise DatasetError(f"{text}, and {name!r} has other levels; give that one, or another data set")

    def read(self, shards: Sequence[int] | None = None) -> Transitions:
        """Return the transitions of all shards, or of those at these places of `shards`; episodes are contiguous.

        Raises:
            DatasetError: a shard is damaged or missing and not skipped, or none is left.
        """
        numbers = range(len(self.shards)) if shards is None else shards
        if wrong := [number for number in numbers if not 0 <= number < len(self.shards)]:
            raise DatasetError(f"data set {self.folder} has shards 0 to {len(self.shards) - 1}, and no {wrong[0]}")
        parts = self._parts(numbers)
        if not parts:
            raise DatasetError(f"data set {self.folder}: all {len(numbers)} shards to read are damaged or missing")
        return joined(parts)

    def batches(self, batch_size: int, *, seed: int, shards_at_once: int = 4) -> Iterator[Transitions]:
        """Return one pass over all transitions in random order, in batches of one size.

        Shards come in random order. The rows of `shards_at_once` of them are in memory and mixed. Rows that do not fill
        a batch are left out.

        Raises:
            DatasetError: at once for a size that no batch can have, in the pass as `read`.
        """
        if not 1 <= batch_size <= len(self):
            raise DatasetError(
                f"batch_size is {batch_size:,}; give 1 to {len(self):,}, the transitions of data set {self.folder}"
            )
        if shards_at_once < 1:
            raise DatasetError(f"shards_at_once is {shards_at_once}; it must be 1 or more")
        return self._batches(operator.index(batch_size), np.random.default_rng(seed), shards_at_once)

    def _batches(self, batch_size: int, rng: np.random.Generator, shards_at_once: int) -> Iterator[Transitions]:
        order, rest, is_filled = rng.permutation(len(self.shards)), None, False
        for start in range(0, len(order), shards_at_once):
            found = [*([] if rest is None else [rest]), *self._parts(order[start : start + shards_at_once])]
            if not found:
                continue
            rows = joined(found)
            rows = picked(rows, rng.permutation(len(rows.level)))
            num_whole = len(rows.level) // batch_size * batch_size
            for first in range(0, num_whole, batch_size):
                yield picked(rows, slice(first, first + batch_size))
            rest, is_filled = picked(rows, slice(num_whole, None)), is_filled or num_whole > 0
        if not is_filled:
            number = 0 if rest is None else len(rest.level)
            raise DatasetError(
                f"data set {self.folder}: the {number:,} transitions that can be read fill no batch of {batch_size:,}"
            )

    def _parts(self, numbers: Iterable[int]) -> list[Transitions]:
        """Rows of each of these shards except skipped shards, read by several threads."""
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
            rows = from_parquet(content, static_obs, shapes, self._action_shape, num_rows=shard.rows)
        except (ValueError, OSError, pa.ArrowException) as error:  # Arrow raises OSError for damaged pages
            fault: str | None = one_line(error)
        else:
            first_row = shard.shard * self.manifest["shard_transitions"]
            is_policy_known = knows_policy(self.manifest)
            fault = fault_of_rows(rows, shard, self._env.action_space, first_row, is_policy_known=is_policy_known)
            if fault is None:
                return rows
        raise DatasetError(f"shard {self.folder / shard.file} holds no valid transitions: {fault}{REMEDY}")


def open_dataset(folder: str | Path, *, skip_damaged: bool = False) -> Dataset:
    """A data set that `kinetix-dist collect` wrote.

    skip_damaged: shards that are missing or damaged are left out, and listed in `Dataset.skipped`. Raises
    `DatasetError`, a ValueError of one line, for everything that cannot be read.
    """
    return Dataset(Path(folder), skip_damaged=skip_damaged)
