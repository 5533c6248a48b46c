"""Snapshots of a curriculum: what is written is read back, old ones lose their levels, later ones go with a rewind."""

import subprocess
import sys
import zipfile

import numpy as np
import pytest

from kinetix_dist.telemetry.curriculum_log import (
    BUFFER,
    REFRESH,
    CurriculumLogConfig,
    SnapshotError,
    level_ids,
    list_snapshots,
    read_outcomes,
    read_snapshot,
    remove_later_snapshots,
    snapshot_name,
    thin_snapshots,
    write_snapshot,
)
from tests.helpers import PATIENCE_S


def _arrays(number, num_levels=3):
    rng = np.random.default_rng(number)
    return {
        "written_after": np.int32(number),
        "score": rng.random(num_levels, np.float32),
        "candidates/solved": rng.integers(0, 9, 20, np.int32),
        "levels/position": rng.random((num_levels, 7, 2), np.float32),
        "levels/scene/shapes/active": rng.random((num_levels, 7)) < 0.5,
    }


def test_what_is_written_is_read_back(tmp_path):
    arrays = _arrays(5)
    path = write_snapshot(tmp_path / "curriculum", REFRESH, 128, arrays)
    assert path.name == "refresh_00000128.npz" and [*path.parent.iterdir()] == [path]
    snapshot = read_snapshot(path)
    assert (snapshot.kind, snapshot.number, snapshot.has_levels) == (REFRESH, 128, True)
    assert snapshot.levels is not None
    for name, array in arrays.items():
        found = snapshot.levels[name.removeprefix("levels/")] if name.startswith("levels/") else snapshot.arrays[name]
        np.testing.assert_array_equal(found, array, strict=True)
    without = read_snapshot(path, with_levels=False)
    assert without.levels is None and without.has_levels and without.arrays.keys() == snapshot.arrays.keys()


