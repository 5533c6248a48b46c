"""`kinetix-dist quickstart`: trains, fine-tunes from what was trained, draws; and goes on where it was stopped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from kinetix_dist.cli import finetune, quickstart, train
from kinetix_dist.cli.main import main
from kinetix_dist.level.sets import files_of_set
from kinetix_dist.recipes import RECIPES, recipe
from kinetix_dist.runtime import EXIT_STOPPED
from tests.finetune.small import NAMES, level_directory, write_policy


@pytest.fixture(autouse=True)
def _working_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def _trained_run(path: Path) -> Path:
    """A run whose newest checkpoint is a policy that learned nothing."""
    (path / "checkpoints").mkdir(parents=True)
    write_policy(path / "checkpoints" / "00000007", recipe("quickstart"))
    return path


def test_the_second_part_trains_from_the_run_of_the_first_and_beside_scratch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained, tuned = [], []
    run = _trained_run(tmp_path / "runs" / "quickstart")
    monkeypatch.setattr(train, "run_in", lambda args: (trained.append(args), (0, run))[1])
    monkeypatch.setattr(finetune, "run", lambda args: tuned.append(args) or 0)
    assert main(["quickstart", "--run.seed", "3"]) == 0
    (first,), (second,) = trained, tuned
    assert first.config == dataclasses.replace(
        recipe("quickstart"), run=dataclasses.replace(recipe("quickstart").run, seed=3)
    )
    assert [start.name for start in second.starts] == ["scratch", "quickstart-7"]
    assert (second.train.config.policy, second.train.config.env) == (first.config.policy, first.config.env)
    assert second.train.config.run.seed == 3
    assert second.each and second.stop_at == 0.9 and second.train.run == run / "finetune"
    assert len(files_of_set(second.train.config.curriculum.levels)) == 2
    assert "`kinetix-dist quickstart --resume --run" in second.go_on
    assert str(second.gif) in capsys.readouterr().out


@pytest.mark.parametrize("status", [1, EXIT_STOPPED])
def test_nothing_follows_a_run_that_did_not_end(status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "run_in", lambda args: (status, None))
    monkeypatch.setattr(finetune, "run", lambda args: pytest.fail("fine-tuned"))
    assert main(["quickstart"]) == status


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--recipe", "tiny"), "quickstart has no --recipe; `kinetix-dist train --recipe NAME`"),
        (("--from=generalist",), "quickstart has no --from; `kinetix-dist train --from CKPT`"),
        (("--ppo.speed", "3"), "--ppo.speed"),
        (("--resume",), "there is no run runs/quickstart to resume"),
    ],
)
def test_what_cannot_be_is_one_line(options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["quickstart", *options]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def test_help_needs_no_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["quickstart", "--help"])
    assert ended.value.code == 0 and "usage: kinetix-dist quickstart" in capsys.readouterr().out


@pytest.mark.long
def test_from_nothing_to_a_moving_picture_and_again_from_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    tiny = recipe("tiny")
    few = dataclasses.replace(tiny.evaluation, every=2, min_attempts=8)
    monkeypatch.setitem(RECIPES, "quickstart_finetune", lambda: dataclasses.replace(tiny, evaluation=few))
    monkeypatch.setattr(quickstart, "RECIPE", "tiny")
    monkeypatch.setattr(quickstart, "LEVELS", str(level_directory(tmp_path / "levels")))
    assert main(["quickstart", "--run", "runs/one"]) == 0
    printed = capfd.readouterr().out
    gif = Path("runs/one/finetune/finetuned.gif")
    assert gif.read_bytes().startswith(b"GIF8") and f"gif      {gif}" in printed
    for name in NAMES:
        assert f"{name}" in printed and "from one-8: " in printed

    gif.unlink()
    assert main(["quickstart", "--run", "runs/one", "--resume"]) == 0
    printed = capfd.readouterr().out
    assert "runs/one is finished" in printed and "4 of 4 specialists are there already" in printed
    assert gif.exists()
