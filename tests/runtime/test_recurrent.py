"""Runs of a policy that remembers and reads by colour: they train, resume bit for bit, are evaluated; on Ray too."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinetix_dist.checkpoint import load_checkpoint
from kinetix_dist.cli.main import main
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config

pytestmark = pytest.mark.long

KICK = "s/kick"
KERNEL = "learner/params/params/gru/memory_kernel"


def config_of(num_updates: int, curriculum: str = "fixed", **run: Any) -> TrainConfig:
    config = tiny_config(num_updates=num_updates, **{"checkpoint_every": 1, **run})
    return dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, max_steps=5),  # rollouts are 8 steps: episodes end within them
        policy=dataclasses.replace(config.policy, recurrent="gru", memory_size=8, read_out="colour"),
        curriculum=CurriculumConfig(name=curriculum, levels=KICK if curriculum == "fixed" else ""),
    )


def _run(config: TrainConfig, path: Path, backend: Any = None, *, resume: bool = False) -> list[dict[str, float]]:
    """Metrics of its updates."""
    reporter, placement = QuietReporter(), plan_placement(config, num_gpus=0)
    backend = backend or LocalBackend()
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, placement)
    else:
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    try:
        run_updates(config, path, trainer, None, reporter=reporter, resume=resume)
    finally:
        trainer.stop()
    return reporter.rows


@pytest.fixture(scope="module")
def three_updates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recurrent") / "run"
    rows = _run(config_of(3), path)
    assert len(rows) == 3
    assert_learned(rows)
    return path


def assert_learned(rows: list[dict[str, float]]) -> None:
    for row in rows:
        assert np.isfinite(row["learner/policy_loss"]) and row["learner/skipped_steps"] == 0
        assert row["learner/grad_norm"] > 0


def test_updates_train_the_memory(three_updates: Path) -> None:
    first = load_checkpoint(three_updates / "checkpoints" / "00000001").arrays[KERNEL]
    assert first.shape == (8, 24)
    assert (np.abs(final_arrays(three_updates)[KERNEL] - first) > 1e-5).mean() > 0.9


def test_a_run_that_is_resumed_has_the_bits_of_one_that_was_not(three_updates: Path, tmp_path: Path) -> None:
    _run(config_of(2), tmp_path / "run")
    _run(config_of(3), tmp_path / "run", resume=True)
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(three_updates))


def test_eval_plays_and_records_it(three_updates: Path, tmp_path: Path) -> None:
    rates, recording = tmp_path / "rates.json", tmp_path / "kick.mcap"
    options = ["--attempts", "2", "--no-baselines", "--json", str(rates), "--record", str(recording)]
    assert main(["eval", "--run", str(three_updates), "--levels", KICK, *options]) == 0
    assert json.loads(rates.read_text())["solve_rate"]["trained"]["attempts"] == 2
    assert recording.stat().st_size > 0


@pytest.mark.slow  # another curriculum: two students and a teacher without memory
def test_students_of_paired_remember(tmp_path: Path) -> None:
    rows = _run(config_of(2, "paired"), tmp_path / "run")
    assert len(rows) == 2
    assert_learned(rows)


@pytest.fixture(scope="module")
def ray_backend() -> Iterator[Any]:
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    backend = RayBackend(heartbeat_seconds=120.0)
    yield backend
    backend.stop()


@pytest.mark.slow  # placements give the same bits whatever the policy: tests/runtime/test_ray_run.py
def test_ray_colocated_gives_the_bits_of_local_mode(three_updates: Path, ray_backend: Any, tmp_path: Path) -> None:
    _run(config_of(3, placement="colocated"), tmp_path / "ray", ray_backend)
    assert_same_bits(final_arrays(tmp_path / "ray"), final_arrays(three_updates))


@pytest.mark.slow
def test_the_split_placement_trains_it(ray_backend: Any, tmp_path: Path) -> None:
    rows = _run(config_of(3, placement="split"), tmp_path / "split", ray_backend)
    assert len(rows) == 3
    assert_learned(rows)