@pytest.mark.parametrize("max_snapshots", [2, 5, 8])
def test_levels_stay_in_the_newest_and_in_evenly_spread_files_and_all_counts_stay(tmp_path, max_snapshots):
    for number in range(40):
        write_snapshot(tmp_path, REFRESH, number, _arrays(number))
        thin_snapshots(tmp_path, REFRESH, max_snapshots)
        found = [read_snapshot(path) for _, _, path in list_snapshots(tmp_path)]
        assert [snapshot.number for snapshot in found] == [*range(number + 1)]
        with_levels = [snapshot.number for snapshot in found if snapshot.has_levels]
        assert with_levels[0] == 0 and with_levels[-1] == number and len(with_levels) <= max_snapshots
        assert len(with_levels) > min(number, (max_snapshots - 1) // 2)
        assert len({*np.diff(with_levels[:-1])}) <= 1, "what stays but the newest is evenly spread"
    for snapshot in found:
        arrays = _arrays(snapshot.number)
        np.testing.assert_array_equal(snapshot.arrays["candidates/solved"], arrays["candidates/solved"], strict=True)
        if snapshot.levels:
            np.testing.assert_array_equal(snapshot.levels["position"], arrays["levels/position"], strict=True)


@pytest.mark.parametrize("is_curated", [False, True])
def test_what_a_resumed_run_will_write_again_is_removed(tmp_path, is_curated):
    for kind in (REFRESH, BUFFER):
        for number in (0, 4, 8, 12):
            write_snapshot(tmp_path, kind, number, _arrays(number))
    (tmp_path / snapshot_name(REFRESH, 16)).write_bytes(b"half")
    (tmp_path / ".refresh_00000020.npz.draft").write_bytes(b"a kill left it")
    damaged = remove_later_snapshots(tmp_path, 8, is_curated=is_curated)
    assert [path.name for path in damaged] == [snapshot_name(REFRESH, 16)]
    # A buffer is written with the checkpoint of its update, a refresh is adopted after it, or before it.
    left = [(kind, number) for kind, number, _ in list_snapshots(tmp_path) if number < 16]
    known = [(BUFFER, 0), (REFRESH, 0), (BUFFER, 4), (REFRESH, 4), (BUFFER, 8)]
    assert left == known + [(REFRESH, 8)] * is_curated


def _cut(path):
    path.write_bytes(path.read_bytes()[:-40])


def _flip(path):
    with zipfile.ZipFile(path) as file:
        info = file.getinfo("levels/position.npy")
        start = info.header_offset + 30 + len(info.filename) + len(info.extra)
    content = bytearray(path.read_bytes())
    content[start + info.compress_size // 2] ^= 0xFF
    path.write_bytes(content)


def _other_format(path):
    np.savez_compressed(path, format=np.int32(99))


@pytest.mark.parametrize("damage", [_cut, _flip, _other_format, lambda path: path.write_bytes(b"")])
def test_a_damaged_file_is_refused_in_one_line_that_names_it(tmp_path, damage):
    path = write_snapshot(tmp_path, REFRESH, 3, _arrays(3))
    damage(path)
    with pytest.raises(SnapshotError) as caught:
        read_snapshot(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_disk_that_does_not_take_a_file_leaves_no_draft(tmp_path):
    (tmp_path / snapshot_name(REFRESH, 1)).mkdir()  # nothing can be renamed to it
    with pytest.raises(OSError):
        write_snapshot(tmp_path, REFRESH, 1, _arrays(1))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_equal_levels_have_equal_ids_whatever_is_around_them():
    levels = {"a": np.arange(12, dtype=np.float32).reshape(4, 3), "b": np.array([True, False, True, False])}
    ids = level_ids(levels)
    assert ids.dtype == np.uint64 and len({*ids.tolist()}) == 4
    order = np.array([2, 0, 0])
    np.testing.assert_array_equal(level_ids({name: levels[name][order] for name in "ba"}), ids[order])
    changed = {"a": np.nextafter(levels["a"], 100), "b": levels["b"]}
    assert not np.intersect1d(level_ids(changed), ids).size
    assert level_ids({name: array[:0] for name, array in levels.items()}).shape == (0,)


def test_lines_that_are_none_are_left_out(tmp_path):
    path = tmp_path / "outcomes.jsonl"
    assert read_outcomes(path) == []
    old, good = (f'{{"format": {number}, "update": 16, "from_update": 0, "sources": {{}}}}' for number in (1, 2))
    path.write_text(f'{old}\n{good}\n\0\0\0\n{{"format": 3, "update": 3, "sources": {{}}}}\n{good[:20]}')
    assert [(row["format"], row["update"]) for row in read_outcomes(path)] == [(2, 16)]


@pytest.mark.parametrize("field", ["outcomes_every", "probe_levels", "probe_every", "max_snapshots"])
def test_a_negative_number_is_refused(field):
    with pytest.raises(ValueError, match=f"{field} is -1"):
        CurriculumLogConfig(**{field: -1})


@pytest.mark.parametrize(
    ("config", "refreshes"),
    [({}, [1, 2, 3, 4, 5, 6]), ({"probe_every": 3}, [3, 6]), ({"probe_every": 3, "probe_levels": 0}, [])],
)
def test_every_so_many_refreshes_play_levels_again_and_never_the_first(config, refreshes):
    assert [number for number in range(7) if CurriculumLogConfig(**config).has_probe(number)] == refreshes


def test_no_refresh_is_every_zeroth():
    with pytest.raises(ValueError, match="probe_every is 0; it must be 1 or more"):
        CurriculumLogConfig(probe_every=0)


def test_one_snapshot_is_too_few():
    with pytest.raises(ValueError, match="max_snapshots is 1"):
        CurriculumLogConfig(max_snapshots=1)


def test_readers_need_no_jax():
    modules = "kinetix_dist.telemetry.curriculum_log, kinetix_dist.telemetry.status"
    code = f"import sys, {modules}; print([name for name in sys.modules if name.split('.')[0] in ('jax', 'flax')])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    assert found.stdout.strip() == "[]"
