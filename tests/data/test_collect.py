"""Collecting: disturbances, what a kill or a full disc leaves, and that the same command goes on to the same bytes."""

from __future__ import annotations

import dataclasses
import fcntl
import math
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.data import DatasetError, Transitions, open_dataset
from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.data.columns import from_parquet, to_parquet
from kinetix_dist.data.rollout import ChosenBy, Disturbance
from kinetix_dist.evaluation.policies import NetworkPolicy, Player
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.recipes import recipe
from tests.data.small_collection import NUM_SHARDS, fill_disc_at
from tests.helpers import REPOSITORY


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")}


def test_sticky_actions_are_those_of_the_step_before_and_never_of_another_episode(collected: Path) -> None:
    rows = open_dataset(collected).read()
    repeats = rows.chosen_by == ChosenBy.STICKY
    assert not repeats[rows.first].any()
    np.testing.assert_array_equal(rows.actions[1:][repeats[1:]], rows.actions[:-1][repeats[1:]])


def test_disturbances_are_as_frequent_as_they_are_set(collected: Path) -> None:
    rows = open_dataset(collected).read()
    inside = ~rows.first
    number = inside.sum()
    # A sticky step counts as sticky whatever it replaced: noise is left in 3/4 of a quarter.
    for source, probability in ((ChosenBy.STICKY, 0.25), (ChosenBy.NOISE, 0.25 * 0.75)):
        share = (rows.chosen_by[inside] == source).mean()
        assert abs(share - probability) < 4 * math.sqrt(probability * (1 - probability) / number), (source, share)


def test_log_probability_of_uniform_actions_counts_what_the_level_obeys(collected: Path) -> None:
    data = open_dataset(collected)
    rows, choices = data.read(), np.array([3, 3, 3, 3, 2, 2])
    expected = -(data.levels.bound_heads * np.log(choices)).sum(axis=1)
    np.testing.assert_allclose(rows.log_prob, expected[rows.level], atol=1e-6)  # float32


@pytest.mark.long  # a network is compiled
def test_log_probability_of_a_network_is_that_of_the_executed_action(collection: Collection, tmp_path: Path) -> None:
    """Also where noise chose it: what a method that corrects for the policy needs."""
    env = collection.env
    policy = make_policy(recipe("tiny").policy, env.action_distribution.head_sizes)
    prepared = env.prepare(collection.levels)
    params = init_params(policy, env.observe(prepared, prepared.initial_obs), prng.key(0))
    player = Player(NetworkPolicy(policy, env.action_distribution), params)
    collect(dataclasses.replace(collection, player=player), tmp_path / "data", 1)
    data = open_dataset(tmp_path / "data")
    rows = data.read()
    static, bound = jax.tree.map(lambda x: x[rows.level], (rows.static_obs, data.levels.bound_heads))
    outputs, _ = policy.apply(params, env.observation.join(static, jax.tree.map(jnp.asarray, rows.dynamic_obs)))
    log_probs, _ = env.action_distribution.log_prob_and_entropy(outputs, jnp.asarray(rows.actions), bound=bound)
    np.testing.assert_allclose(rows.log_prob, log_probs, atol=1e-4)  # float32, another batch size
    assert len(np.unique(rows.chosen_by)) == 3


def test_every_level_is_played_by_as_many_worlds(collection: Collection) -> None:
    played = np.concatenate([collection.level_numbers(shard) for shard in range(3)])
    assert np.bincount(played).tolist() == [4, 4, 4]
    assert len({tuple(collection.level_numbers(shard)) for shard in range(3)}) > 1


def test_a_shard_does_not_depend_on_the_others(collection: Collection, collected: Path, tmp_path: Path) -> None:
    collect(collection, tmp_path / "data", 1)
    assert (
        files_of(tmp_path / "data").items()
        >= {"shard-000000.parquet": files_of(collected)["shard-000000.parquet"]}.items()
    )
    assert files_of(collected)["shard-000000.parquet"] != files_of(collected)["shard-000001.parquet"]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.35, 0.5, 0.67, 0.9, 0.999])
def test_a_kill_at_any_byte_of_the_index_is_made_good(
    collection: Collection, collected: Path, data: Path, share: float
) -> None:
    index = data / "shards.jsonl"
    content = index.read_bytes()
    index.write_bytes(content[: int(share * len(content))])
    (data / ".shard-000002.parquet.draft").write_bytes(b"half of a shard")
    num_whole = index.read_bytes().count(b"}")
    if num_whole:
        assert len(open_dataset(data).shards) == num_whole, "what is there is valid before anything goes on"
    assert len(collect(collection, data, NUM_SHARDS)) == NUM_SHARDS
    found, expected = files_of(data), files_of(collected)
    assert {name: found[name] for name in found if name != "shards.jsonl"} == {
        name: expected[name] for name in expected if name != "shards.jsonl"
    }
    np.testing.assert_array_equal(open_dataset(data).read().episode, open_dataset(collected).read().episode)


