"""`kinetix-dist finetune`: an ordinary run from a policy, and one line for what cannot be."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from kinetix_dist.cli import finetune
from kinetix_dist.cli.main import main
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.finetune.each import even_size
from kinetix_dist.finetune.specialists import policy_at, start_from
from kinetix_dist.models.policy import PolicyConfig
from tests.finetune.small import NAMES, OPTIONS, config_of, level_directory, write_policy


@pytest.fixture(autouse=True)
def _working_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return level_directory(tmp_path_factory.mktemp("finetune") / "levels")


@pytest.fixture(scope="module")
def policy(levels: Path) -> Path:
    """Policy of the network and environment of `tiny`, trained on levels of size M."""
    config = config_of(levels)
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, size="m"))
    return write_policy(levels.parent / "policy", config)


@pytest.fixture(scope="module")
def flat_policy(levels: Path) -> Path:
    """Policy of a network that plays levels of size S only."""
    policy = PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1)
    env = EnvConfig(observation="flat", max_steps=16)
    return write_policy(levels.parent / "flat", config_of(levels, env=env, policy=policy))


def test_without_each_it_is_a_run_of_train_with_the_network_of_the_policy(levels: Path, policy: Path) -> None:
    args = finetune.parse(["--levels", str(levels), "--from", str(policy), "--ppo.epochs", "3"])
    assert args.train is not None and not args.each
    config = finetune.sized(args.train.config, has_size=args.has_size)
    theirs = config_of(levels)
    assert (config.policy, config.env) == (theirs.policy, theirs.env)  # size S, that of the levels, not M
    assert (config.curriculum.name, config.curriculum.levels) == ("fixed", str(levels))
    assert (config.run.start_from, config.run.name, config.ppo.epochs) == (str(policy), "finetune", 3)
    assert config.evaluation.sets == (str(levels),)


def test_results_are_called_like_the_policy_however_its_path_was_typed(
    policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(policy / "arrays")
    for typed in ("..", "../../policy", str(policy)):
        start = start_from(policy_at(Path(typed)))
        assert (start.name, start.checkpoint) == (policy.name, str(policy))


def test_a_flat_policy_keeps_its_size(flat_policy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = _refusal(capsys, "--levels", "designed_m", "--from", str(flat_policy), "--each")
    assert line.startswith("kinetix-dist: env.size is 's': ") and "the size has room for" in line


def _refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr; fails unless the exit status is 2."""
    capsys.readouterr()
    assert main(["finetune", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("each_or_not", [(), ("--each",)], ids=["run", "each"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--levels is missing"),
        (("--levels", ""), "--levels is missing"),
        (("--levels", "designed_s", "--from", ""), "--from is empty"),
        (("--levels", "designed_x"), "unknown level set 'designed_x'; did you mean 'designed_"),
        (("--levels", "designed_m", "--env.size", "s"), "env.size is 's': "),
        (("--levels", "designed_s", "--from", "nosuch"), "there is no checkpoint nosuch; pretrained policies here"),
        (("--levels", "designed_s", "--from", "POLICY", "--policy.encoder_size", "16"), "array params/"),
        (("--levels", "designed_s", "--from", "POLICY", "--env.action_space", "discrete"), "array params/"),
        (("--levels", "designed_s", "--from", "POLICY", "--policy.network", "flat"), "env.observation 'entity' gives"),
        (("--levels", "designed_s", "--recipe", "tiniest"), "unknown recipe 'tiniest'"),
        (("--levels", "designed_s", "--each", "--compare"), "give --each and --from too"),
        (("--levels", "designed_s", "--resume"), "--resume goes on with a run as it is"),
        (("--levels", "designed_s", "--each", "--part", "4/4"), "--part is '4/4'; give K/N"),
        (("--levels", "designed_s", "--each", "--part", "half"), "--part is 'half'; give K/N"),
        (("--levels", "designed_s", "--each", "--together", "0"), "--together is 0; give 1 or more"),
        (("--draw", "nowhere", "--levels", "designed_s"), "--draw takes the directory of the results"),
    ],
)
def test_what_cannot_be_is_one_line(
    options: tuple[str, ...],
    message: str,
    each_or_not: tuple[str, ...],
    policy: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = [str(policy) if option == "POLICY" else option for option in options]
    no_mask = ("--ppo.mask_unbound_heads", "False")
    assert message in _refusal(capsys, *given, *each_or_not, *(() if "--draw" in given else no_mask))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--evaluation.every", "0"), "evaluation.every is 0"),
        (("--phases", "phases.toml"), "phases are of runs"),
        (("--run.placement", "colocated"), "run.placement is 'colocated'"),
        (("--stop-at", "1.5"), "--stop-at is 1.5"),
        (("--gif", "after.png"), "--gif is 'after.png'; name a file that ends in .gif"),
        (
            ("--gif", "nowhere/after.gif"),
            "cannot write nowhere/after.gif; give --gif a file in a directory that exists",
        ),
        (("--curriculum.name", "plr", "--curriculum.levels", ""), "curriculum.name is 'plr'"),
        (("--run", "a_run"), "a_run holds a run"),
        (("--from", "generalist", "--run.start_optimizer", "True"), "run.start_optimizer is True"),
    ],
)
def test_what_specialists_do_not_have_is_one_line(
    options: tuple[str, ...], message: str, levels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_run").mkdir()
    (tmp_path / "a_run" / "config.json").write_text("{}")
    (tmp_path / "phases.toml").write_text("[[phases]]\nstart = 1000000\noptions = {'ppo.clip' = 0.1}\n")
    assert message in _refusal(capsys, "--levels", str(levels), "--each", *OPTIONS, *options)


def test_a_moving_picture_is_of_specialists(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--gif shows specialists; give --each too" in _refusal(capsys, "--levels", "designed_s", "--gif", "a.gif")
    assert "cannot write nowhere/a.gif" in _refusal(capsys, "--draw", "results", "--gif", "nowhere/a.gif")
    assert "results holds no results of specialists" in _refusal(capsys, "--draw", "results", "--gif", "a.gif")


def test_a_directory_without_results_cannot_be_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "holds no results of specialists (no design.json)" in _refusal(capsys, "--draw", str(tmp_path))
    (tmp_path / "design.json").write_text("{}")
    assert "design.json is damaged: 'levels' is missing" in _refusal(capsys, "--draw", str(tmp_path))
    (tmp_path / "design.json").write_text('{"levels": {"kick": ""}}')
    (tmp_path / "scratch").mkdir()
    (tmp_path / "scratch" / "kick.json").write_text('{"level": "kick", "start": "scratch", "label": 3}')
    assert "kick.json is damaged: 'label' is missing or of another type" in _refusal(capsys, "--draw", str(tmp_path))


def test_parts_train_all_levels_between_them(levels: Path, tmp_path: Path) -> None:
    for part, name in enumerate(NAMES):
        results = tmp_path / f"part{part}"
        command = [
            "finetune",
            "--levels",
            str(levels),
            *OPTIONS,
            "--each",
            "--part",
            f"{part}/2",
            "--run",
            str(results),
        ]
        assert main(command) == 0
        assert [file.stem for file in results.glob("scratch/*.json")] == [name]


def test_together_is_of_specialists(capsys: pytest.CaptureFixture[str]) -> None:
    line = _refusal(capsys, "--levels", "designed_s", "--together", "2")
    assert line.endswith("--together is how many specialists train at a time; give --each too")


def test_specialists_imitate_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    line = _refusal(capsys, "--levels", "designed_s", "--each", "--run.imitation_steps", "9")
    assert line.endswith("run.imitation_steps is of one run; leave --each out, or run.imitation_steps")


@pytest.mark.parametrize(("count", "limit", "size"), [(1, 8, 1), (8, 8, 8), (9, 8, 5), (10, 4, 4), (40, 16, 14)])
def test_batches_are_as_even_as_they_can_be(count: int, limit: int, size: int) -> None:
    assert even_size(count, limit) == size
