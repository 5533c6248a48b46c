"""`kinetix-dist train` refuses what cannot run: one line that says what and what to do, exit status 2."""

import dataclasses
import json

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import parse
from kinetix_dist.config import to_dict
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.driver.run_directory import RunDirectory


@pytest.fixture(autouse=True)
def _working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def _refusal(capsys, *arguments) -> str:
    """The one line on stderr; fails unless the exit status is 2."""
    assert main(["train", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def _a_run(path, config=None):
    run = RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {"config": to_dict(config or recipe("tiny"))})
    return run


def test_an_unknown_recipe(capsys):
    assert "unknown recipe 'quickstrat'; did you mean 'quickstart'?" in _refusal(capsys, "--recipe", "quickstrat")


def test_an_unknown_field(capsys):
    line = _refusal(capsys, "--recipe", "tiny", "--ppo.speed", "3")
    assert "--ppo.speed" in line


def test_a_value_of_another_type(capsys):
    line = _refusal(capsys, "--recipe", "tiny", "--ppo.epochs", "many")
    assert "epochs" in line and "many" in line


def test_a_value_that_makes_no_sense(capsys):
    line = _refusal(capsys, "--recipe", "tiny", "--rollout.num_envs", "17")
    assert "num_envs 17 is not a multiple of num_groups 4" in line


def test_an_unknown_level_size(capsys):
    assert "sizes are s, m, l" in _refusal(capsys, "--recipe", "tiny", "--env.size", "xl")


def test_a_run_that_would_never_end(capsys):
    line = _refusal(capsys, "--recipe", "tiny", "--run.total_env_steps", "0")
    assert "neither total_env_steps nor max_seconds" in line


def test_a_gpu_where_there_is_none(capsys, tmp_path):
    line = _refusal(capsys, "--recipe", "tiny", "--run.device", "gpu", "--run", tmp_path / "run")
    assert "no GPU is visible" in line
    assert not (tmp_path / "run").exists()


def test_a_run_directory_that_cannot_be_written(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert "file/run" in _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "file" / "run")
    assert "/proc/run" in _refusal(capsys, "--recipe", "tiny", "--run", "/proc/run")


def test_a_run_directory_in_use(capsys, tmp_path):
    run = _a_run(tmp_path / "run")
    for extra in ((), ("--resume",)):
        assert "is in use by process" in _refusal(capsys, "--run", tmp_path / "run", *extra)
    run.close()


def test_a_directory_that_holds_a_run_already(capsys, tmp_path):
    _a_run(tmp_path / "run").close()
    assert "holds a run already; go on with it by --resume" in _refusal(capsys, "--run", tmp_path / "run")


def test_resuming_what_is_not_there(capsys, tmp_path):
    assert "holds no run" in _refusal(capsys, "--resume", "--run", tmp_path / "nothing")
    assert "there is no run runs/quickstart to resume" in _refusal(capsys, "--resume")


def test_an_unknown_level_set(capsys, tmp_path):
    line = _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run", "--evaluation.sets", "random_xl")
    assert "unknown level set 'random_xl'" in line
    assert not (tmp_path / "run").exists()
    assert "does not fit size 's'" in _refusal(capsys, "--recipe", "tiny", "--evaluation.sets", "random_l")
    line = _refusal(capsys, "--recipe", "tiny", "--curriculum.name", "fixed", "--curriculum.levels", "nowhere")
    assert "unknown level set 'nowhere'" in line


def test_resuming_takes_the_configuration_of_the_run_and_its_overrides(tmp_path):
    tiny = recipe("tiny")
    config = dataclasses.replace(tiny, ppo=dataclasses.replace(tiny.ppo, epochs=5))
    _a_run(tmp_path / "run", config).close()
    args = parse(["--run", str(tmp_path / "run"), "--resume", "--run.total_env_steps", "99"])
    assert args.config.ppo.epochs == 5
    assert args.config.run.total_env_steps == 99
    assert args.config.hash == config.hash


def test_resume_without_a_directory_takes_the_newest_run_of_the_recipe(tmp_path):
    for name in ("quickstart", "quickstart-2"):
        _a_run(tmp_path / "runs" / name, recipe("quickstart")).close()
    assert str(parse(["--resume"]).run) == "runs/quickstart-2"


def test_every_field_can_be_given_on_the_command_line():
    options = "--ppo.value_clip False --evaluation.sets random_s s/kick --run.placement split"
    args = parse(["--recipe", "tiny", *options.split(), "--curriculum.generator.triangle_chance", "0.5"])
    assert args.config.ppo.value_clip is False
    assert args.config.evaluation.sets == ("random_s", "s/kick")
    assert args.config.curriculum.generator.triangle_chance == 0.5
    assert json.dumps(to_dict(args.config))
