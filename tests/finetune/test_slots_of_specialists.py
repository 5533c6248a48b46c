"""Specialists of several seeds over worker slots: parts, one directory, cards, and one line for what cannot be."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from kinetix_dist.child_python import command_of
from kinetix_dist.cli.main import main
from kinetix_dist.cli.specialist_slots import parts_of
from kinetix_dist.finetune.each import Plan
from kinetix_dist.finetune.specialists import SCRATCH
from kinetix_dist.stored_specialists import read_results
from kinetix_dist.trained_policy import checkpoint_at
from tests.finetune.small import NAMES, OPTIONS, level_directory
from tests.helpers import REPOSITORY

DEADLINE_S = 300.0


def test_parts_of_slots_are_all_of_it_once() -> None:
    plan = Plan(starts=(SCRATCH,), seeds=(0, 3, 5))
    names = ["a", "b", "c", "d"]
    parts = parts_of(plan, names, ["--each"], 5)
    keys = [key for part in parts for key in part.keys]
    assert sorted((key.level, key.seed) for key in keys) == [(name, seed) for name in names for seed in (0, 3, 5)]
    assert max(len(part.keys) for part in parts) - min(len(part.keys) for part in parts) <= 1
    assert parts[1].words == ("finetune", "--each", "--part", "1/5")
    # Of a part, as on the second of two machines, no key is of the first.
    second = parts_of(Plan(starts=(SCRATCH,), seeds=(0, 3, 5), part=(1, 2)), names, [], 2)
    assert [part.words[-1] for part in second] == ["1/4", "3/4"]
    assert {key for part in second for key in part.keys} == set(plan.keys(names)[1::2])
    assert len(parts_of(Plan(starts=(SCRATCH,)), ["a"], [], 3)) == 1  # no slot without work


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--seeds", "two"), "--seeds has 'two'; give numbers such as 0..8 or 0 3 5"),
        (("--seeds", "5..2"), "--seeds has '5..2'"),
        (("--seeds", "-1"), "--seeds"),
        (("--seeds", "0..99999999"), "--seeds has '0..99999999'"),
        (("--seeds", "0..3", "2"), "--seeds has 2 twice; give each number once"),
        (("--seeds", "7", "7"), "--seeds has 7 twice; give each number once"),
        (("--seeds", "0..9999", "10000..12000"), "--seeds has more than 10,000 numbers; give fewer"),
        (("--seeds", "0..3", "--run.seed", "1"), "--seeds and --run.seed are both given"),
        (("--slots", "-1"), "--slots is -1; give a number of 1 or more, or 0 for all free GPUs"),
        (("--slots", "many"), "--slots: invalid int value: 'many'"),
        (("--slots", "4096", "--run.device", "cpu"), "4096 slots are requested, but this process may use"),
    ],
)
def test_what_cannot_be_is_one_line(
    options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    levels = level_directory(tmp_path / "levels")
    assert (
        main(["finetune", "--levels", str(levels), "--each", *OPTIONS, "--run", str(tmp_path / "out"), *options]) == 2
    )
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--seeds", "--slots"])
def test_seeds_and_slots_are_of_specialists(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["finetune", "--levels", "designed_s", option, "1"]) == 2
    assert "give --each too" in capsys.readouterr().err


def _command(levels: Path, out: Path, *options: str) -> list[str]:
    words = ["finetune", "--levels", str(levels), "--each", *OPTIONS, "--run", str(out), "--together", "2"]
    return [*words, "--run.device", "cpu", *options]


@pytest.mark.long
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="two slots take two cores")
def test_two_slots_train_two_seeds_are_killed_and_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    levels, out = level_directory(tmp_path / "levels"), tmp_path / "out"
    command = _command(levels, out, "--seeds", "0", "7", "--slots", "2")
    process = subprocess.Popen(
        command_of("kinetix_dist.cli.main", *command),
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    deadline = time.monotonic() + DEADLINE_S
    while not list(out.glob("scratch-seed-*/*.json")):  # the first is there, the others are not all
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(timeout=60)
    before = {file: file.read_bytes() for file in out.glob("*/*.json")}
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "on cpu " in printed and "4/4  " in printed
    records = read_results(out)
    assert {(one["level"], one["seed"]) for one in records} == {(name, seed) for name in NAMES for seed in (0, 7)}
    assert all(file.read_bytes() == content for file, content in before.items())

    # Each has its policy and its card, and the directory has one of all.
    for record in records:
        stem = out / record["folder"] / record["level"]
        assert checkpoint_at(stem).checkpoint.description["config"]["run"]["seed"] == record["seed"]
        card = stem.with_suffix(".md").read_text()
        assert card.startswith(f"# {record['level']}, from scratch, seed {record['seed']}\n")
        assert f"of {record['final']['attempts']} first episodes at the end" in card and "virtual" not in card
    assert "| level | `scratch-seed-0` | `scratch-seed-7` |" in (out / "README.md").read_text()

    # The same again in one process, one at a time: the same curves.
    alone = tmp_path / "alone"
    assert main([*_command(levels, alone, "--seeds", "7"), "--together", "1"]) == 0
    curves = {(one["level"], one["seed"]): one["curve"] for one in records}
    for one in read_results(alone):
        assert one["curve"] == curves[one["level"], 7]

    # More seeds join; another design does not, and is one line.
    capsys.readouterr()
    assert main([*command, "--ppo.epochs", "3"]) == 2
    assert "holds results of another design: ppo.epochs 3 instead of 2" in capsys.readouterr().err
    assert main(command) == 0
    assert "4 of 4 specialists are there already" in capsys.readouterr().out
