"""Offline data of the public Kinetix package: states equal to the package's, and one line for what is wrong."""

from __future__ import annotations

import dataclasses
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.data import DatasetError, open_dataset
from kinetix_dist.data.kinetix_import import choose, rows_of
from kinetix_dist.data.kinetix_offline import FIELDS, STATE, KinetixOffline
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.walls import WALL_CENTRES_M
from tests.data.kinetix_sample import ANSWER, STORED, answer_of, write_sample
from tests.helpers import REPOSITORY
from tests.kinetix_package import assert_same_observation

CEILING = 3  # polygon slot
TOUCHING = 3  # attention mask


class Changed(KinetixOffline):
    """The stored sample with some fields replaced, as data of another convention have them."""

    def __init__(self, **fields: np.ndarray) -> None:
        super().__init__(STORED)
        self._fields = {name.replace("__", "/"): array for name, array in fields.items()}

    def read(self, start: int, stop: int, fields: Sequence[str] = FIELDS) -> dict[str, np.ndarray]:
        changed = {name: array[start:stop] for name, array in self._fields.items()}
        return {name: changed.get(name, array) for name, array in super().read(start, stop, fields).items()}


@pytest.fixture(scope="module")
def stored() -> dict[str, np.ndarray]:
    return KinetixOffline(STORED).read(0, 6)


def assert_same_states(folder: Path, answer: dict[str, np.ndarray], out: Path) -> None:
    """Arrays to the bit, and the observations of the imported data set, are those of the package."""
    source = KinetixOffline(folder)
    read = source.read(0, len(source))
    for field in FIELDS:
        theirs = answer[field if field in answer else f"state.{field.removeprefix(STATE)}"]
        assert read[field].dtype == theirs.dtype, field
        np.testing.assert_array_equal(read[field], theirs, err_msg=field)

    assert main(["data", "import-kinetix", str(folder), str(out), "--observation", "entity_kinetix"]) == 0
    data = open_dataset(out)
    rows = data.read()
    np.testing.assert_array_equal(
        rows.actions, np.clip(read["action"], *_bounds(data.env_config.action_space)).reshape(-1, 6)
    )
    env = Environment(data.env_config)
    static = jax.tree.map(lambda x: x[rows.level], rows.static_obs)
    ours = jax.jit(env.observation.join)(static, rows.dynamic_obs)
    # The package draws random levels under a ceiling with one corner outside of the box; it is mended.
    polygons, mended = answer["obs.polygons"].copy(), np.asarray(ours.polygons)
    assert np.count_nonzero(np.any(polygons[:, CEILING] != mended[:, CEILING], axis=0)) == 1
    polygons[:, CEILING] = mended[:, CEILING]
    # A level has the ends of its joints in a canonical order, with signs to match: such rows are another notation.
    theirs = answer | {"obs.polygons": polygons}
    joints = data.levels.levels.scene.joints
    is_swapped = joints.active & (joints.a != answer["state.joint/a_index"][:, 0])
    assert not is_swapped.all()
    rows_of_swapped = np.tile(is_swapped, 2)[rows.level]
    ends = np.stack([ours.joint_from, ours.joint_to], axis=-1)
    for name, array in (("obs.joints", np.asarray(ours.joints)), ("obs.joint_indexes", ends)):
        theirs[name] = np.where(rows_of_swapped[..., None], array, theirs[name])
    # What never collides is seen to touch where it overlaps: here in this state, there before its last physics step.
    masks, seen = theirs["obs.attention_mask"].copy(), np.asarray(ours.attention_masks)
    never = ~data.levels.levels.scene.shapes.can_touch[rows.level]
    assert np.count_nonzero(masks[:, TOUCHING] != seen[:, TOUCHING]) < 0.001 * never.sum()
    masks[:, TOUCHING] = np.where(never, seen[:, TOUCHING], masks[:, TOUCHING])
    # Sines and cosines of angles are computed by two versions of JAX.
    assert_same_observation(ours, theirs | {"obs.attention_mask": masks}, atol=1e-5)


def _bounds(name: str) -> tuple[np.ndarray, np.ndarray]:
    space = ACTION_SPACES[name]
    return np.array(space.low), np.array(space.high)


