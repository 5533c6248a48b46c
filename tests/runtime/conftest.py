"""One finished run that several tests copy and damage."""

from __future__ import annotations

from pathlib import Path

import pytest

from kinetix_dist.cli.main import main

NUM_UPDATES, STEPS = 4, 128  # of the recipe `tiny`: a checkpoint every 2 updates


def tiny_options(num_updates: int) -> list[str]:
    """Options of `kinetix-dist train`."""
    return ["--recipe", "tiny", "--evaluation.sets", "s/kick", "--run.total_env_steps", str(num_updates * STEPS)]


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real run of NUM_UPDATES updates. Do not write into it: copy it."""
    path = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", "--run", str(path), *tiny_options(NUM_UPDATES)]) == 0
    return path
