"""`bench delay` and `clone-flow` on a small data set: records, table, picture, and one line for what cannot be."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from kinetix_dist import prng
from kinetix_dist.benchmarks.delay_curve import delays_of
from kinetix_dist.checkpoint import flatten_arrays, save_alone
from kinetix_dist.cli.main import main
from kinetix_dist.config import to_dict
from kinetix_dist.data.collect import Collection, collect
from kinetix_dist.delay.chunk_policy import FlowConfig, init_params, make_chunk_policy, save_chunk_policy
from kinetix_dist.delay.curve import with_differences
from kinetix_dist.delay.demonstrations import open_demonstrations, samples_of
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.intervals import interval_of_mean, wilson_interval
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.level.sets import files_of_set, load_level_set
from kinetix_dist.models.policy import PolicyConfig, make_policy
from kinetix_dist.models.policy import init_params as init_single
from kinetix_dist.recipes import recipe

FLOW = FlowConfig(
    horizon=4,
    integration_steps=2,
    max_delay=1,
    width=8,
    token_width=4,
    num_layers=1,
    encoder=PolicyConfig(network="flat", flat_size=8),
)
SMALL = {
    "horizon": 4,
    "integration-steps": 2,
    "max-delay": 1,
    "width": 8,
    "token-width": 4,
    "num-layers": 1,
    "batch": 8,
}
OPTIONS = [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=8, action_space="continuous", observation="flat"))


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("levels")
    for name in ("s/hop_home", "s/kick"):
        [file] = files_of_set(name)
        (folder / file.name).write_text(file.read_text())
    return folder


@pytest.fixture(scope="module")
def data(env: Environment, levels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    batch, names = load_level_set(str(levels), "s")
    folder = tmp_path_factory.mktemp("collected") / "data"
    collection = Collection(
        env=env,
        player=Player(RandomPolicy(env.action_space)),
        policy={"name": "random", "version": -1, "sha256": "", "greedy": False},
        levels=batch,
        level_names=names,
        level_set=str(levels),
        num_worlds=4,
        num_steps=16,
    )
    collect(collection, folder, 2)
    return folder


@pytest.fixture(scope="module")
def flow(env: Environment, levels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose policy has learned nothing."""
    batch, _ = load_level_set(str(levels), "s")
    prepared = env.prepare(batch)
    params = init_params(make_chunk_policy(FLOW, env), env.observe(prepared, prepared.initial_obs), prng.key(0))
    run = tmp_path_factory.mktemp("flow")
    save_chunk_policy(run / "checkpoints", 1, params, FLOW, env.config, notes={})
    return run