def test_states_of_a_stored_sample_are_those_of_the_package(tmp_path: Path) -> None:
    assert_same_states(STORED, answer_of(ANSWER), tmp_path / "data")


@pytest.mark.slow  # the package compiles for minutes
@pytest.mark.parametrize("sample", [("m", "8", "256"), ("l", "4", "64", "continuous")], ids=["m", "l continuous"])
def test_states_of_a_fresh_sample_are_those_of_the_package(tmp_path: Path, sample: tuple[str, ...]) -> None:
    write_sample(tmp_path / "zarr", tmp_path / "answer.npz", *sample)
    assert_same_states(tmp_path / "zarr", answer_of(tmp_path / "answer.npz"), tmp_path / "data")


def test_trajectories_become_episodes_of_one_level_each(stored: dict[str, np.ndarray], tmp_path: Path) -> None:
    out = tmp_path / "data"
    assert main(["data", "import-kinetix", str(STORED), str(out), "--shard-trajectories", "4", "--first", "1"]) == 0
    data = open_dataset(out)
    rows = data.read()
    assert [shard.rows for shard in data.shards] == [4 * 48, 48] and data.levels.names[0] == "kinetix-offline/1"
    np.testing.assert_array_equal(rows.level, np.repeat(np.arange(5), 48))
    steps = stored[f"{STATE}timestep"][1:].reshape(-1)
    np.testing.assert_array_equal(rows.step, steps)
    np.testing.assert_array_equal(rows.first, steps == 0)
    np.testing.assert_array_equal(rows.done, stored["done"][1:].reshape(-1))
    np.testing.assert_array_equal(rows.solved, rows.done & (rows.rewards == 1))
    assert rows.done.sum() == 5 and not rows.timed_out.any()
    # A level is the state that its episodes begin with, and moves from there.
    begins = np.flatnonzero(rows.first)
    position = data.levels.levels.position[rows.level]
    np.testing.assert_array_equal(rows.dynamic_obs.bodies[begins, :, :2], position[begins])
    moves = (data.levels.levels.scene.shapes.inverse_mass > 0)[rows.level]
    assert np.abs(rows.dynamic_obs.bodies[..., :2] - position)[moves].max() > 0.1
    assert not rows.dynamic_obs.touching[begins].any() and rows.dynamic_obs.touching.any()
    assert (data.env_config.reward, data.env_config.size) == ("sparse", "s")


def test_masks_of_actions_are_those_of_the_package_but_for_motors_that_obey_nothing(
    stored: dict[str, np.ndarray], tmp_path: Path
) -> None:
    """The package counts every hinge; here one whose motor is off, or runs by itself, obeys no action."""
    main(["data", "import-kinetix", str(STORED), str(tmp_path / "data")])
    ours = open_dataset(tmp_path / "data").levels.bound_heads
    theirs = stored["action_mask"][:, 0]
    assert np.all(ours <= theirs) and ours.any()
    obeys = stored[f"{STATE}joint/motor_on"][:, 0] & ~stored[f"{STATE}motor_auto"][:, 0]
    np.testing.assert_array_equal(ours[:, 4:], theirs[:, 4:])
    np.testing.assert_array_equal(ours[obeys.all(axis=1)], theirs[obeys.all(axis=1)])


def test_done_of_the_step_after_an_episode_is_understood(stored: dict[str, np.ndarray]) -> None:
    begins = stored[f"{STATE}timestep"] == 0
    after, before = choose(Changed(), 0, 6, "entity"), choose(Changed(done=begins), 0, 6, "entity")
    assert after.done_is_of_step and not before.done_is_of_step
    rows = [rows_of(Changed(), each, 0, 6) for each in (after, before)]
    differing = np.flatnonzero(rows[0].done != rows[1].done)
    assert differing.tolist() == [47]  # the last state of trajectory 0, whose end would stand in the next one
    with pytest.raises(DatasetError, match="`done` marks neither the last step of an episode nor the first one"):
        choose(Changed(done=~begins), 0, 6, "entity")


