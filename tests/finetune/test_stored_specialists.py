"""A directory of specialists plays each level by its own, of several seeds in turns: data, delay curves, refusals."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.data import open_dataset
from kinetix_dist.data.collect import Collection, Turn, collect
from kinetix_dist.delay.curve import contender_at, played
from kinetix_dist.delay.execution import Schedule
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.finetune.each import Plan, prepare
from kinetix_dist.finetune.specialists import SCRATCH
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.policy import PolicyConfig
from kinetix_dist.stored_specialists import are_specialists, read_results, specialists_of
from tests.finetune.small import NAMES, config_of, level_directory, write_specialists
from tests.helpers import REPOSITORY

HOP, KICK = NAMES
RATES = {(HOP, 0): 0.9, (KICK, 0): 0.7, (HOP, 3): 0.66, (KICK, 3): 0.1}
ENV = EnvConfig(size="s", max_steps=8, action_space="continuous", observation="flat")
NETWORK = PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1)
SMALL = ("--worlds", "4", "--shard-transitions", "64")


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return level_directory(tmp_path_factory.mktemp("stored") / "levels")


@pytest.fixture(scope="module")
def written(levels: Path) -> Path:
    return write_specialists(levels.parent / "experts", config_of(levels, env=ENV, policy=NETWORK), RATES)


@pytest.fixture
def experts(written: Path, tmp_path: Path) -> Path:
    """A copy, to be damaged."""
    return shutil.copytree(written, tmp_path / "experts")


def test_specialists_of_a_level_are_those_of_the_seeds_that_solve_it(written: Path, levels: Path) -> None:
    batch, names = load_level_set(str(levels), "s")
    chosen = specialists_of(written, batch, names)
    assert [[(one.level, one.seed) for one in own] for own in chosen.by_level] == [[(HOP, 0), (HOP, 3)], [(KICK, 0)]]
    assert chosen.left_out == (f"{KICK} seed 3 solves 10%, less than --min-rate 0.65",)
    everyone = specialists_of(written, batch, names, min_rate=0.0)
    assert [len(own) for own in everyone.by_level] == [2, 2] and not everyone.left_out
    # One seed alone, by its folder; levels in another order, and one of them alone.
    seed = specialists_of(written / "scratch-seed-3", *load_level_set(str(levels / f"{HOP}.json"), "s"))
    assert [[(one.level, one.seed) for one in own] for own in seed.by_level] == [[(HOP, 3)]]
    assert are_specialists(written) and are_specialists(written / "scratch-seed-0") and not are_specialists(levels)


def test_levels_of_one_stem_have_specialists_of_their_own(tmp_path: Path) -> None:
    for folder, level in (("s", HOP), ("m", KICK)):
        (tmp_path / "mine" / folder).mkdir(parents=True)
        shutil.copy(levels_root() / "s" / f"{level}.json", tmp_path / "mine" / folder / "same.json")
    config = config_of(tmp_path / "mine", env=ENV, policy=NETWORK)
    rates = {("m/same", 0): 0.7, ("s/same", 0): 0.9}
    written = write_specialists(tmp_path / "experts", config, rates)
    assert {(one["level"], one["final"]["rate"]) for one in read_results(written)} == {("m/same", 0.7), ("s/same", 0.9)}
    chosen = specialists_of(written, *load_level_set(str(tmp_path / "mine"), "s"))
    assert [[(one.level, one.rate) for one in own] for own in chosen.by_level] == [[("m/same", 0.7)], [("s/same", 0.9)]]
    prepare(config, Plan(starts=(SCRATCH,)))  # `finetune --each` takes the set


KILLED = """
import os, signal
from pathlib import Path
from kinetix_dist.finetune import results
from tests.finetune.small import write_specialists
from tests.finetune.test_stored_specialists import ENV, NETWORK, config_of

def kill(path, content, replace=results.replace_file, **options):
    if path.name == "kick.json":  # the figures, which come last
        os.kill(os.getpid(), signal.SIGKILL)
    replace(path, content, **options)

