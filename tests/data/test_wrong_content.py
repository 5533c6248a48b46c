"""Data sets of valid JSON and Parquet whose content is wrong: one line each, and no row is lost silently."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import _check_inputs as check_inputs
from kinetix_dist.data import DatasetError, open_dataset
from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.data.manifest import UNKNOWN_POLICY
from kinetix_dist.data.rollout import ChosenBy, Disturbance
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.policies import NoopPolicy, Player, RandomPolicy
from kinetix_dist.recipes import recipe
from tests.data.small_collection import NUM_SHARDS

ROWS = 80  # of a shard
ACTIONS = "fixed_size_list<item: int8>[6]"
Row = dict[str, Any]


def index_of(data: Path) -> list[Row]:
    return [json.loads(line) for line in (data / "shards.jsonl").read_text().splitlines()]


def write_index(data: Path, lines: list[Row | str]) -> None:
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    (data / "shards.jsonl").write_text("".join(f"{text}\n" for text in texts))


def rewrite(data: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Changes the table of shard 1, and its line of the index with it."""
    path = data / "shard-000001.parquet"
    table = change(pq.read_table(path))
    pq.write_table(table, path)
    rows = index_of(data)
    rows[1] |= {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    write_index(data, list(rows))


def with_value(name: str, value: Any, row: int = 17) -> Callable[[pa.Table], pa.Table]:
    """Sets a row of a column, or the first number of its list."""

    def change(table: pa.Table) -> pa.Table:
        column = table.column(name)
        values = column.to_pylist()
        values[row] = [value, *values[row][1:]] if isinstance(values[row], list) else value
        return table.set_column(table.column_names.index(name), name, pa.array(values, column.type))

    return change


def with_type(name: str, arrow_type: pa.DataType) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(
        table.column_names.index(name), name, table.column(name).combine_chunks().cast(arrow_type)
    )


def narrowed(name: str) -> Callable[[pa.Table], pa.Table]:
    """Keeps the first three numbers of each list."""

    def change(table: pa.Table) -> pa.Table:
        column = table.column(name)
        values = pa.array([row[:3] for row in column.to_pylist()], pa.list_(column.type.value_type, 3))
        return table.set_column(table.column_names.index(name), name, values)

    return change


def of_the_policy(change: Callable[[pa.Table], pa.Table]) -> Callable[[pa.Table], pa.Table]:
    """Marks the action of row 17 as a choice of the policy, too."""
    return lambda table: with_value("chosen_by", int(ChosenBy.POLICY))(change(table))


def change_manifest(data: Path, change: Callable[[Row], None]) -> None:
    manifest = json.loads((data / "dataset.json").read_text())
    change(manifest)
    (data / "dataset.json").write_text(json.dumps(manifest))


def one_line(error: pytest.ExceptionInfo[DatasetError]) -> str:
    text = str(error.value)
    assert text.isprintable() and len(text) < 800
    return text


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("levels", None, "levels is missing or of another type"),
        ("levels", {"set": "x", "number": 3}, "levels.sha256 is missing or of another type"),
        ("levels", {"set": "x", "number": 3, "sha256": "0", "fingerprint": "0000.1"}, "levels.sha256 is malformed"),
        ("policy", [], "policy is missing or of another type"),
        ("env", "s", "env is missing or of another type"),
        ("physics", 1, "physics is missing or of another type"),
        ("shard_transitions", 0, "a data set has at least one level and one transition a shard"),
        ("shard_transitions", "80", "shard_transitions is missing or of another type"),
    ],
)
def test_a_manifest_without_what_is_read_is_one_line(
    data: Path, capsys: pytest.CaptureFixture[str], name: str, value: Any, text: str
) -> None:
    manifest = json.loads((data / "dataset.json").read_text())
    manifest[name] = value
    (data / "dataset.json").write_text(json.dumps({k: v for k, v in manifest.items() if v is not None}))
    with pytest.raises(DatasetError) as error:
        open_dataset(data)
    assert f"dataset.json is damaged: {text}; copy the data set again" in one_line(error)
    assert main(["data", "export-minari", str(data), "kinetix/random-v0"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"file": "../x"}, "file is '../x'; shard 1 is shard-000001.parquet"),
        ({"file": "/etc/passwd"}, "file is '/etc/passwd'; shard 1 is"),
        ({"file": 7}, "file is 7; shard 1 is"),
        ({"file": "a\0b"}, r"file is 'a\x00b'; shard 1 is"),
        ({"file": "."}, "file is '.'; shard 1 is"),
        ({"file": "shard-000000.parquet"}, "file is 'shard-000000.parquet'; shard 1 is"),
        ({"rows": 10**9}, "rows is 1,000,000,000; a shard of this data set has 1 to 80"),
        ({"rows": -5}, "rows is -5, not a count"),
        ({"rows": True}, "rows is True, not a count"),
        ({"shard": 1.0}, "shard is 1.0, not a count"),
        ({"sha256": 5}, "sha256 is 5, not 64 hexadecimal digits"),
        ({"sha256": None}, "sha256 is None, not 64"),
        ({"solved": 81}, "81 of 15 episodes in 80 rows are solved"),
        ({"extra": 1}, "'extra' is unknown"),
        ("{}", "shard is missing"),
        ('{"shard": 1, "file": "sha', "Unterminated string"),
        ("[1]", "it holds a list, not an object"),
    ],
)
def test_a_line_of_the_index_that_cannot_be_used_is_reported_and_made_good(
    collection: Collection, collected: Path, data: Path, change: Row | str, text: str
) -> None:
    rows = index_of(data)
    rows[1]["episodes"] = 15
    write_index(data, [rows[0], change if isinstance(change, str) else rows[1] | change, rows[2]])
    with pytest.raises(DatasetError) as error:
        open_dataset(data)
    line = one_line(error)
    assert "shards.jsonl: line 2 cannot be used" in line and text in line and "made the data set again" in line
    skipping = open_dataset(data, skip_damaged=True)
    assert len(skipping) == len(skipping.read().done) == 2 * ROWS and len(skipping.skipped) == 1
    collect(collection, data, NUM_SHARDS)
    assert len(open_dataset(data).read().done) == NUM_SHARDS * ROWS
    for number in range(NUM_SHARDS):
        name = f"shard-{number:06d}.parquet"
        assert (data / name).read_bytes() == (collected / name).read_bytes()