def test_an_episode_that_reaches_the_time_limit_was_not_solved(stored: dict[str, np.ndarray]) -> None:
    """Trajectory 3 is one episode: it ends with its last step, once at the limit and once before it."""
    rows = rows_of(Changed(), choose(Changed(), 0, 6, "entity"), 3, 4)
    assert not rows.done.any() and not rows.timed_out.any()
    done = stored["done"].copy()
    done[3, -1] = True
    chosen = choose(Changed(done=done), 0, 6, "entity")
    rows = rows_of(Changed(done=done), chosen, 3, 4)
    assert rows.done[-1] and rows.solved[-1] and not rows.timed_out[-1] and rows.rewards[-1] == 1
    limited = dataclasses.replace(chosen, env=Environment(dataclasses.replace(chosen.env.config, max_steps=48)))
    rows = rows_of(Changed(done=done), limited, 3, 4)
    assert rows.done[-1] and rows.timed_out[-1] and not rows.solved[-1] and rows.rewards[-1] == 0


@pytest.mark.parametrize(
    ("field", "change", "text"),
    [
        ("timestep", lambda x: x + 1, "begins at step 1 of an episode, so that its level is not known"),
        ("timestep", lambda x: np.where(x > 20, x + 3, x), "skips steps of an episode after step 20"),
        ("polygon/friction", lambda x: 0 * x - np.inf, "friction"),
    ],
)
def test_a_trajectory_that_cannot_be_read_is_left_out_and_said(
    stored: dict[str, np.ndarray], field: str, change: Callable[[np.ndarray], np.ndarray], text: str
) -> None:
    name = f"{STATE}{field}"
    array = stored[name].copy()
    array[3:4] = change(array[3:4])
    chosen = choose(Changed(**{name.replace("/", "__"): array}), 0, 6, "entity")
    assert chosen.numbers.tolist() == [0, 1, 2, 4, 5]
    [line] = chosen.left_out
    assert line.startswith("shard_00001/0: ") and text in line


def test_another_level_in_a_trajectory_is_left_out(stored: dict[str, np.ndarray]) -> None:
    gravity = stored[f"{STATE}gravity"].copy()
    gravity[0, 6:] *= 2
    chosen = choose(Changed(**{f"{STATE}gravity".replace("/", "__"): gravity}), 0, 6, "entity")
    assert chosen.left_out == ("shard_00000/0: begins another level at step 6",)


def test_numbers_that_are_no_actions_are_refused(stored: dict[str, np.ndarray]) -> None:
    actions = stored["action"].copy()
    actions[2, 7, 5] = 2
    source = Changed(action=actions)
    with pytest.raises(DatasetError, match="an action has 2 for thruster colour 1, and 0 to 1 is possible"):
        rows_of(source, choose(source, 0, 6, "entity"), 0, 6)
    with pytest.raises(DatasetError, match=r"has actions of shape \[1\]; multi-discrete and continuous ones"):
        choose(Changed(action=actions[..., :1]), 0, 6, "entity")