results.replace_file = kill
write_specialists(Path({out!r}), config_of(Path({levels!r}), env=ENV, policy=NETWORK), {rates!r})
"""


def test_a_specialist_whose_process_was_killed_while_it_stored_it_is_not_counted(levels: Path, tmp_path: Path) -> None:
    rates = {(HOP, 0): 0.9, (KICK, 0): 0.7}
    code = KILLED.format(out=str(tmp_path / "experts"), levels=str(levels), rates=rates)
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "experts" / "scratch-seed-0" / KICK / "manifest.json").is_file(), "its policy was stored"
    assert [one["level"] for one in read_results(tmp_path / "experts")] == [HOP]
    write_specialists(tmp_path / "experts", config_of(levels, env=ENV, policy=NETWORK), {(KICK, 0): 0.7})
    assert [one["level"] for one in read_results(tmp_path / "experts")] == [HOP, KICK]


def test_shards_are_of_one_level_and_one_specialist_in_turns(written: Path, levels: Path, tmp_path: Path) -> None:
    batch, names = load_level_set(str(levels), "s")
    chosen, env = specialists_of(written, batch, names), Environment(ENV)
    first, second = (
        Turn(player=player, version=one.trained.num_updates)
        for player, one in zip(chosen.players(env, batch)[0], chosen.by_level[0], strict=True)
    )
    other = Turn(player=chosen.players(env, batch)[1][0], version=7)
    collection = Collection(
        env=env,
        player=first.player,
        policy=chosen.description,
        levels=batch,
        level_names=names,
        level_set=str(levels),
        num_worlds=4,
        num_steps=16,
        turns=((first, second), (other,)),
    )
    collect(collection, tmp_path / "data", 4)
    data = open_dataset(tmp_path / "data")
    parts = [data.read([shard]) for shard in range(4)]
    assert [np.unique(part.level).tolist() for part in parts] == [[0], [1], [0], [1]]
    assert [np.unique(part.policy_version).tolist() for part in parts] == [[7], [7], [10], [7]]
    # Shard 2 is what the second specialist plays where it plays alone, and not what the first one does.
    for turns, same in (((second,), True), ((first,), False)):
        folder = tmp_path / f"alone-{same}"
        collect(dataclasses.replace(collection, turns=(turns, (other,))), folder, 3)
        actions = open_dataset(folder).read([2]).actions
        assert np.array_equal(actions, parts[2].actions) == same


def test_collect_takes_the_directory_and_goes_on(
    written: Path, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    command = ["collect", "--policy", str(written), "--levels", str(levels), "--out", str(out), *SMALL]
    assert main([*command, "--transitions", "65"]) == 0
    printed = capsys.readouterr().out
    assert f"left out: {KICK} seed 3 solves 10%, less than --min-rate 0.65" in printed
    assert "2 shards of 4 worlds x 16 steps" in printed  # as many of each level
    assert "2 specialists take turns at a level, and it has 1 shards: the others do not play" in printed
    first = (out / "shard-000000.parquet").read_bytes()
    assert main([*command, "--transitions", "256"]) == 0
    assert (out / "shard-000000.parquet").read_bytes() == first and len(open_dataset(out)) == 256
    policy = open_dataset(out).manifest["policy"]
    assert policy["name"] == "experts" and policy["min_rate"] == 0.65
    assert {name: [one["seed"] for one in own] for name, own in policy["specialists"].items()} == {
        HOP: [0, 3],
        KICK: [0],
    }
    assert main([*command, "--transitions", "256", "--min-rate", "0"]) == 2
    assert "holds another data set: policy.min_rate 0.0 instead of 0.65" in capsys.readouterr().err


def test_attempts_of_a_curve_are_shared_out_among_the_specialists_of_a_level(written: Path, levels: Path) -> None:
    """Of five attempts the second of two specialists has 1 and 3: what it alone makes of these."""
    batch, names = load_level_set(str(levels), "s")
    both = contender_at(written, batch, names)
    assert both.seeds == {HOP: [0, 3], KICK: [0]} and both.single is None
    alone = {seed: contender_at(written / f"scratch-seed-{seed}", batch, names, min_rate=0.0) for seed in (0, 3)}
    schedule = Schedule(delay=1, action_noise=0.3)
    by = {
        name: played(contender, "naive", batch, schedule, attempts=5, max_delay=1, seed=4)
        for name, contender in (("both", both), *alone.items())
    }
    for both_x, zero_x, three_x in zip(*map(jax.tree.leaves, (by["both"], by[0], by[3])), strict=True):
        assert both_x.shape[:2] == (2, 5)
        expected = np.array(zero_x)
        expected[0, [1, 3]] = three_x[0, [1, 3]]
        np.testing.assert_array_equal(both_x, expected)
    returns = np.asarray(by[0].episode_return)
    assert not np.array_equal(returns, by[3].episode_return)


def test_bench_delay_takes_the_directory(
    written: Path, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "delay.json"
    options = ["--delays", "0..1", "--episodes", "3", "--methods", "naive", "rtc", "--json", str(file)]
    assert main(["bench", "delay", "--policy", str(written), "--levels", str(levels), *options]) == 0
    records = json.loads(file.read_text())
    assert [(one["delay"], one["seeds"]) for one in records] == [(d, {HOP: [0, 3], KICK: [0]}) for d in (0, 1)]
    assert [level["name"] for level in records[0]["levels"]] == list(NAMES)
    assert f"left out: {KICK} seed 3 solves 10%" in capsys.readouterr().out


def _refusals(capsys: pytest.CaptureFixture[str], experts: Path, levels: Path, *options: str) -> list[str]:
    """What `collect` and `bench delay` say, a line each."""
    shared = ["--policy", str(experts), "--levels", str(levels), *options]
    commands = (["collect", *shared, "--out", str(experts.parent / "data"), *SMALL], ["bench", "delay", *shared])
    lines = []
    for command in commands:
        capsys.readouterr()
        assert main(command) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        lines.append(line)
    assert not (experts.parent / "data").exists()
    return lines


def test_what_cannot_play_is_one_line(experts: Path, levels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert all(
        f"no specialist of level '{HOP}' solves 95% of its attempts (the best 90%, seed 0)" in line
        for line in _refusals(capsys, experts, levels, "--min-rate", "0.95")
    )
    assert all(
        "--min-rate is 2; it is a solve rate" in line for line in _refusals(capsys, experts, levels, "--min-rate", "2")
    )
    others = level_directory(experts.parent / "others")
    (others / f"{KICK}.json").rename(others / "other.json")
    assert all("has no specialist of level 'other'" in line for line in _refusals(capsys, experts, others))
    (others / f"{HOP}.json").rename(others / f"{KICK}.json")
    (others / "other.json").unlink()
    assert all(f"level '{KICK}' is not the one that its" in line for line in _refusals(capsys, experts, others))


def test_damaged_specialists_are_one_line(experts: Path, levels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = next(
        path
        for path in (experts / "scratch-seed-3" / HOP / "arrays").rglob("*")
        if path.is_file() and path.stat().st_size > 1000
    )
    file.write_bytes(file.read_bytes()[:-7])
    for line in _refusals(capsys, experts, levels):
        assert f"checkpoint {experts / 'scratch-seed-3' / HOP} is damaged" in line
        assert f"remove {experts / 'scratch-seed-3' / HOP}.json, and its specialist is trained again" in line
    (experts / "scratch-seed-0" / f"{HOP}.json").write_text("{")
    assert all(f"{HOP}.json cannot be read" in line for line in _refusals(capsys, experts, levels))
    (experts / "design.json").write_text("{}")
    assert all("experts" in line for line in _refusals(capsys, experts, levels))


def test_several_starts_are_one_line(experts: Path, levels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(experts / "scratch-seed-0", experts / "policy-seed-0")
    for name in NAMES:
        file = experts / "policy-seed-0" / f"{name}.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"start": "policy"}))
    assert len(read_results(experts)) == 6
    for line in _refusals(capsys, experts, levels):
        assert f"has specialists from scratch and from policy; give {experts / 'scratch'}, or the other" in line
    batch, names = load_level_set(str(levels), "s")
    chosen = specialists_of(experts / "scratch", batch, names)
    assert [len(own) for own in chosen.by_level] == [2, 1]


def test_a_command_of_one_policy_is_told_to_name_one(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--checkpoint", str(written), "--levels", f"s/{KICK}"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith(
        f"{written} holds results of several policies (design.json); name the directory of one of them"
    )


def test_a_rate_is_of_specialists(levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = _refusals(capsys, Path("generalist"), levels, "--min-rate", "0.5")
    assert "--min-rate is of specialists" in lines[0] and "--min-rate is of specialists" in lines[1]


def test_specialists_of_one_level_and_seed_are_one_player(written: Path, levels: Path) -> None:
    batch, names = load_level_set(str(levels / f"{HOP}.json"), "s")
    one = contender_at(written / "scratch-seed-3", batch, names)
    assert one.single is not None
