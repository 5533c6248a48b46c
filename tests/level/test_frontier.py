"""Frontier sets: chosen once by a bench, drawn again from the indices that it wrote."""

from __future__ import annotations

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from bench.frontier_sets import main
from kinetix_dist.env.environment import EnvConfig
from kinetix_dist.level.frontier import read_frontier_sets, stream_levels
from kinetix_dist.level.level_data import LEVELS_VARIABLE
from kinetix_dist.level.sets import files_of_set, load_level_set
from tests.cli.test_eval_command import TINY_POLICY, save_run
from tests.helpers import REPOSITORY


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Level data with a frontier set of size s, chosen with a policy that learned nothing."""
    root = tmp_path_factory.mktemp("data")
    levels = shutil.copytree(REPOSITORY / "levels", root / "levels")
    (levels / "frontier_sets.json").unlink(missing_ok=True)
    save_run(root / "run", TINY_POLICY, EnvConfig(size="s"))
    arguments = ["--sizes", "s", "--policies", str(root / "run"), "--json", str(levels / "frontier_sets.json")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "sys.argv", ["frontier_sets", *arguments, "--num-levels", "2", "--batch", "32", "--attempts", "8"]
        )
        assert main() == 0
        assert main() == 0  # an existing entry stays
    return levels


@pytest.mark.long
def test_the_set_is_drawn_again_from_its_indices(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LEVELS_VARIABLE, str(data))
    made = read_frontier_sets(data / "frontier_sets.json")["s"]
    assert len(made.indices) == 2 and max(made.random_solved) < 0.2 * made.attempts
    levels, names = load_level_set("frontier_s")
    assert names == [f"frontier_s_{index}" for index in made.indices]
    batch = stream_levels("s", range(made.num_drawn))
    for own, drawn in zip(jax.tree.leaves(levels), jax.tree.leaves(batch)):
        # Programs that draw another number of levels may round the last bits differently.
        np.testing.assert_allclose(own, np.asarray(drawn)[list(made.indices)], rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="'frontier_s' is drawn when it is used"):
        files_of_set("frontier_s")


def test_without_the_file_there_is_no_such_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    levels = shutil.copytree(REPOSITORY / "levels", tmp_path / "levels")
    (levels / "frontier_sets.json").unlink(missing_ok=True)
    monkeypatch.setenv(LEVELS_VARIABLE, str(levels))
    with pytest.raises(ValueError, match="unknown level set 'frontier_s'"):
        load_level_set("frontier_s")