def test_a_line_that_is_missing_in_the_middle_is_reported(collection: Collection, data: Path) -> None:
    rows = index_of(data)
    write_index(data, [rows[0], rows[2]])
    with pytest.raises(DatasetError, match=r"shards.jsonl: there is no line of shard 1; run the command"):
        open_dataset(data)
    skipping = open_dataset(data, skip_damaged=True)
    assert len(skipping.skipped) == 1 and len(skipping) == 2 * ROWS
    write_index(data, [rows[2]])
    with pytest.raises(DatasetError, match="there is no line of shards 0 to 1"):
        open_dataset(data)
    collect(collection, data, NUM_SHARDS)
    assert len(open_dataset(data)) == NUM_SHARDS * ROWS


def test_training_takes_a_damaged_index_if_it_may_skip(data: Path) -> None:
    rows = index_of(data)
    write_index(data, [rows[0], rows[2]])
    config = recipe("clone_s")
    for may_skip in (False, True):
        imitation = dataclasses.replace(config.imitation, data=str(data), skip_damaged=may_skip)
        run = dataclasses.replace(config, imitation=imitation)
        with contextlib.nullcontext() if may_skip else pytest.raises(DatasetError, match="no line of shard 1"):
            check_inputs(run, is_new=True)


def test_a_damaged_last_line_is_no_torn_one(data: Path) -> None:
    """A killed writer leaves no line end."""
    lines = (data / "shards.jsonl").read_text().splitlines()
    write_index(data, [*lines[:2], lines[2][:50]])
    with pytest.raises(DatasetError, match="line 3 cannot be used"):
        open_dataset(data)
    (data / "shards.jsonl").write_text("\n".join([*lines[:2], lines[2][:50]]))
    assert len(open_dataset(data)) == 2 * ROWS


