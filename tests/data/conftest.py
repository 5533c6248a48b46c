"""A small data set that the tests of this folder share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from kinetix_dist.data.collect import Collection, collect
from tests.data.small_collection import NUM_SHARDS, make_collection


@pytest.fixture(scope="module")  # not of the session: programs are compiled as those of the file are
def collection() -> Collection:
    return make_collection()


@pytest.fixture(scope="module")  # not of the session: programs are compiled as those of the file are
def collected(collection: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set; tests that change it take `data`."""
    folder = tmp_path_factory.mktemp("collected") / "data"
    collect(collection, folder, NUM_SHARDS)
    return folder


@pytest.fixture
def data(collected: Path, tmp_path: Path) -> Path:
    """A copy of the data set."""
    return Path(shutil.copytree(collected, tmp_path / "data"))
