"""Options and settings that are numbers: NaN and infinity are refused in one line, by every command."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.cli import train
from kinetix_dist.cli.bench import BENCHMARKS
from kinetix_dist.cli.main import COMMANDS, main
from kinetix_dist.config import ConfigError
from kinetix_dist.config.plain import build
from kinetix_dist.data.rollout import Disturbance
from kinetix_dist.delay.execution import Schedule
from kinetix_dist.errors import UserError
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.models.level_vae import VaeConfig
from kinetix_dist.setting import check_finite, check_settings, setting

# Words after each command or subcommand without which it complains of others than its numbers.
NEEDED = {
    "sweep": ["design.toml"],
    "study": ["study"],
    "eval": ["--levels", "s/kick"],
    "collect": ["--policy", "random", "--levels", "s/kick", "--out", "out"],
    "clone-flow": ["--data", "data", "--run", "run"],
    "bench engine growth": [],
    "bench delay": ["--policy", "generalist", "--levels", "s/kick"],
    "bench scaling": [],
    "bench curator": [],
    "levels solve": ["s/kick"],
    "data import-kinetix": ["source", "out"],
}
SUBCOMMANDS = {
    "bench": tuple(BENCHMARKS),
    "levels": ("list", "show", "play", "check", "render", "convert", "generate", "solve", "stats"),
    "data": ("import-kinetix", "export-minari"),
}
OF_A_RUN = ("train", "finetune", "quickstart")  # options of `TrainConfig`, and of finetune --stop-at


def float_options(command: str) -> list[str]:
    """Options that the help of a command shows as numbers with a point."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*command.split(), "--help-all" if command in OF_A_RUN else "--help"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())
    return sorted(set(re.findall(r"(--[\w.-]+)(?: \{None\}\|| )FLOAT", text)))


def commands() -> Iterator[str]:
    for name in COMMANDS:
        if name not in OF_A_RUN:
            yield from (f"{name} {part}" for part in SUBCOMMANDS[name]) if name in SUBCOMMANDS else (name,)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("command", commands())
def test_every_number_of_a_command_is_finite(
    command: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    options = float_options(command)
    assert bool(options) == (command in NEEDED)
    capsys.readouterr()
    for option in options:
        assert main([*command.split(), *NEEDED[command], f"{option}={value}"]) == 2, option
        (line,) = capsys.readouterr().err.splitlines()
        name = option.split(".")[-1].removeprefix("--")
        assert re.search(rf"\b{name} is {value}; ", line.replace("_", "-")), line
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_every_number_of_a_run_is_finite() -> None:
    options = float_options("train")
    assert len(options) > 100
    for option in options:
        with pytest.raises(UserError, match=r"finite|must be|is not|give"):
            train.parse(["--recipe", "tiny", f"{option}=nan"])


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_finetune_stops_at_a_rate(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    level = str(levels_root() / "s" / "kick.json")
    assert main(["finetune", "--levels", level, "--each", "--stop-at", value]) == 2
    assert f"--stop-at is {value}" in capsys.readouterr().err


@dataclasses.dataclass(frozen=True)
class _Section:
    share: float = setting(0.5, maximum=1)
    limit: float | None = None
    rates: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_settings(self)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("field", ["share", "limit", "rates"])
def test_every_setting_is_finite(field: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"_Section\.{field}.* is {value}; it must be a finite number"):
        build(_Section, {field: [1.0, value] if field == "rates" else value})


def test_whole_numbers_of_any_size_are_finite() -> None:
    check_finite({"seed": 10**400})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -0.1])
def test_parts_that_programs_make_take_finite_numbers(value: float) -> None:
    parts: tuple[tuple[Any, dict[str, Any]], ...] = (
        (Disturbance, {"noise": value}),
        (Disturbance, {"sticky": value}),
        (VaeConfig, {"kl_coefficient": value}),
        (VaeConfig, {"learning_rate": value}),
    )
    for kind, fields in parts:
        with pytest.raises(ValueError, match=next(iter(fields))):
            kind(**fields)
    with pytest.raises(ValueError, match="noise"):
        Schedule(delay=0, execute=1, horizon=4, action_noise=value).check()
