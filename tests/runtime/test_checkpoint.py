"""A checkpoint restores exactly what was saved, and a damaged one is never used."""

import json
import shutil
import signal
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.checkpoint import (
    ArrayMismatchError,
    CheckpointError,
    flatten_arrays,
    list_checkpoints,
    load_checkpoint,
    newest_good,
    remove_dead_drafts,
    save_alone,
    save_checkpoint,
    store,
    unflatten_arrays,
)
from tests.helpers import REPOSITORY


def _state(seed: int) -> dict:
    rng = np.random.default_rng(seed)
    return {
        "params": {"kernel": rng.normal(size=(3, 4)).astype(np.float32), "bias": jnp.ones((4,), jnp.bfloat16)},
        "counters": (np.int32(seed), np.asarray([True, False])),
        "key": jax.random.key(seed),
        "nothing": np.zeros((0, 2), np.float32),
    }


def _save(directory, number: int, keep: int = 5):
    return save_checkpoint(directory, number, flatten_arrays(_state(number)), {"config_hash": "abc"}, keep=keep)


def test_what_was_saved_is_restored_bit_for_bit(tmp_path):
    path = _save(tmp_path, 7)
    checkpoint = load_checkpoint(path)
    restored = unflatten_arrays(_state(0), checkpoint.arrays)
    expected, got = flatten_arrays(_state(7)), flatten_arrays(restored)
    assert expected.keys() == got.keys()
    assert restored["nothing"].shape == (0, 2)
    for name in expected:
        assert expected[name].dtype == got[name].dtype
        np.testing.assert_array_equal(expected[name], got[name], err_msg=name)
    assert checkpoint.description["config_hash"] == "abc"
    assert checkpoint.description["num_updates"] == 7


