"""Checkpoints and runs of other people: their plugins run only if the user trusts them, their paths are never used."""

from __future__ import annotations

import copy
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import kinetix_dist as kd
from kinetix_dist.benchmarks.goal_following import Options, measure
from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.checkpoint import load_checkpoint, save_checkpoint
from kinetix_dist.cli import train
from kinetix_dist.cli.main import main
from kinetix_dist.config import to_dict
from kinetix_dist.errors import UserError
from kinetix_dist.recipes import recipe
from kinetix_dist.registry import TRUST_PLUGINS, TRUST_VARIABLE, PluginError
from kinetix_dist.studio.worker.request import env_of, policy_of

MODULE = "evil_parts_of_a_stranger"
# Each of these reads a checkpoint. RUN is a run directory, CHECKPOINT its checkpoint.
COMMANDS = (
    "eval --checkpoint CHECKPOINT --levels s/kick",
    "eval --run RUN --levels s/kick",
    "collect --policy RUN --levels s/kick --out OUT --transitions 16",
    "levels render s/kick OUT.gif --by trained --checkpoint CHECKPOINT",
    "levels solve s/kick --method policy --checkpoint CHECKPOINT --proofs OUT",
    "levels generate OUT --teacher RUN",
    "finetune --from CHECKPOINT --levels s/kick --run OUT",
    "train --recipe tiny --from CHECKPOINT --run OUT --run.start_other_engine True",
    "train --recipe RUN --run OUT",
    "bench goals --checkpoint CHECKPOINT",
    "bench delay --policy RUN --levels s/kick",
)


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that a plugin beside the checkpoint writes as soon as it is imported."""
    sign = tmp_path / "sign"
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / f"{MODULE}.py").write_text(f"open({str(sign)!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delenv(TRUST_VARIABLE, raising=False)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    return sign


@pytest.fixture
def stored(tmp_path: Path) -> Callable[..., Path]:
    """Stores a run directory with one checkpoint, whose configuration names other things of `run`."""

    def store(**run: Any) -> Path:
        generalist = load_checkpoint(Path("generalist"))
        description = copy.deepcopy(generalist.description)
        description["config"]["run"] |= run
        arrays = {name: array for name, array in generalist.arrays.items() if name.startswith("learner/")}
        path = tmp_path / "stranger"
        save_checkpoint(path / "checkpoints", 7, arrays, description, keep=1)
        config = to_dict(recipe("tiny"))
        config["run"] |= run
        (path / "config.json").write_text(json.dumps({"config": config}))
        return path

    return store


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_runs_a_plugin_of_a_stranger(
    command: str,
    trap: Path,
    stored: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = stored(plugins=[MODULE])
    words = {"RUN": run, "CHECKPOINT": run / "checkpoints" / "00000007"}
    words |= {"OUT": tmp_path / "out", "OUT.gif": tmp_path / "out.gif"}
    assert main([str(words.get(word, word)) for word in command.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"it names plugins, modules whose code would run: {MODULE!r}; give {TRUST_PLUGINS}" in line
    assert not trap.exists() and not words["OUT.gif"].exists()


def test_no_reader_runs_a_plugin_of_a_stranger(trap: Path, stored: Callable[..., Path]) -> None:
    run = stored(plugins=[MODULE])
    checkpoint = run / "checkpoints" / "00000007"
    readers: tuple[Callable[[], object], ...] = (
        lambda: kd.load_policy(run),
        lambda: kd.load_policy(checkpoint),
        lambda: policy_of({"checkpoint": str(checkpoint)}),  # the studio
        lambda: policy_of({"run": str(run)}),
        lambda: env_of({"run": str(run)}, "s"),
        lambda: measure(Options(checkpoint=checkpoint), Results(None, report=print)),
    )
    for reader in readers:
        with pytest.raises(UserError, match=MODULE):
            reader()
    assert not trap.exists()


def test_plugins_that_the_user_trusts_are_imported(
    trap: Path, stored: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run = stored(plugins=[MODULE])
    with pytest.raises(SystemExit):
        main(["train", "--recipe", str(run), TRUST_PLUGINS, "--help"])
    assert trap.exists() and "options and their values" in capsys.readouterr().out
    assert TRUST_VARIABLE not in os.environ  # trust ends with the command


@pytest.mark.parametrize(
    "words", [["--recipe", "RUN", "--run.plugins", MODULE], ["--resume", "--run", "RUN"]], ids=["named", "resumed"]
)
def test_the_user_names_a_plugin_or_resumes_the_run(words: list[str], trap: Path, stored: Callable[..., Path]) -> None:
    run = stored(plugins=[MODULE])
    args = train.parse([str(run) if word == "RUN" else word for word in words])
    assert trap.exists() and args.config.run.plugins == (MODULE,)


def test_a_module_that_the_program_has_imported_needs_no_trust(trap: Path, stored: Callable[..., Path]) -> None:
    run = stored(plugins=["json"])
    kd.load_policy(run)
    assert not trap.exists()


@pytest.mark.parametrize("plugins", [MODULE, [MODULE, 3], {MODULE: 1}, 5, None])
def test_plugins_of_another_type_are_refused(plugins: Any, trap: Path, stored: Callable[..., Path]) -> None:
    run = stored(plugins=plugins)
    with pytest.raises(UserError, match=r"run\.plugins is .*; a list of names"):
        kd.load_policy(run)
    assert not trap.exists()


@pytest.mark.parametrize("option", ["--checkpoint", "--run"])
def test_eval_does_not_use_the_compile_cache_of_a_checkpoint(
    option: str, stored: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = stored(compile_cache=str(tmp_path / "cache"))
    path = run if option == "--run" else run / "checkpoints" / "00000007"
    assert main(["eval", option, str(path), "--levels", "no_such_levels"]) == 2
    assert "no_such_levels" in capsys.readouterr().err  # found after JAX was prepared
    assert not (tmp_path / "cache").exists()


def test_a_recipe_from_another_run_does_not_use_its_compile_cache(stored: Callable[..., Path], tmp_path: Path) -> None:
    run = stored(compile_cache=str(tmp_path / "cache"))
    assert train.parse(["--recipe", str(run)]).config.run.compile_cache == ""
    assert train.parse(["--resume", "--run", str(run)]).config.run.compile_cache == str(tmp_path / "cache")


@pytest.mark.parametrize("name", ["../../elsewhere", "/elsewhere", "a/b", "..", ""])
def test_a_recipe_from_another_run_does_not_say_where_the_new_one_lies(
    name: str, stored: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"run\.name is .*; a name without folders"):
        train.parse(["--recipe", str(stored(name=name))])


def test_the_refusal_is_short_and_escapes_what_a_stranger_wrote(trap: Path, stored: Callable[..., Path]) -> None:
    run = stored(plugins=["\x1b[31m" + "x" * 10_000] * 100)
    with pytest.raises(UserError) as caught:
        kd.load_policy(run)
    assert len(str(caught.value)) < 1000 and "\x1b" not in str(caught.value)
    assert isinstance(caught.value.__cause__, PluginError)