def test_a_chunk_that_was_not_downloaded_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(shutil.copytree(STORED, tmp_path / "zarr"))
    (folder / "shard_00001" / "0.0").unlink()
    assert main(["data", "import-kinetix", str(folder), str(tmp_path / "data")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{folder}/shard_00001 is damaged or not whole" in line and "download it again" in line
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("source", "options", "text"),
    [
        (STORED / "nowhere", [], "is no directory; give a split of Kinetix' offline data"),
        (STORED.parent, [], f"holds no zarr arrays; give {STORED}"),
        (STORED / "shard_00000", [], "holds no zarr arrays; give a split of the data"),
        (STORED, ["--first", "6"], "--first is 6, and "),
        (STORED, ["--trajectories", "0.5"], "--trajectories is 0.5; it must be 1 or more"),
        (
            STORED,
            ["--shard-trajectories", str(10**30)],
            "--shard-trajectories is 100000000000000000...000000000; give 1,000,000,000 or less",
        ),
        (STORED, ["--shard-trajectories", "0"], "--shard-trajectories is 0; it must be 1 or more"),
        (STORED, ["--observation", "sound"], "EnvConfig.observation is 'sound'; choose one of entity"),
    ],
)
def test_wrong_options_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: Path, options: list[str], text: str
) -> None:
    assert main(["data", "import-kinetix", str(source), str(tmp_path / "data"), *options]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert text in line
    assert not (tmp_path / "data").exists()


def test_another_layout_is_refused(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(STORED, tmp_path / "zarr"))
    (folder / "zarr.json").write_text("{}")
    with pytest.raises(DatasetError, match="is of zarr format 3"):
        KinetixOffline(folder)
    (folder / "zarr.json").unlink()
    array = folder / "shard_00001" / ".zarray"
    text = array.read_text()
    array.write_text(text.replace("env_state/timestep", "env_state/timestamp"))
    with pytest.raises(DatasetError, match=r"shard_00001: field 'env_state/timestep' cannot be read: Requested field"):
        KinetixOffline(folder).read(0, 6)
    array.write_text(text[:200])
    with pytest.raises(DatasetError, match=r"shard_00001/.zarray cannot be read \(.*; download it again"):
        KinetixOffline(folder)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ('{"shape": [3, 48], "shape": [3, 48]}', "an object has the key 'shape' twice"),
        (f'{{"shape": [3, {10**30}]}}', "an integer of more than 64 bits"),
        ('{"shape": [true, 48]}', r"shape is \[True, 48\], not \[trajectories, steps\]"),
        ('{"shape": [3, 48.0]}', r"shape is \[3, 48.0\], not"),
        ('{"shape": [-3, 48]}', r"shape is \[-3, 48\], not"),
        ('{"shape": [3, 0]}', r"shape is \[3, 0\], not"),
        ('{"shape": [3]}', r"shape is \[3\], not"),
        (f'{{"shape": [{2**62}, 48]}}', r"shape is \[4611686018427387904, 48\], not"),
        ("[]", "shape is None, not"),
    ],
)
def test_a_description_of_an_array_that_cannot_be_is_one_line(tmp_path: Path, content: str, text: str) -> None:
    folder = Path(shutil.copytree(STORED, tmp_path / "zarr"))
    (folder / "shard_00001" / ".zarray").write_text(content)
    with pytest.raises(DatasetError, match=rf"shard_00001/.zarray.*{text}.*; download it again$"):
        KinetixOffline(folder)


def test_a_second_import_goes_on_and_another_one_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    command = ["data", "import-kinetix", str(STORED), str(out), "--shard-trajectories", "2"]
    assert main(command) == 0
    whole = {path.name: path.read_bytes() for path in out.glob("*.parquet")}
    (out / "shard-000001.parquet").unlink()
    assert main(command) == 0
    assert whole == {path.name: path.read_bytes() for path in out.glob("*.parquet")}
    assert main([*command, "--first", "1"]) == 2
    assert "holds another data set" in capsys.readouterr().err


KILLED = """
import os, signal
from kinetix_dist.cli.main import main
from kinetix_dist.data import kinetix_import

def kill(folder, number, content, counts, write=kinetix_import.write_shard):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return write(folder, number, content, counts)

kinetix_import.write_shard = kill
main({command!r})
"""


def test_a_killed_import_is_told_and_goes_on_with_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["data", "import-kinetix", str(STORED), str(tmp_path / "data"), "--shard-trajectories", "1"]
    code = KILLED.format(command=command)
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(open_dataset(tmp_path / "data").shards) == 1
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    main(["data", "export-minari", str(tmp_path / "data"), "part-v0"])
    assert " shards that its command was to make; the same command goes on" in capsys.readouterr().err.splitlines()[0]
    assert main(command) == 0
    assert main([*command[:3], str(tmp_path / "whole"), *command[4:]]) == 0
    for file in (tmp_path / "whole").iterdir():
        assert (tmp_path / "data" / file.name).read_bytes() == file.read_bytes(), file.name


def test_walls_stand_where_those_of_other_levels_do(tmp_path: Path) -> None:
    main(["data", "import-kinetix", str(STORED), str(tmp_path / "data")])
    data = open_dataset(tmp_path / "data")
    np.testing.assert_array_equal(data.read().dynamic_obs.bodies[0, :NUM_WALLS, :2], WALL_CENTRES_M)
    assert np.abs(data.levels.levels.scene.shapes.vertices[:, :NUM_WALLS]).max() < 5.3