@pytest.fixture(scope="module")
def single(env: Environment, levels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a policy of single actions that has learned nothing."""
    base = recipe("tiny")
    network = dataclasses.replace(base.policy, network="flat", flat_size=8)
    config = dataclasses.replace(base, env=env.config, policy=network)
    prepared = env.prepare(load_level_set(str(levels), "s")[0])
    policy = make_policy(network, env.action_distribution.head_sizes)
    params = init_single(policy, env.observe(prepared, prepared.initial_obs), prng.key(0))
    arrays = {f"{PARAMS_PREFIX}/{name}": array for name, array in flatten_arrays(params).items()}
    path = tmp_path_factory.mktemp("single") / "policy"
    save_alone(path, 1, arrays, {"config": to_dict(config)})
    return path


def bench(flow: Path, levels: Path, *options: str) -> int:
    return main(["bench", "delay", "--policy", str(flow), "--levels", str(levels), "--episodes", "3", *options])


def test_a_curve_has_records_a_table_and_a_picture(
    flow: Path, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, picture = tmp_path / "delay.json", tmp_path / "delay.png"
    methods = ("synchronous", "naive", "rtc", "training_time_rtc")
    options = ("--delays", "0..2", "--json", str(file), "--picture", str(picture), "--methods", *methods)
    assert bench(flow, levels, *options) == 0
    printed = capsys.readouterr().out
    records = json.loads(file.read_text())
    points = {(record["method"], record["delay"]): record for record in records}
    assert set(points) == {(method, delay) for method in methods for delay in range(3)} - {("training_time_rtc", 2)}
    assert "training_time_rtc at delay 2 takes a policy of `clone-flow --max-delay 2` or more" in printed
    for (method, delay), record in points.items():
        assert record["execute"] == max(delay, 1) and record["horizon"] == 4
        assert [level["name"] for level in record["levels"]] == ["hop_home", "kick"]
        assert record["attempts_per_level"] == 3
        assert record["rate"] == pytest.approx(np.mean([level["rate"] for level in record["levels"]]))
        assert record["low"] <= record["rate"] <= record["high"] and record["over_levels"]["base_levels"] == 2
        assert (record["above_naive"] is None) == (method == "naive")
        waits = method == "synchronous" and delay > 0
        assert (record["mean_waiting"] > 0) == waits
    # Without delay, what waits and what does not are the same, bit for bit.
    for name in ("rate", "mean_length", "levels"):
        assert points["synchronous", 0][name] == points["naive", 0][name]
        assert points["synchronous", 1][name] == points["synchronous", 0][name]  # a delay costs it time alone
    assert "solved, % (interval on these levels)" in printed and "less naive, points" in printed
    with Image.open(picture) as image:
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 20


def test_a_policy_of_single_actions_is_played_by_what_it_can(
    single: Path, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "delay.json"
    options = ["--levels", str(levels / "kick.json"), "--delays", "0", "3", "--episodes", "2", "--json", str(file)]
    assert main(["bench", "delay", "--policy", str(single), "--methods", "naive", "rtc", *options]) == 0
    records = json.loads(file.read_text())
    assert [(record["method"], record["delay"]) for record in records] == [("naive", 0), ("naive", 3)]
    assert records[0]["over_levels"] is None  # one level says nothing of others
    assert "policy gives single actions; rtc is of chunk policies" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--delays", "0..3"],
            "a delay of 3 steps is beyond the horizon: chunks of 4 actions, of which 3 are executed",
        ),
        (["--delays", "2", "--execute", "1"], "execute 2 or more"),
        (["--delays", "8..0"], "--delays has '8..0'"),
        (["--delays", "-1"], "--delays"),
        (["--delays", "two"], "--delays has 'two'"),
        (["--delays"], "--delays is empty"),
        (["--methods", "rct"], "did you mean 'rtc'?"),
        (["--methods", "training_time_rtc", "--delays", "2"], "plays by none of --methods"),
        (["--horizon", "5", "--delays", "0"], "gives chunks of 4 actions"),
        (["--episodes", "0"], "--episodes is 0"),
        (["--picture", "delay.txt"], "ends in none of .png"),
        (["--weak-policy", "generalist", "--delays", "0"], "is no policy of action chunks"),
        (["--size", "m", "--delays", "0"], "encoder"),
        (["--action-noise", "-1", "--delays", "0"], "not possible"),
    ],
)
def test_what_cannot_be_measured_is_one_line(
    flow: Path, levels: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench(flow, levels, *options) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_noise_on_whole_numbers_is_one_line(levels: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "delay", "--levels", str(levels), "--action-noise", "0.1"]) == 2
    assert "actions are 'multi_discrete'; leave the noise out" in capsys.readouterr().err


def test_delays_in_words() -> None:
    assert delays_of(["0..3"]) == [0, 1, 2, 3]
    assert delays_of(["4", "0", "2..3"]) == [0, 2, 3, 4]
    with pytest.raises(ValueError, match="3 twice"):
        delays_of(["2..3", "3"])


def test_cloning_writes_checkpoints_that_play(
    data: Path, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = [*OPTIONS, "--encoder.flat-size", "8", "--steps", "8", "--report-every", "2", "--held-out", "0.2"]
    assert main(["clone-flow", "--data", str(data), "--run", str(run), *options]) == 0
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == [f"0000000{i}" for i in (2, 4, 6, 8)]
    losses = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["step"] for row in losses] == [2, 4, 6, 8] and all(np.isfinite(row["loss"]) for row in losses)
    assert "128 transitions of 2 levels, chunks of 4 actions" in capsys.readouterr().out
    weak = run / "checkpoints" / "00000002"
    assert bench(run, levels, "--delays", "1", "--methods", "bidirectional", "--weak-policy", str(weak)) == 0
    assert "bidirectional" in capsys.readouterr().out
    assert main(["clone-flow", "--data", str(data), "--run", str(run), *options]) == 0
    assert "goes on after step 8 of 8" in capsys.readouterr().out
    assert main(["eval", "--checkpoint", str(weak), "--levels", str(levels)]) == 2
    assert "is a policy of action chunks; `kinetix-dist bench delay --policy` plays it" in capsys.readouterr().err


def test_samples_of_several_data_sets(data: Path, env: Environment) -> None:
    policy = make_chunk_policy(FLOW, env)
    one, two = (samples_of(open_demonstrations(folders), policy) for folders in ([data], [data, data]))
    num_rows, num_levels = len(one.level), len(one.bound)
    np.testing.assert_array_equal(two.level, np.concatenate([one.level, one.level + num_levels]))
    np.testing.assert_array_equal(two.left, np.concatenate([one.left, one.left]))
    np.testing.assert_array_equal(two.bound[num_levels:], one.bound)
    joined = jax.tree.map(lambda x: np.asarray(x)[num_rows:], (two.dynamic_obs, two.actions))
    jax.tree.map(np.testing.assert_array_equal, joined, (one.dynamic_obs, one.actions))
    assert one.counts.all() and (np.abs(one.actions) <= 1).all()
    with pytest.raises(ValueError, match="no episode of the data set ended solved"):
        samples_of(open_demonstrations([data]), policy, solved_only=True)


def test_a_data_set_of_whole_numbers_is_one_line(
    levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    options = ["--transitions", "512", "--worlds", "2", "--shard-transitions", "512"]
    assert main(["collect", "--policy", "random", "--levels", str(levels), "--out", str(data), *options]) == 0
    capsys.readouterr()
    assert main(["clone-flow", "--data", str(data), "--run", str(tmp_path / "run")]) == 2
    assert "actions are 'multi_discrete'" in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert main(["clone-flow", "--data", str(tmp_path / "none"), "--run", str(tmp_path / "run")]) == 2
    assert "none" in (error := capsys.readouterr().err) and error.count("\n") == 1


def test_the_interval_of_a_mean_against_one_of_all_attempts() -> None:
    """Of one level it is Wilson's; two levels that are alike are as twice the attempts, nearly; and of levels that are
    always and never solved little is left."""
    one = (0.4, *wilson_interval(40, 100))
    assert interval_of_mean([one]) == pytest.approx(one)
    mean, low, high = interval_of_mean([one, one])
    assert mean == 0.4 and (low, high) == pytest.approx(wilson_interval(80, 200), abs=0.005)
    extremes = [(0.0, *wilson_interval(0, 1000)), (1.0, *wilson_interval(1000, 1000))]
    mean, low, high = interval_of_mean(extremes)
    assert mean == 0.5 and high - low < 0.005 < np.diff(wilson_interval(1000, 2000))[0]


def test_differences_are_level_by_level() -> None:
    def record(method: str, *rates: float) -> dict[str, Any]:
        where = {"policy": "p", "delay": 1, "execute": 1, "horizon": 8}
        return where | {"method": method, "levels": [{"rate": rate} for rate in rates]}

    found = with_differences([record("rtc", 0.9, 0.5, 0.2), record("naive", 0.8, 0.4, 0.1)], ["a", "b", "c"])
    assert found[0]["above_naive"] == {"difference": pytest.approx(0.1), "low": None, "high": None}
    found = with_differences([record("rtc", 0.9, 0.5, 0.3), record("naive", 0.8, 0.4, 0.1)], ["a", "b", "c"])
    assert found[0]["above_naive"]["low"] < found[0]["above_naive"]["difference"] < found[0]["above_naive"]["high"]
    assert found[1]["above_naive"] is None
    [alone] = with_differences([record("rtc", 0.9, 0.5)], ["a", "b"])
    assert alone["above_naive"] is None
