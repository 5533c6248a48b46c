"""Export for Minari, read back by Minari itself."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.data import Dataset, DatasetError, minari_export, open_dataset
from kinetix_dist.env.environment import Environment
from kinetix_dist.installation import NOT_INSTALLED, version_of
from tests.helpers import REPOSITORY

ID = "kinetix/random-v0"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder that Minari looks in."""
    for name in ("minari", "h5py"):
        pytest.importorskip(name, reason=f"{name} is not installed (the extra minari)")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def bounds_of(data: Dataset) -> np.ndarray:
    episode = data.read().episode
    return np.append(np.flatnonzero(np.diff(episode, prepend=-1)), len(episode))


def test_minari_reads_the_episodes_of_a_data_set(
    root: Path, collected: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import minari

    monkeypatch.setattr(minari_export, "BLOCK_ROWS", 30)  # several blocks a shard
    assert main(["data", "export-minari", str(collected), ID]) == 0
    data = open_dataset(collected)
    rows, bounds = data.read(), bounds_of(data)
    number = len(bounds) - 1
    assert f"{root}/kinetix/random-v0: {number} episodes, 240 transitions" in capsys.readouterr().out
    found = minari.load_dataset(ID)
    assert (found.total_episodes, found.total_steps) == (number, 240)
    env = Environment(data.env_config)
    static = jax.tree.map(lambda x: x[rows.level], rows.static_obs)
    seen = {name: np.asarray(x) for name, x in vars(env.observation.join(static, rows.dynamic_obs)).items()}
    metadata = list(found.storage.get_episode_metadata(range(number)))
    num_cut = 0
    for episode, about, start, end in zip(found, metadata, bounds[:-1], bounds[1:], strict=True):
        here = slice(start, end)
        for name, array in seen.items():
            np.testing.assert_array_equal(episode.observations[name][:-1], array[here], err_msg=name)
            np.testing.assert_array_equal(episode.observations[name][-1], array[end - 1], err_msg=name)
        np.testing.assert_array_equal(episode.actions, rows.actions[here])
        np.testing.assert_array_equal(episode.rewards, rows.rewards[here])
        np.testing.assert_array_equal(episode.terminations, rows.done[here] & ~rows.timed_out[here])
        is_cut = not rows.done[end - 1]
        assert episode.truncations[-1] == (rows.timed_out[end - 1] or is_cut) and not episode.truncations[:-1].any()
        for name in minari_export.INFO_FIELDS:
            np.testing.assert_array_equal(episode.infos[name], getattr(rows, name)[here], err_msg=name)
        assert about["level_name"] == data.levels.names[rows.level[start]]
        assert about["first_row"] == rows.episode[start] and about["end_seen"] == (not is_cut)
        num_cut += is_cut
        first = {name: array[0] for name, array in episode.observations.items()}
        assert found.observation_space.contains(first) and found.action_space.contains(episode.actions[0])
    assert 0 < num_cut < number
    assert found.storage.metadata["kinetix_dist_dataset"] == data.manifest
    assert len(found.sample_episodes(3)) == 3


def test_a_checkout_that_is_not_installed_exports_too(
    root: Path, collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import minari

    minari_export.export_minari(open_dataset(collected), "installed-v0")
    monkeypatch.setattr(minari_export, "version_of", lambda: NOT_INSTALLED)
    minari_export.export_minari(open_dataset(collected), "checkout-v0")
    installed, checkout = (minari.load_dataset(f"{name}-v0").storage.metadata for name in ("installed", "checkout"))
    assert list(installed["requirements"]) == [f"kinetix-dist=={version_of()}"]
    assert list(checkout["requirements"]) == ["kinetix-dist"]


def test_an_id_that_is_taken_or_none_is_one_line(
    root: Path, collected: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["data", "export-minari", str(collected), ID]) == 0
    capsys.readouterr()
    for name, text in (
        (ID, "kinetix/random-v0 is there already; give another version, such as kinetix/random-v1"),
        ("kinetix", "'kinetix' is no id of a Minari data set; give one such as kinetix/generalist-v0"),
        ("kinetix/random", "'kinetix/random' is no id of a Minari data set"),
        ("../a-v0", "'../a-v0' is no id of a Minari data set"),
    ):
        assert main(["data", "export-minari", str(collected), name]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert text in line


def test_nothing_is_left_of_an_export_that_failed(root: Path, data: Path) -> None:
    path = data / "shard-000002.parquet"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DatasetError, match=r"shard-000002.parquet is damaged"):
        minari_export.export_minari(open_dataset(data), ID)
    assert not list(root.glob("**/*.hdf5")) and not (root / ID).exists()


def test_without_minari_the_command_says_what_to_install(collected: Path) -> None:
    """In a process of its own, which finds no minari."""
    program = (
        "import importlib.util, sys; found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *rest: None if name == 'minari' else found(name, *rest)\n"
        "from kinetix_dist.cli.main import main\n"
        f"sys.exit(main(['data', 'export-minari', {str(collected)!r}, {ID!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(
        "minari is not installed, which Minari data sets need: pip install 'kinetix-dist[minari]'"
    )


KILLED = """
import os, signal
from pathlib import Path
from kinetix_dist.data import open_dataset
from kinetix_dist.data.minari_export import export_minari

export_minari(open_dataset({data!r}), {name!r}, lambda done, number: os.kill(os.getpid(), signal.{signal}))
"""


@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM"])
def test_a_killed_export_leaves_no_data_set_and_the_same_command_succeeds(
    root: Path, collected: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    import minari

    code = KILLED.format(data=str(collected), name=ID, signal=name)
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.Signals[name]
    assert list(root.glob("**/*.hdf5")), "the process was killed after a shard of the data set was on the disk"
    with pytest.raises(FileNotFoundError):
        minari.load_dataset(ID)
    assert not minari.list_local_datasets()
    assert main(["data", "export-minari", str(collected), ID]) == 0
    assert "240 transitions" in capsys.readouterr().out
    assert minari.load_dataset(ID).total_steps == 240 and list(minari.list_local_datasets()) == [ID]
    assert len(list(root.glob("**/*.hdf5"))) == 1, "what the killed process left is removed"