KILLED = """
import os, signal
from pathlib import Path
from kinetix_dist import atomic_files, prng
from kinetix_dist.data.collect import collect
from kinetix_dist.evaluation.policies import NetworkPolicy, Player
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.recipes import recipe
from tests.data.small_collection import NUM_SHARDS, fill_disc_at, make_collection

def kill(file, flush=atomic_files.flush_to_disk):
    if "shard-000001" in file.name:
        file.truncate(100)
        os.kill(os.getpid(), signal.SIGKILL)
    flush(file)

atomic_files.flush_to_disk = kill
collect(make_collection(), Path({folder!r}), NUM_SHARDS)
"""


def test_a_killed_process_loses_one_shard_and_the_next_goes_on_to_the_same_bytes(
    collection: Collection, collected: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "data"
    code = KILLED.format(folder=str(folder))
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL
    data = open_dataset(folder)
    assert len(data.read().done) == 4 * 20  # shard 0 alone
    assert (
        data.shortfall
        == f"data set {folder} has 1 of the 3 shards that its command was to make; the same command goes on"
    )
    collect(collection, folder, NUM_SHARDS)
    assert files_of(folder) == files_of(collected) and not open_dataset(folder).shortfall


def test_fewer_shards_than_before_are_no_shortfall_and_more_are(collection: Collection, data: Path) -> None:
    collect(collection, data, 1)
    assert open_dataset(data).manifest["shards"] == NUM_SHARDS
    collect(collection, data, NUM_SHARDS + 1)
    (data / "shards.jsonl").write_text("".join((data / "shards.jsonl").read_text().splitlines(keepends=True)[:2]))
    assert "has 2 of the 4 shards" in open_dataset(data).shortfall


def test_a_full_disc_stops_the_collection_and_what_is_written_stays_valid(
    collection: Collection, collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "data"
    fill_disc_at(monkeypatch, "shard-000002")
    with pytest.raises(OSError, match="No space left on device"):
        collect(collection, folder, NUM_SHARDS)
    assert not list(folder.glob(".*")), "a full disc has better uses than half a shard"
    assert len(open_dataset(folder).read().done) == 2 * 4 * 20
    monkeypatch.undo()
    collect(collection, folder, NUM_SHARDS)
    assert files_of(folder) == files_of(collected)


def test_a_missing_shard_is_made_again(collection: Collection, collected: Path, data: Path) -> None:
    (data / "shard-000001.parquet").unlink()
    collect(collection, data, NUM_SHARDS)
    assert files_of(data)["shard-000001.parquet"] == files_of(collected)["shard-000001.parquet"]


def test_other_settings_are_refused(collection: Collection, data: Path) -> None:
    other = dataclasses.replace(collection, seed=4, disturbance=Disturbance())
    with pytest.raises(
        DatasetError, match=r"holds another data set: noise 0.0 instead of 0.25; seed 4 instead of 3 an"
    ):
        collect(other, data, NUM_SHARDS)


def test_two_processes_do_not_write_into_one_folder(collection: Collection, data: Path) -> None:
    with (data / "shards.jsonl").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DatasetError, match="is being written by another process"):
            collect(collection, data, NUM_SHARDS)


def test_shards_that_no_episode_ends_in_are_refused(collection: Collection) -> None:
    with pytest.raises(DatasetError, match=r"has 7 steps .* an episode up to 8: .* shards of 32 transitions or more"):
        dataclasses.replace(collection, num_steps=7)


@pytest.mark.parametrize(
    "actions", [np.arange(5, dtype=np.int8), np.linspace(0, 1, 10, dtype=np.float32).reshape(5, 2)]
)
def test_any_observation_and_action_comes_back_from_a_shard(actions: np.ndarray) -> None:
    """A bare array as of pixels, flat and continuous actions."""
    numbers = np.arange(5)
    columns = {name: numbers.astype(np.float32) for name in ("rewards", "log_prob")}
    columns |= dict.fromkeys(("done", "solved", "timed_out", "first"), numbers % 2 == 0)
    columns |= {name: numbers.astype(np.int32) for name in ("level", "step", "policy_version")}
    rows = Transitions(
        static_obs="static",
        dynamic_obs=np.arange(60, dtype=np.float32).reshape(5, 4, 3),
        actions=actions,
        chosen_by=numbers.astype(np.int8),
        episode=numbers.astype(np.int64),
        **columns,
    )
    shapes = jnp.zeros((1, 4, 3)), jax.ShapeDtypeStruct(actions.shape, actions.dtype)
    found = from_parquet(to_parquet(rows), "static", *shapes)
    for name, value in rows._asdict().items():
        np.testing.assert_array_equal(getattr(found, name), value)
        assert name == "static_obs" or getattr(found, name).dtype == value.dtype