def test_an_index_of_an_astronomical_number_is_one_line(data: Path) -> None:
    rows = index_of(data)
    number = 2**50
    write_index(data, [*rows, rows[2] | {"shard": number, "file": f"shard-{number}.parquet"}])
    with pytest.raises(DatasetError, match=f"there is no line of shards 3 to {number - 1}"):
        open_dataset(data)


def test_an_index_or_a_shard_that_is_a_directory_is_one_line(data: Path) -> None:
    (data / "shard-000001.parquet").unlink()
    (data / "shard-000001.parquet").mkdir()
    with pytest.raises(DatasetError, match=r"shard-000001.parquet cannot be read: Is a directory"):
        open_dataset(data).read()
    (data / "shards.jsonl").unlink()
    (data / "shards.jsonl").mkdir()
    with pytest.raises(DatasetError, match=r"shards.jsonl cannot be read: Is a directory"):
        open_dataset(data)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (with_value("level", 99), "row 17 is of a level that is not one of 0 to 2"),
        (with_value("level", -1), "row 17 is of a level that is not one of 0 to 2"),
        (with_value("action", 77), "row 17 has an action that multi_discrete actions cannot have"),
        (with_value("reward", None), "column reward has 1 missing values"),
        (with_value("reward", math.nan), "row 17 has a reward that is not finite"),
        (with_value("observation.bodies", None), "column observation.bodies has 1 missing values"),
        (with_value("observation.bodies", math.inf), "row 17 has an observation that is not finite"),
        (with_value("chosen_by", 3), "row 17 has a chosen_by that does not exist"),
        (with_value("step", 7, row=0), "row 0 is not row 80 and so on of the data set"),
        (with_value("episode", 0), "row 17 is not row 80 and so on of the data set"),
        (with_value("first", False, row=0), "row 0 is a first step by only one of first and step"),
        (with_value("policy_version", -2), "row 17 is of a negative policy_version"),
        (with_value("log_prob", math.nan), "row 17 has a log_prob that is not finite"),
        (with_value("log_prob", math.inf), "row 17 has a log_prob that is not finite"),
        (with_value("log_prob", 5.0), "row 17 has a log_prob above 0, a probability above 1"),
        (with_value("log_prob", 2e-5), "row 17 has a log_prob above 0, a probability above 1"),
        (of_the_policy(with_value("log_prob", -math.inf)), "row 17 has an action of the policy with probability 0"),
        *(
            (with_type("action", pa.list_(value, 6)), f": {value}>[6], not {ACTIONS}")
            for value in (pa.float64(), pa.int64(), pa.uint64(), pa.uint8(), pa.float32(), pa.int32())
        ),
        (narrowed("action"), f": int8>[3], not {ACTIONS}"),
        (with_type("reward", pa.float64()), "column reward has double, not float"),
        (with_type("level", pa.int64()), "column level has int64, not int32"),
        (lambda table: table.drop_columns(["step"]), "column step is missing"),
        (lambda table: table.append_column("step", table.column("step")), "column step comes twice"),
        (lambda table: table.slice(0, 79), "it has 79 rows, and 80 in the index"),
        (lambda table: pa.concat_tables([table.slice(1), table.slice(0, 1)]), "is not row 80 and so on"),
    ],
)
def test_a_shard_of_other_rows_is_one_line(data: Path, change: Callable[[pa.Table], pa.Table], text: str) -> None:
    rewrite(data, change)
    with pytest.raises(DatasetError) as error:
        open_dataset(data).read()
    line = one_line(error)
    assert "shard-000001.parquet holds no valid transitions: " in line and text in line and "skip_damaged" in line
    skipping = open_dataset(data, skip_damaged=True)
    assert len(skipping.read().done) == 2 * ROWS and len(skipping.skipped) == 1


@pytest.mark.parametrize("name", ["episodes", "solved"])
def test_counts_of_the_index_are_those_of_the_rows(data: Path, name: str) -> None:
    rows = index_of(data)
    rows[1][name] += 1 if name == "episodes" else -1 if rows[1][name] else 1
    write_index(data, list(rows))
    with pytest.raises(DatasetError, match=rf"it has \d+ {name}, and {rows[1][name]} in the index"):
        open_dataset(data).read()


