"""`kinetix-dist bench`: which benchmark is meant, and one line for what cannot be measured."""

from __future__ import annotations

import pytest

from kinetix_dist.cli.bench import BENCHMARKS, DEFAULT_OF_ENGINE, parse
from kinetix_dist.cli.main import main


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_explains_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["bench", *name.split(), "--help"])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert f"usage: kinetix-dist bench {name}" in printed and "--json" in printed


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_has_defaults_that_can_run(name: str) -> None:
    args = parse([*name.split(), "--json", "out.json"])
    assert args.benchmark.__name__ == BENCHMARKS[name][0]
    assert str(args.options.json) == "out.json"


def test_engine_alone_is_its_speed() -> None:
    assert parse(["engine", "--sizes", "m"]) == parse([*DEFAULT_OF_ENGINE.split(), "--sizes", "m"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "say what to measure: engine speed, engine effects"),
        ("--json out.json", "stands first, not --json"),
        ("scalign", "did you mean 'scaling'?"),
        ("engine spede", "did you mean 'engine speed'?"),
        ("engine --steps 3", "--steps is 3"),
        ("engine --repeats 2", "--repeats is 2"),
        ("engine --worlds 0", "--worlds has 0"),
        ("engine --sizes", "--sizes is empty"),
        ("engine --levels no/such/folder", "no/such/folder"),
        ("engine --levels tests --sizes s", "no level files in tests/s"),
        ("engine --json /dev/null/out.json", "/dev/null"),
        ("engine --presets exact --worlds 2 --sizes s", "exact"),
        ("engine --backend cuda --worlds 2 --sizes s", "cuda"),
        ("engine effects --preset exact --worlds 2 --sizes s", "exact"),
        ("engine effects --backend xla", "--backend"),
        ("engine growth --shapes 64 3", "a world of 3 shapes"),
        ("engine growth --shapes 513", "at most 512 shapes"),
        ("engine growth --peers", "--peers"),
        ("learner --worlds 10 --steps 3 --minibatch 7", "30 samples, no multiple of --minibatch 7"),
        ("learner --worlds 12 --minibatch 256", "12 worlds cannot be divided"),
        ("train --recipe quickstrat", "did you mean 'quickstart'?"),
        ("train --updates 2", "--updates is 2"),
        ("train --set ppo.epoch=3", "--set has 'ppo.epoch=3'"),
        ("train --set ppo.epochs=many", "ppo.epochs"),
        ("train --recipe sfl_s --device gpu", "no GPU is visible"),
        ("scaling --devices 0", "--devices has [0]"),
        ("scaling --placements", "--placements is empty"),
        ("curator --recipe single_level", "'single_level' has no curator"),
    ],
)
def test_what_cannot_be_measured_is_one_line(
    arguments: str, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # no GPU, whatever the machine
    assert main(["bench", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error