def test_only_the_newest_stay(tmp_path):
    for number in (1, 2, 3):
        _save(tmp_path, number, keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["00000002", "00000003"]


def _flip_a_byte(path):
    file = max((f for f in (path / "arrays").rglob("*") if f.is_file()), key=lambda f: f.stat().st_size)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


def _truncate(path):
    file = max((f for f in (path / "arrays").rglob("*") if f.is_file()), key=lambda f: f.stat().st_size)
    file.write_bytes(file.read_bytes()[:-1])


def _empty(path):
    shutil.rmtree(path)
    path.mkdir()


def _lose_the_description(path):
    (path / "checkpoint.json").unlink()


@pytest.mark.parametrize("damage", [_flip_a_byte, _truncate, _empty, _lose_the_description])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(tmp_path, damage):
    _save(tmp_path, 1)
    newest = _save(tmp_path, 2)
    damage(newest)
    with pytest.raises(CheckpointError, match="00000002"):
        load_checkpoint(newest)
    good, rejected = newest_good(tmp_path)
    assert good is not None and good.description["num_updates"] == 1
    assert [r.path for r in rejected] == [newest]


def test_a_save_that_was_interrupted_is_not_a_checkpoint(tmp_path):
    _save(tmp_path, 1)
    shutil.copytree(tmp_path / "00000001", tmp_path / ".saving-00000002-1")
    good, rejected = newest_good(tmp_path)
    assert good is not None and good.path.name == "00000001" and not rejected


def test_arrays_of_another_structure_are_refused_by_name():
    arrays = flatten_arrays(_state(0))
    template = _state(0)
    template["params"]["kernel"] = np.zeros((3, 5), np.float32)
    with pytest.raises(ArrayMismatchError, match=r"params/kernel is float32\[3, 4\], expected float32\[3, 5\]"):
        unflatten_arrays(template, arrays)
    del arrays["counters/1"]
    with pytest.raises(ArrayMismatchError, match="counters/1 is missing"):
        unflatten_arrays(_state(0), arrays)


# Pruning


def test_pruning_counts_good_checkpoints_only_and_keeps_the_newest_good_one(tmp_path):
    """Bad ones with high numbers once crowded out what was saved after them: a save deleted its own checkpoint."""
    for number in (10, 20, 30):
        _flip_a_byte(_save(tmp_path, number))
    _save(tmp_path, 4, keep=2)
    _save(tmp_path, 6, keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == [f"{n:08d}" for n in (4, 6, 10, 20, 30)]
    _save(tmp_path, 8, keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)][:2] == ["00000006", "00000008"]
    _save(tmp_path, 31, keep=1)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["00000031"]


def test_a_manifest_that_makes_no_sense_is_a_reason_not_a_traceback(tmp_path):
    path = _save(tmp_path, 1)
    for content in ("[]", '{"files": [1]}', '{"files": {"checkpoint.json": 3}}', "\x00"):
        (path / "manifest.json").write_text(content)
        with pytest.raises(CheckpointError, match=r"manifest\.json cannot be read"):
            load_checkpoint(path)


@pytest.mark.parametrize("name", ["../outside.json", "/proc/kmsg", "{outside}"])
def test_a_manifest_reads_no_file_outside_of_its_checkpoint(name, tmp_path):
    path, outside = _save(tmp_path / "run", 1), tmp_path / "run" / "outside.json"
    outside.write_text("{}")
    named = name.format(outside=outside)
    (path / "manifest.json").write_text(json.dumps({"files": {named: {"bytes": 99, "sha256": "x"}}}))
    with pytest.raises(CheckpointError, match=r"file .* is missing"):
        load_checkpoint(path)


def test_a_manifest_of_no_files_verifies_nothing(tmp_path):
    path = _save(tmp_path, 1)
    (path / "manifest.json").write_text('{"files": {}}')
    with pytest.raises(CheckpointError, match="lists no files"):
        load_checkpoint(path)


def test_what_is_saved_is_read_and_verified_once(tmp_path, monkeypatch):
    verified = []
    fault = store.manifest_fault
    monkeypatch.setattr(store, "manifest_fault", lambda path: verified.append(path.name) or fault(path))
    _save(tmp_path, 2, keep=2)
    _save(tmp_path, 4, keep=2)
    drafts = [name for name in verified if name.startswith(".saving-")]
    assert len(drafts) == 2 and verified == [drafts[0], drafts[1], "00000002"]


# Drafts


def test_drafts_of_dead_processes_are_removed_and_those_of_living_ones_stay(tmp_path):
    living = subprocess.Popen(["sleep", "60"])
    dead = subprocess.Popen(["true"])
    dead.wait()
    host = socket.gethostname()
    names = {
        "living": f".saving-00000002-{living.pid}@{host}",
        "older version": f".saving-00000004-{living.pid}",
        "dead": f".saving-00000002-{dead.pid}@{host}",
        "same number, another host": f".saving-00000002-{living.pid}@elsewhere",
        "nonsense": ".saving-x",
    }
    try:
        for name in names.values():
            (tmp_path / name / "arrays").mkdir(parents=True)
        _save(tmp_path, 1)
        removed = remove_dead_drafts(tmp_path)
        assert set(removed) == {names["dead"], names["same number, another host"], names["nonsense"]}
        left = {path.name for path in tmp_path.iterdir()}
        assert left == {names["living"], names["older version"], "00000001"}
    finally:
        living.kill()
        living.wait()


def test_there_are_no_drafts_where_there_is_no_directory(tmp_path):
    assert remove_dead_drafts(tmp_path / "nothing") == []


KILLED = """
import os, signal
from pathlib import Path
import numpy as np
from kinetix_dist.checkpoint import save_alone, store

def kill(directory, write=store.write_manifest, calls=[]):
    write(directory)
    calls.append(directory)
    if len(calls) == 2:  # of the checkpoint, then of the directory that is published
        os.kill(os.getpid(), signal.SIGKILL)

store.write_manifest = kill
save_alone(Path({to!r}), 7, {{"params/x": np.ones(3, np.float32)}}, {{}})
"""


def test_a_killed_process_leaves_no_checkpoint_of_its_own_and_the_next_saves_one(tmp_path):
    to = tmp_path / "policy"
    (tmp_path / ".policy-draft").mkdir()  # a directory of the user
    (tmp_path / ".policy-draft" / "notes.txt").write_text("mine")
    code = KILLED.format(to=str(to))
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL and not to.exists()
    assert list(tmp_path.glob("*/manifest.json")), "everything was written but the name"
    save_alone(to, 8, flatten_arrays(_state(8)), {})
    assert load_checkpoint(to).description["num_updates"] == 8
    assert (tmp_path / ".policy-draft" / "notes.txt").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"policy", ".policy-draft"}