def test_a_copy_of_a_shard_is_no_other_shard(data: Path) -> None:
    """Its rows would count twice."""
    rows = index_of(data)
    (data / "shard-000001.parquet").write_bytes((data / "shard-000000.parquet").read_bytes())
    write_index(data, [rows[0], rows[0] | {"shard": 1, "file": "shard-000001.parquet"}, rows[2]])
    with pytest.raises(DatasetError, match="row 0 is not row 80 and so on of the data set"):
        open_dataset(data).read()


@pytest.mark.parametrize("size", [0, -1, 10**9, 241])
def test_batches_of_an_impossible_size_are_refused_at_once(data: Path, size: int) -> None:
    with pytest.raises(DatasetError, match=f"batch_size is {size:,}; give 1 to 240"):
        open_dataset(data).batches(size, seed=0)
    assert [len(batch.done) for batch in open_dataset(data).batches(240, seed=0)] == [240]


def test_shards_that_are_not_there_are_refused(data: Path) -> None:
    for number in (3, -1):
        with pytest.raises(DatasetError, match=f"has shards 0 to 2, and no {number}"):
            open_dataset(data).read([number])
    with pytest.raises(DatasetError, match="shards_at_once is 0"):
        open_dataset(data).batches(8, seed=0, shards_at_once=0)


def test_a_pass_that_can_fill_no_batch_says_so(data: Path) -> None:
    for number in range(NUM_SHARDS):
        (data / f"shard-{number:06d}.parquet").unlink()
    with pytest.raises(DatasetError, match="the 0 transitions that can be read fill no batch of 8"):
        list(open_dataset(data, skip_damaged=True).batches(8, seed=0))


def test_levels_of_another_shape_are_one_line(data: Path) -> None:
    with np.load(data / "levels.npz") as file:
        arrays = dict(file)
    np.savez_compressed(data / "levels.npz", **arrays | {"robot_mask": arrays["robot_mask"][:2]})
    manifest = json.loads((data / "dataset.json").read_text())
    manifest["levels"]["sha256"] = hashlib.sha256((data / "levels.npz").read_bytes()).hexdigest()
    (data / "dataset.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match=r"levels.npz is not of this environment, or of another version: robot_mask"):
        open_dataset(data).read()


def test_the_same_levels_by_another_name_are_the_same_data_set(collection: Collection, data: Path) -> None:
    other = dataclasses.replace(collection, level_set="/elsewhere/three")
    assert len(collect(other, data, NUM_SHARDS)) == NUM_SHARDS
    assert json.loads((data / "dataset.json").read_text())["levels"]["set"] == "three"
    others = dataclasses.replace(other, level_names=["a", "b", "c"])
    with pytest.raises(DatasetError, match=r"holds another data set: levels\.set .*; levels\.sha256"):
        collect(others, data, NUM_SHARDS)


@pytest.mark.parametrize(
    ("observation", "action_space"), [("flat", "discrete"), ("pixels", "continuous"), ("entity_kinetix", "continuous")]
)
def test_every_observation_and_action_that_is_collected_is_valid(
    collection: Collection, tmp_path: Path, observation: str, action_space: str
) -> None:
    env = Environment(dataclasses.replace(collection.env.config, observation=observation, action_space=action_space))
    player = Player(RandomPolicy(env.action_space))
    collect(dataclasses.replace(collection, env=env, player=player), tmp_path / "data", 1)
    assert len(open_dataset(tmp_path / "data").read().done) == ROWS


def test_an_action_that_the_policy_never_takes_has_probability_zero(collection: Collection, tmp_path: Path) -> None:
    player = Player(NoopPolicy(collection.env.action_space))
    disturbed = dataclasses.replace(collection, player=player, disturbance=Disturbance(noise=0.5))
    collect(disturbed, tmp_path / "data", 1)
    rows = open_dataset(tmp_path / "data").read()
    assert np.isneginf(rows.log_prob).any() and (rows.log_prob == 0).any()


def test_log_probabilities_are_unknown_if_the_policy_is(data: Path) -> None:
    def forget(manifest: Row) -> None:
        manifest["policy"]["name"] = UNKNOWN_POLICY

    change_manifest(data, forget)
    with pytest.raises(DatasetError, match="row 0 has a log_prob, and the policy is unknown"):
        open_dataset(data).read([1])

    def without(table: pa.Table) -> pa.Table:
        values = pa.array(np.full(ROWS, np.nan, np.float32))
        return table.set_column(table.column_names.index("log_prob"), "log_prob", values)

    rewrite(data, without)
    assert np.isnan(open_dataset(data).read([1]).log_prob).all()
    change_manifest(data, lambda manifest: manifest["policy"].update(sha256="0" * 64))  # a run of that name
    with pytest.raises(DatasetError, match="row 0 has a log_prob that is not finite"):
        open_dataset(data).read([1])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"number": 99}, "levels.npz has 3 levels, and the manifest 99"),
        ({"fingerprint": "0000.1 0000.2 0000.3"}, "levels.npz has other levels than the fingerprint of the manifest"),
        ({"fingerprint": "0000.1"}, "levels.npz has other levels than the fingerprint of the manifest"),
    ],
)
def test_levels_are_those_of_the_manifest(data: Path, change: Row, text: str) -> None:
    change_manifest(data, lambda manifest: manifest["levels"].update(change))
    with pytest.raises(DatasetError) as error:
        open_dataset(data).read()
    assert text in one_line(error)


