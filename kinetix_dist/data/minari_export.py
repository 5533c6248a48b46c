"""A data set as one of Minari (its HDF5 format), for libraries that read those.

An episode is an episode of the data set, or the part of it that its shard has. Observations are the input of a policy,
so that masks and what a level fixes stand in each of them, as `kinetix_dist.env.wrappers` gives them to gymnasium.
Minari has one observation more than steps. What came after the last step of an episode is in no row: the observation
before that step stands there again.

    infos               level, step, solved, chosen_by, log_prob, policy_version: one entry for each step
    episode metadata    level_name; first_row of the episode in the data set; end_seen: no shard cut the episode
    metadata            kinetix_dist_dataset: the manifest
"""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist.atomic_directories import new_directory
from kinetix_dist.data.columns import Transitions
from kinetix_dist.data.dataset import Dataset
from kinetix_dist.data.manifest import DatasetError
from kinetix_dist.env.environment import Environment
from kinetix_dist.installation import NOT_INSTALLED, version_of

INFO_FIELDS = ("level", "step", "solved", "chosen_by", "log_prob", "policy_version")
DATA = "data"  # folder of the files, as Minari names it
MANIFEST_KEY = "kinetix_dist_dataset"
BLOCK_ROWS = 1 << 14  # rows whose observations are in memory at a time: 25 MB at S, 90 MB at L
NEEDED = ("minari", "h5py", "gymnasium", "gymnax")


def export_minari(
    dataset: Dataset, dataset_id: str, on_shard: Callable[[int, int], None] = lambda *_: None
) -> tuple[Path, int]:
    """Write a data set of Minari, which appears when it is complete.

    Args:
        dataset_id: "(namespace/)name-v0", below $MINARI_DATASETS_PATH or Minari's own folder.
        on_shard: called with the number of exported shards and the number of all shards.

    Returns:
        The folder and the number of episodes.

    Raises:
        DatasetError: Minari is missing, the id is malformed or taken, or a shard is damaged.
        OSError: the folder cannot be written.
    """
    if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        raise DatasetError(
            f"{missing[0]} is not installed, which Minari data sets need: pip install 'kinetix-dist[minari]'"
        )
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage import get_dataset_path

    _check_id(dataset_id)
    folder = get_dataset_path(dataset_id)
    if folder.exists():
        raise DatasetError(f"{folder} is there already; give another version, such as {_next_version(dataset_id)}")
    env = Environment(dataset.env_config)
    with new_directory(folder) as draft:
        storage = _new_storage(draft / DATA, dataset, env, dataset_id)
        for number in range(len(dataset.shards)):
            for block in _blocks(dataset.read([number])):
                _add(storage, dataset, env, block)
            on_shard(number + 1, len(dataset.shards))
        num_episodes = int(storage.total_episodes)
        if num_episodes == 0:
            raise DatasetError("the data set holds no steps; there is nothing to export")
        namespace = parse_dataset_id(dataset_id)[0]
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
    return folder, num_episodes


def _check_id(dataset_id: str) -> None:
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        _, _, number = parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # TypeError: without a version
        number = None
    if number is None:
        raise DatasetError(f"{dataset_id!r} is no id of a Minari data set; give one such as kinetix/generalist-v0")


def _next_version(dataset_id: str) -> str:
    name, _, number = dataset_id.rpartition("-v")
    return f"{name}-v{int(number) + 1}"


def _blocks(rows: Transitions) -> Iterator[tuple[Transitions, np.ndarray]]:
    """(rows, where each episode begins in them, and their end) of whole episodes, BLOCK_ROWS at most but for one
    longer episode."""
    starts = np.append(np.flatnonzero(np.diff(rows.episode, prepend=-1)), len(rows.episode))
    first = 0
    while first < len(starts) - 1:
        last = max(int(np.searchsorted(starts, starts[first] + BLOCK_ROWS, side="right")) - 1, first + 1)
        here = slice(int(starts[first]), int(starts[last]))
        block = jax.tree.map(lambda x: x[here], rows._replace(static_obs=None))  # noqa: B023 (called at once)
        yield block._replace(static_obs=rows.static_obs), starts[first : last + 1] - starts[first]
        first = last


