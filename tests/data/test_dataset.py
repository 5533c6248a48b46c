"""Reading data sets: what comes back, in which order, and one line for each thing that is wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

from jax2d.scene import index_worlds
from kinetix_dist.data import DatasetError, open_dataset
from kinetix_dist.data.collect import Collection
from kinetix_dist.env.environment import EnvConfig
from kinetix_dist.level.sets import load_level_set


def test_rows_of_an_episode_are_side_by_side_in_the_order_of_its_steps(collected: Path) -> None:
    rows = open_dataset(collected).read()
    assert len(rows.done) == 3 * 4 * 20
    np.testing.assert_array_equal(rows.first, rows.step == 0)
    np.testing.assert_array_equal(rows.episode[rows.first], np.flatnonzero(rows.first))
    inside = ~rows.first[1:]
    assert np.all(np.diff(rows.episode)[inside] == 0) and np.all(np.diff(rows.step)[inside] == 1)
    assert np.all(rows.done[:-1][inside] == 0), "no episode goes on after its end"
    assert rows.done.sum() > rows.solved.sum() and rows.timed_out[rows.step == 7].all()


def test_transitions_are_those_of_the_environment(collection: Collection, collected: Path) -> None:
    """The observation that follows a step, and its reward, are what the environment makes of level and actions."""
    data = open_dataset(collected)
    rows, env = data.read(), collection.env
    episodes = np.flatnonzero(rows.first)[:40:13]
    for begin in episodes:
        prepared = env.prepare(index_worlds(data.levels.levels, rows.level[begin : begin + 1]))
        env_state, obs = env.reset(prepared)
        for row in range(begin, begin + 8):
            if row == len(rows.done) or rows.episode[row] != begin:
                break
            np.testing.assert_allclose(obs.bodies[0], rows.dynamic_obs.bodies[row], atol=1e-5)  # another batch size
            env_state, obs, reward, done, _ = env.step(prepared, env_state, rows.actions[row][None].astype(np.int32))
            assert (float(reward[0]), bool(done[0])) == (pytest.approx(rows.rewards[row], abs=1e-5), rows.done[row])


def test_levels_come_with_what_they_fix(collection: Collection, collected: Path) -> None:
    levels = open_dataset(collected).levels
    assert levels.names == collection.level_names
    jax.tree.map(np.testing.assert_array_equal, levels.levels, collection.levels)
    static = collection.env.prepare(collection.levels).static_obs
    jax.tree.map(np.testing.assert_array_equal, levels.static_obs, static)
    moves = np.asarray(collection.levels.scene.shapes.inverse_mass > 0)
    assert np.all(levels.robot_mask <= moves) and np.all(levels.robot_mask.any(axis=1))
    assert np.all(levels.robot_mask <= levels.static_obs.shape_mask)


def test_pyarrow_reads_a_shard_by_the_names_of_the_manifest(collected: Path) -> None:
    fields = json.loads((collected / "dataset.json").read_text())["observation"]["fields"]
    table = pq.read_table(collected / "shard-000001.parquet", columns=["observation.bodies", "reward", "level"])
    bodies = fields["observation.bodies"]
    values = np.stack(table.column("observation.bodies").to_pylist()).reshape(-1, *bodies["shape"])
    rows = open_dataset(collected).read([1])
    np.testing.assert_array_equal(values.astype(np.float32), rows.dynamic_obs.bodies)
    assert bodies["entries"][:2] == ["position_x", "position_y"] and bodies["used"] == "static_obs/shape_mask"


def test_batches_are_one_pass_in_another_order(collected: Path) -> None:
    data = open_dataset(collected)
    batches = list(data.batches(32, seed=1, shards_at_once=2))
    assert [len(batch.done) for batch in batches] == [32] * 7  # 240 rows; 16 fill no batch

    def numbers(seed: int) -> list[int]:
        parts = data.batches(32, seed=seed, shards_at_once=2)
        return np.concatenate([part.episode + part.step for part in parts]).tolist()

    assert len(set(numbers(1))) == 7 * 32 and numbers(1) == numbers(1) != numbers(2)
    assert numbers(1) != sorted(numbers(1))


def test_a_folder_without_a_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=rf"^{tmp_path} is no data set: it has no dataset.json; `kinetix-dist col"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"version": 2}, "has format version 2, and this version of kinetix-dist reads 1"),
        ({"format": "minari"}, "is of format 'minari', not 'kinetix-dist-dataset'"),
        ({"env": {"size": "s", "colour": 1}}, "env: config field colour is unknown"),
    ],
)
def test_another_format_is_refused(data: Path, change: dict[str, object], text: str) -> None:
    manifest = json.loads((data / "dataset.json").read_text())
    (data / "dataset.json").write_text(json.dumps(manifest | change))
    with pytest.raises(DatasetError, match=text):
        open_dataset(data)


def test_half_a_manifest_is_refused(data: Path) -> None:
    (data / "dataset.json").write_text((data / "dataset.json").read_text()[:300])
    with pytest.raises(DatasetError, match=r"dataset.json cannot be read \(.*; copy the data set again"):
        open_dataset(data)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"size": "m"}, "is of env.size 's', not 'm'; set env.size to that"),
        ({"observation": "flat"}, "is of env.observation 'entity', not 'flat'"),
        ({"action_space": "continuous"}, "is of env.action_space 'multi_discrete', not 'continuous'"),
        ({"frame_skip": 4}, "is of env.frame_skip 2, not 4"),
    ],
)
def test_another_environment_is_refused(collected: Path, change: dict[str, Any], text: str) -> None:
    data = open_dataset(collected)
    data.check_env(data.env_config)
    with pytest.raises(DatasetError, match=text):
        data.check_env(dataclasses.replace(EnvConfig(size="s"), **change))


def test_another_physics_is_refused(collected: Path) -> None:
    data = open_dataset(collected)
    physics = dataclasses.replace(data.env_config.physics, substeps=8)
    with pytest.raises(DatasetError, match="is of physics 'standard', not 'standard with substeps 8'"):
        data.check_env(dataclasses.replace(data.env_config, physics=physics))


def test_another_level_set_is_refused(collection: Collection, collected: Path) -> None:
    data = open_dataset(collected)
    data.check_levels("three", collection.levels)
    one, _ = load_level_set("s/hop_home", "s")
    with pytest.raises(DatasetError, match=r"is of level set 'three' \(3 levels\), not of 's/hop_home' \(1 levels\)"):
        data.check_levels("s/hop_home", one)
    others = jax.tree.map(lambda x: np.repeat(x[:1], 3, axis=0), collection.levels)
    with pytest.raises(DatasetError, match=r"is of level set 'three' .*, and 'same' has other levels"):
        data.check_levels("same", others)


def test_a_missing_shard_is_named_or_skipped_and_counted(data: Path) -> None:
    (data / "shard-000001.parquet").unlink()
    with pytest.raises(DatasetError, match=r"shard .*shard-000001.parquet is missing; collect it again"):
        open_dataset(data).read()
    found = open_dataset(data, skip_damaged=True)
    assert len(found.read().done) == 2 * 4 * 20 and len(found.skipped) == 1
    assert "shard-000001.parquet is missing" in found.skipped[0]


@pytest.mark.parametrize("keep", [100, None])
def test_a_damaged_shard_is_named_or_skipped(data: Path, keep: int | None) -> None:
    """Cut, or with one bit another."""
    path = data / "shard-000002.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content if keep is None else content[:keep]))
    with pytest.raises(DatasetError, match=r"shard .*shard-000002.parquet is damaged: [\d,]+ bytes whose SHA-256"):
        open_dataset(data).read()
    found = open_dataset(data, skip_damaged=True)
    assert sum(len(batch.done) for batch in found.batches(20, seed=0)) == 2 * 4 * 20 and len(found.skipped) == 1


def test_nothing_left_to_read_is_an_error_also_where_shards_are_skipped(data: Path) -> None:
    for path in data.glob("shard-*"):
        path.unlink()
    with pytest.raises(DatasetError, match="all 3 shards to read are damaged or missing"):
        open_dataset(data, skip_damaged=True).read()


def test_damaged_levels_are_refused_whatever_is_skipped(data: Path) -> None:
    path = data / "levels.npz"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"levels.npz is damaged: its SHA-256 is not that of the manifest"):
        open_dataset(data, skip_damaged=True).read()