def test_a_fingerprint_of_endless_digits_is_malformed(data: Path) -> None:
    change_manifest(data, lambda manifest: manifest["levels"].update(fingerprint="0000." + "1" * 5000))
    with pytest.raises(DatasetError, match=r"levels\.fingerprint is malformed"):
        open_dataset(data)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"version": 1,', '"version": 1, "version": 1,', "an object has the key 'version' twice"),
        ('"version": 1,', '"version": true,', "has format version True, and"),
        ('"version": 1,', '"version": 1.0,', "has format version 1.0, and"),
        ('"version": 1,', "", "has format version None, and"),
        ('"number": 3,', f'"number": {10**30},', "levels.number is an integer of more than 64 bits"),
        ('"shard_transitions": 80', f'"shard_transitions": {10**30}', "shard_transitions is an integer of more than"),
        ('"noise": 0.25', '"noise": NaN', "noise is nan, which JSON does not have"),
    ],
)
def test_a_manifest_is_strict_json(data: Path, old: str, new: str, text: str) -> None:
    path = data / "dataset.json"
    stored = path.read_text()
    assert stored.count(old) == 1
    path.write_text(stored.replace(old, new))
    with pytest.raises(DatasetError) as error:
        open_dataset(data)
    assert text in one_line(error)


def test_a_manifest_that_is_no_object_is_one_line(data: Path) -> None:
    (data / "dataset.json").write_text("[1]")
    with pytest.raises(DatasetError, match=r"dataset.json holds no JSON object; copy the data set again"):
        open_dataset(data)


def test_rows_that_64_bits_cannot_number_are_a_fault_of_the_index(data: Path) -> None:
    change_manifest(data, lambda manifest: manifest.update(shard_transitions=2**62))
    with pytest.raises(
        DatasetError, match=r"line 2 cannot be used: shard is 1: the numbers of its rows have more than"
    ):
        open_dataset(data)
    assert len(open_dataset(data, skip_damaged=True).read().done) == ROWS


@pytest.mark.parametrize("hostile", ["\x1b[2J\u202e\n" * 10, "y" * 100_000, ["\x1b" * 50_000], {"\x1b": "z" * 100_000}])
@pytest.mark.parametrize("name", ["format", "version", "package", "physics", "env", "levels", "policy"])
def test_messages_quote_a_manifest_in_short_and_printable_text(data: Path, name: str, hostile: Any) -> None:
    def change(manifest: Row) -> None:
        manifest[name] = hostile
        if name == "package":
            manifest["version"] = 2

    change_manifest(data, change)
    with pytest.raises(DatasetError) as error:
        dataset = open_dataset(data)
        dataset.check_env(dataset.env_config)
    one_line(error)


def test_the_error_of_a_data_set_is_one_printable_line() -> None:
    text = str(DatasetError("a\x1b[2J\n\u202e" + "z" * 100_000))
    assert text.isprintable() and len(text) <= 2000
