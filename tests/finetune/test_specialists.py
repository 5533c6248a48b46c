"""Specialists: one compilation for all levels, each as a run of its own would be; the command goes on where it was."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.config import TrainConfig
from kinetix_dist.finetune import each
from kinetix_dist.finetune.results import ResultsDirectory
from kinetix_dist.finetune.specialists import Specialist
from kinetix_dist.learner.sharding import data_mesh, local_values
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.runtime import starting_point
from kinetix_dist.runtime.cores.worker import Worker
from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED
from tests.finetune.small import (
    NAMES,
    NUM_UPDATES,
    OPTIONS,
    config_of,
    level_directory,
    shared_specialists,
    write_policy,
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return level_directory(tmp_path_factory.mktemp("specialists") / "levels")


@pytest.fixture(scope="module")
def specialists(directory: Path) -> dict[str, Specialist]:
    """Specialists by level, and "again": the first level after the others."""
    trainer = shared_specialists(config_of(directory))
    levels = {name: load_level_set(str(directory / f"{name}.json"), "s")[0] for name in NAMES}
    trainer.compile(levels[NAMES[0]], [None])
    order = {**{name: name for name in NAMES}, "again": NAMES[0]}
    return {label: trainer.train(levels[name], [None])[0] for label, name in order.items()}


def _params(specialist: Specialist) -> list[np.ndarray]:
    return jax.tree.leaves(specialist.params)


def assert_same_bits(ours: list[np.ndarray], theirs: list[np.ndarray]) -> None:
    """As users run XLA; as tests compile it (conftest.py), it rounds sums of a program of another size otherwise."""
    tolerance = 2e-6 if "fusion_emitters=false" in os.environ.get("XLA_FLAGS", "") else 0.0
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * 1e-3)


@pytest.mark.long
def test_nothing_is_compiled_for_another_level(specialists: dict[str, Specialist]) -> None:
    assert [specialist.compile_seconds for specialist in specialists.values()] == [0.0] * len(specialists)


@pytest.mark.long
def test_specialists_differ_by_their_level_and_by_nothing_before_them(specialists: dict[str, Specialist]) -> None:
    first, second = (specialists[name] for name in NAMES)
    again = specialists["again"]
    assert all(np.array_equal(a, b) for a, b in zip(_params(first), _params(again)))
    assert first.points == again.points
    assert any(not np.array_equal(a, b) for a, b in zip(_params(first), _params(second)))


def test_a_specialist_is_what_a_run_on_its_level_gives(specialists: dict[str, Specialist], directory: Path) -> None:
    worker = Worker(config_of(directory / f"{NAMES[1]}.json"), data_mesh(jax.local_devices()[:1]))
    worker.start(None)
    for update in range(NUM_UPDATES):
        worker.run_update(update)
    expected = jax.tree.leaves(local_values(worker.released()))
    assert_same_bits(_params(specialists[NAMES[1]]), expected)


SOLVED = ("random_s_86", "random_s_130", "random_s_17")  # sometimes, seldom and always, by random actions


@pytest.fixture(scope="module")
def solved_levels() -> Level:
    levels, names = load_level_set("random_s", "s")
    return jax.tree.map(lambda x: np.asarray(x)[[names.index(name) for name in SOLVED]], levels)


@pytest.fixture(scope="module")
def together(directory: Path, solved_levels: Level) -> list[Specialist]:
    """Specialists that were trained in one program."""
    return shared_specialists(config_of(directory), together=3).train(solved_levels, [None, None, None])


def test_specialists_are_the_same_alone_and_together(
    directory: Path, together: list[Specialist], solved_levels: Level
) -> None:
    trainer = shared_specialists(config_of(directory))
    assert len({own.points for own in together}) == 3
    for i, ours in enumerate(together):
        (alone,) = trainer.train(jax.tree.map(lambda x, i=i: x[i : i + 1], solved_levels), [None])
        assert ours.points == alone.points
        assert_same_bits(_params(ours), _params(alone))


def _seeded(directory: Path, seed: int) -> TrainConfig:
    config = config_of(directory)
    return dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))


@pytest.mark.long
def test_seeds_share_a_program_and_each_is_what_its_run_gives(
    directory: Path, together: list[Specialist], solved_levels: Level
) -> None:
    """Two seeds of one level and one of another, in the program that is compiled for three levels."""
    levels = jax.tree.map(lambda x: x[[0, 0, 1]], solved_levels)
    trainer = shared_specialists(config_of(directory), together=3)
    trained = trainer.train(levels, [None, None, None], seeds=[0, 7, 7])
    assert [specialist.compile_seconds for specialist in trained] == [0.0, 0.0, 0.0]
    assert_same_bits(_params(trained[0]), _params(together[0]))
    assert any(not np.array_equal(a, b) for a, b in zip(_params(trained[0]), _params(trained[1])))
    for i in (1, 2):
        alone = shared_specialists(_seeded(directory, 7))
        (expected,) = alone.train(jax.tree.map(lambda x, i=i: x[i : i + 1], levels), [None])
        assert trained[i].points == expected.points
        assert_same_bits(_params(trained[i]), _params(expected))


@pytest.mark.long
def test_those_together_have_each_their_own_start(
    directory: Path, together: list[Specialist], solved_levels: Level, tmp_path: Path
) -> None:
    config = config_of(directory)
    policy = write_policy(tmp_path / "other", config)
    start = starting_point(dataclasses.replace(config, run=dataclasses.replace(config.run, start_from=str(policy))))
    twice = jax.tree.map(lambda x: x[[0, 0, 1]], solved_levels)
    first, other, third = shared_specialists(config, together=3).train(twice, [None, start.arrays, None])
    for ours, theirs in ((first, together[0]), (third, together[1])):
        assert all(np.array_equal(a, b) for a, b in zip(_params(ours), _params(theirs), strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(_params(first), _params(other)) if a.ndim > 1)


@pytest.mark.long
def test_one_that_is_good_enough_learns_no_more_and_the_others_go_on(
    directory: Path, together: list[Specialist], solved_levels: Level
) -> None:
    assert together[2].points[0].rate == 1.0 and max(point.rate for point in together[1].points) < 1.0
    trainer = shared_specialists(config_of(directory), stop_at=1.0, together=3)
    ends: list[int] = []
    _, second, third = trainer.train(solved_levels, [None, None, None], on_end=lambda number, _: ends.append(number))
    assert ends[0] == 2 and sorted(ends) == [0, 1, 2]
    assert third.points == together[2].points[:1] and second.points == together[1].points
    assert all(np.array_equal(a, b) for a, b in zip(_params(second), _params(together[1]), strict=True))
    assert any(not np.array_equal(a, b) for a, b in zip(_params(third), _params(together[2]), strict=True))


def test_evaluations_come_before_training_every_second_update_and_at_the_end(
    specialists: dict[str, Specialist],
) -> None:
    points = specialists[NAMES[0]].points
    assert [(point.updates, point.env_steps) for point in points] == [(0, 0), (2, 256), (3, 384)]
    assert all(point.attempts == 8 and 0 <= point.solved <= 8 for point in points)


def _records(out: Path) -> dict[str, dict]:
    return {f"{file.parent.name}/{file.stem}": json.loads(file.read_text()) for file in out.glob("*/*.json")}


def test_an_interrupted_command_goes_on_and_a_second_start_gives_one_picture(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(each, "Specialists", shared_specialists)  # those that are compiled already
    policy = write_policy(tmp_path / "policy", config_of(directory))
    out = tmp_path / "out"
    command = ["finetune", "--levels", str(directory), "--each", *OPTIONS, "--run", str(out)]
    added = []

    def add_one(self, start, level, *rest):
        if added:
            os.kill(os.getpid(), signal.SIGTERM)
        added.append(level)
        return original(self, start, level, *rest)

    original = ResultsDirectory.add
    with monkeypatch.context() as patch:
        patch.setattr(ResultsDirectory, "add", add_one)
        assert main(command) == EXIT_STOPPED
    assert capsys.readouterr().err.endswith("kinetix-dist: stopped by SIGTERM; the same command goes on\n")
    before = _records(out)
    assert list(before) == [f"scratch/{NAMES[0]}"] and not (out / "samples.png").exists()

    capsys.readouterr()
    assert main(command) == 0
    assert "1 of 2 specialists are there already" in capsys.readouterr().out
    after = _records(out)
    assert set(after) == {f"scratch/{name}" for name in NAMES} and after.items() >= before.items()

    assert main([*command, "--from", str(policy)]) == 0
    assert (out / "samples.png").stat().st_size > 10_000
    records = _records(out)
    assert set(records) == {f"{start}/{name}" for start in ("scratch", "policy") for name in NAMES}
    assert all(record["seconds"]["compile"] == 0.0 for record in records.values())
    assert records[f"policy/{NAMES[0]}"]["from"]["policy_updates"] == 7

    # The policy of a specialist is a checkpoint: one that starts from it begins where it ended.
    capsys.readouterr()
    specialist = out / "policy" / NAMES[1]
    assert main([*command, "--from", str(specialist), "--run", str(tmp_path / "further")]) == 0
    (ended, began) = records[f"policy/{NAMES[1]}"], _records(tmp_path / "further")[f"{NAMES[1]}/{NAMES[1]}"]
    assert began["curve"][0]["solved"] == ended["curve"][-1]["solved"]
    assert began["from"]["start_from"] == str(policy)

    assert main(["finetune", "--draw", str(out)]) == 0
    assert "from policy" in capsys.readouterr().out


@pytest.mark.long
def test_a_command_trains_what_is_left_together(
    specialists: dict[str, Specialist], directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of three specialists one is there already; the two of a policy and one from scratch share a program."""
    policy = write_policy(tmp_path / "policy", config_of(directory))
    out = tmp_path / "out"
    command = ["finetune", "--levels", str(directory), "--each", *OPTIONS, "--run", str(out)]
    assert main([*command, "--part", "0/2"]) == 0
    before = _records(out)
    assert main([*command, "--from", str(policy), "--compare", "--together", "8"]) == 0
    assert "1 of 4 specialists are there already" in capsys.readouterr().out
    records = _records(out)
    assert set(records) == {f"{start}/{name}" for start in ("scratch", "policy") for name in NAMES}
    assert records.items() >= before.items()
    for name in NAMES:
        curve = [point["solved"] for point in records[f"scratch/{name}"]["curve"]]
        assert curve == [point.solved for point in specialists[name].points]
    assert records[f"policy/{NAMES[1]}"]["from"]["policy_updates"] == 7