def _new_storage(path: Path, dataset: Dataset, env: Environment, dataset_id: str) -> Any:
    """Return the storage of a data set of Minari without episodes."""
    import minari
    from minari.dataset.minari_storage import MinariStorage

    from kinetix_dist.env.wrappers.gymnasium_spaces import action_space, observation_space

    manifest, own = dataset.manifest, version_of()
    storage = MinariStorage.new(
        path,
        observation_space=observation_space(env),
        action_space=action_space(env.action_space),
        data_format="hdf5",
        jpeg_encoding=False,  # the JPEG encoding of pictures is lossy
    )
    storage.update_metadata(
        {
            "dataset_id": dataset_id,
            "minari_version": minari.__version__,
            "algorithm_name": str(manifest["policy"]["name"]),
            "description": f"{manifest['policy']['name']} on {manifest['levels']['set']}, collected by kinetix-dist",
            "requirements": ["kinetix-dist" if own == NOT_INSTALLED else f"kinetix-dist=={own}"],
            MANIFEST_KEY: manifest,
        }
    )
    return storage


def _add(storage: Any, dataset: Dataset, env: Environment, block: tuple[Transitions, np.ndarray]) -> None:
    """Append the episodes of a block to a storage of Minari."""
    rows, bounds = block
    storage.update_episodes(_episodes(env, rows, bounds))
    starts, ends = bounds[:-1], bounds[1:]
    names = dataset.levels.names
    about = [
        {
            "level_name": names[rows.level[start]],
            "first_row": int(rows.episode[start]),
            "end_seen": bool(rows.done[end - 1]),
        }
        for start, end in zip(starts, ends, strict=True)
    ]
    total = int(storage.total_episodes)
    storage.update_episode_metadata(about, range(total - len(about), total))


def _episodes(env: Environment, rows: Transitions, bounds: np.ndarray) -> list[Any]:
    """Buffers of Minari."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    observations = _observations(env, rows)
    actions = rows.actions.astype(np.int64 if env.action_space.is_integer else np.float32)
    truncations = rows.timed_out.copy()
    truncations[bounds[1:] - 1] |= ~rows.done[bounds[1:] - 1]  # cut by the end of a shard
    buffers = []
    for start, end in itertools.pairwise(bounds):
        here = slice(start, end)
        with_last = np.append(np.arange(start, end), end - 1)
        buffers.append(
            EpisodeBuffer(
                observations=jax.tree.map(lambda x: x[with_last], observations),  # noqa: B023 (called at once)
                actions=actions[here],
                rewards=rows.rewards[here],
                terminations=rows.done[here] & ~rows.timed_out[here],
                truncations=truncations[here],
                infos={name: getattr(rows, name)[here] for name in INFO_FIELDS},
            )
        )
    return buffers


def _observations(env: Environment, rows: Transitions) -> Any:
    """Inputs of a policy [N, ...] as the observation space has them: a dict of arrays, or an array."""
    from kinetix_dist.env.wrappers.gymnasium_spaces import as_dict

    number = len(rows.level)
    padded = np.concatenate([np.arange(number), np.zeros(max(BLOCK_ROWS - number, 0), np.intp)])  # one program for all
    static, dynamic = (
        jax.tree.map(lambda x: x[index], part)  # noqa: B023 (called at once)
        for index, part in ((rows.level[padded], rows.static_obs), (padded, rows.dynamic_obs))
    )
    joined = as_dict(jax.jit(env.observation.join)(static, dynamic))
    return jax.tree.map(lambda x: _as_stored(np.asarray(x)[:number]), joined)


def _as_stored(array: np.ndarray) -> np.ndarray:
    return array.astype(np.int8) if array.dtype == np.bool_ else array  # as the space has them
