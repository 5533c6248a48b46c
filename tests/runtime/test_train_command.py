"""`kinetix-dist train` refuses what cannot run: one line that says what and what to do, exit status 2."""

import dataclasses
import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from jax2d import PRESETS, Settings, preset
from kinetix_dist.checkpoint import save_checkpoint
from kinetix_dist.cli import train
from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import longer, parse
from kinetix_dist.config import EvaluationConfig, differences, from_dict, from_dict_for_playing, to_dict
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.env.action_spaces import ACTION_SPACES, MultiDiscrete
from kinetix_dist.env.env_config import describe
from kinetix_dist.evaluation import evaluation_sets
from kinetix_dist.level.generator_config import LOCOMOTION_FAMILIES, GeneratorConfig, generator
from kinetix_dist.recipes import FAMILY_WEIGHTS, recipe
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from tests.helpers import PATIENCE_S, REPOSITORY, python_path


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


def test_a_new_run_begins_with_the_configuration_of_another(capsys, tmp_path):
    tiny = recipe("tiny")
    path = _a_run(tmp_path / "a", dataclasses.replace(tiny, ppo=dataclasses.replace(tiny.ppo, clip=0.1))).path
    parsed = parse(["--recipe", str(path), "--ppo.epochs", "3"])
    assert not parsed.resume and parsed.run is None
    assert parsed.config == dataclasses.replace(tiny, ppo=dataclasses.replace(tiny.ppo, clip=0.1, epochs=3))
    (path / "config.json").write_text("{")
    assert "config.json cannot be read" in _refusal(capsys, "--recipe", path)


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
    assert "choose one of s, m, l" in _refusal(capsys, "--recipe", "tiny", "--env.size", "xl")


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


def test_a_run_directory_without_a_name(capsys):
    """An unset variable gives an empty name."""
    for name in ("", "."):
        assert "--run is empty or the current directory" in _refusal(capsys, "--recipe", "tiny", "--run", name)


def test_a_lock_that_is_no_file(capsys, tmp_path):
    (tmp_path / "run" / "lock").mkdir(parents=True)
    line = _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run")
    assert "lock is a directory and should be a file; remove it" in line


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


def test_a_directory_below_which_checkpoints_could_not_be_read(capsys, tmp_path):
    name = "r\udcffun"
    assert "choose another --run" in _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / name)
    assert not (tmp_path / name).exists()


def test_checkpoints_without_the_configuration_of_their_run(capsys, tmp_path):
    run = _a_run(tmp_path / "run")
    save_checkpoint(run.checkpoints, 2, {"x": np.zeros(1)}, {"config": to_dict(recipe("tiny"))}, keep=1)
    run.close()
    stored = run.config_path.read_text()
    run.config_path.unlink()
    for extra in ((), ("--resume",)):
        assert "has checkpoints but no config.json" in _refusal(capsys, "--run", tmp_path / "run", *extra)
    run.config_path.write_text(stored)
    assert parse(["--run", str(tmp_path / "run"), "--resume"]).config == recipe("tiny")


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "null", '{"config": [1]}', '{"config": {"run": 3}}', '{"config": null}', "[" * 100_000]
)
def test_a_damaged_configuration(capsys, tmp_path, text):
    run = _a_run(tmp_path / "run")
    run.close()
    run.config_path.write_text(text)
    line = _refusal(capsys, "--run", tmp_path / "run", "--resume")
    assert "config.json" in line and "checkpoint.json" in line


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("seed", str(10**30), "must be from 0 to 4294967295"),
        ("seed", "-1", "must be from 0 to 4294967295"),
        ("heartbeat_seconds", "-1", "must be above 0"),
        ("heartbeat_seconds", "nan", "must be a finite number"),
        ("stop_seconds", "inf", "must be a finite number"),
        ("max_seconds", "nan", "must be a finite number"),
        ("gpu_memory_gib", "inf", "must be a finite number"),
    ],
)
def test_numbers_of_a_run_that_make_no_sense(capsys, field, value, says):
    assert says in _refusal(capsys, "--recipe", "tiny", f"--run.{field}", value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("ppo.max_grad_norm", "inf"),
        ("ppo.anneal.clip", "inf"),
        ("evaluation.every_seconds", "nan"),
        ("curriculum.generator.hidden_fine", "nan"),
    ],
)
def test_numbers_that_are_not_finite(capsys, field, value):
    line = _refusal(capsys, "--recipe", "tiny", f"--{field}={value}")
    assert f"{field.split('.')[-1]} is {value}; it must be a finite number" in line


def test_an_address_of_ray_that_is_none(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "not an address")
    line = _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run", "--run.placement", "colocated")
    assert "RAY_ADDRESS is 'not an address'" in line and "give HOST:PORT" in line
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_port_for_metrics_that_is_taken_or_is_none(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run", "--run.metrics_port", port)
    assert f"run.metrics_port {port} cannot be listened on (Address already in use); choose another" in line
    assert not (tmp_path / "run" / "config.json").exists()
    line = _refusal(capsys, "--recipe", "tiny", "--run.metrics_port", "70000")
    assert "metrics_port is 70000; it must be from 0 to 65535" in line


def test_an_unknown_level_set(capsys, tmp_path):
    line = _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run", "--evaluation.sets", "random_xl")
    assert "unknown level set 'random_xl'" in line
    assert not (tmp_path / "run").exists()
    line = _refusal(capsys, "--recipe", "tiny", "--curriculum.name", "fixed", "--curriculum.levels", "random_l")
    assert "level set 'random_l' does not fit size 's'; choose a larger env.size" in line
    flat = ("--policy.network", "flat", "--env.observation", "flat")
    for name in ("random_l", "dev_designed_m", "frontier_m", "designed_l"):
        line = _refusal(capsys, "--recipe", "tiny", *flat, "--evaluation.sets", name)
        assert f"level set {name!r} does not fit size 's', and policy.network 'flat' plays levels of the size" in line
    line = _refusal(capsys, "--recipe", "tiny", "--curriculum.name", "fixed", "--curriculum.levels", "nowhere")
    assert "unknown level set 'nowhere'" in line


def test_sets_that_are_drawn_are_not_drawn_before_a_run_begins(monkeypatch):
    loaded, load = [], evaluation_sets.load_level_set
    monkeypatch.setattr(evaluation_sets, "load_level_set", lambda name: (loaded.append(name), *load(name))[1:])
    names = ("random_s", "dev_random_s", "dev_designed_s", "frontier_s", "kinetix_s", "designed_s", "s/kick")
    config = recipe("tiny")
    train._check_inputs(dataclasses.replace(config, evaluation=EvaluationConfig(sets=names)), is_new=True)
    assert loaded == ["designed_s", "s/kick"]  # files, which may be wrong


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


# Phases and mixtures of sizes


PHASES = """
[[phases]]
start = 1000
options = { "ppo.clip" = 0.1 }

[[phases]]
start = 5000
[phases.options]
"rollout.num_envs" = 64
"curriculum.sizes" = { s = 0.5, m = 0.5 }
"""
MIXED = ["--recipe", "tiny", "--env.size", "m", "--rollout.num_envs", "32", "--curriculum.sizes", "m", "1"]


def test_phases_of_a_file_go_with_fields_of_the_command_line(tmp_path):
    (tmp_path / "phases.toml").write_text(PHASES)
    config = parse([*MIXED, "--phases", str(tmp_path / "phases.toml")]).config
    last = {"rollout.num_envs": 64, "curriculum.sizes": [["s", 0.5], ["m", 0.5]]}
    assert config.phases == (
        PhaseConfig(start=1000, options={"ppo.clip": 0.1}),
        PhaseConfig(start=5000, options=last),
    )
    assert config.schedule.phases[-1].config.curriculum.sizes == (("s", 0.5), ("m", 0.5))
    assert config.curriculum.sizes == (("m", 1.0),)
    as_json = {"phases": to_dict(config)["phases"]}
    (tmp_path / "phases.json").write_text(json.dumps(as_json))
    assert parse([*MIXED, "--phases", str(tmp_path / "phases.json")]).config == config


@pytest.mark.parametrize(("name", "share"), [("pretrain_l", 0.45), ("pretrain_all", 0.45), ("pretrain_m", 0.0)])
def test_recipes_that_draw_mechanisms(name, share):
    generator = recipe(name).curriculum.generator
    assert generator.mechanism_share == share
    assert (generator.varied_share > 0) == ("snake" in generator.mechanism_families) == (share > 0)
    assert generator.weight_of_family == (FAMILY_WEIGHTS if share else dict.fromkeys(LOCOMOTION_FAMILIES, 1.0))
    assert parse(["--recipe", name, "--curriculum.generator", "default"]).config.curriculum.generator == (
        GeneratorConfig()
    )


def test_a_phase_of_a_recipe_can_be_overridden():
    words = (
        "--phases.0.start 5 --phases.0.options.ppo.clip=0.1 --phases.0.options.curriculum.sizes s 1 l 2 --run.seed 7"
    )
    config = parse(["--recipe", "pretrain_all", *words.split()]).config
    options = {"curriculum.sizes": [["s", 1.0], ["l", 2.0]], "ppo.clip": 0.1}
    assert config.phases == (PhaseConfig(start=5, options=options),) and config.run.seed == 7


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--phases.1.start 5", "--phases.1.start: there is no phase '1'; phases are 0 to 0, and --phases FILE"),
        ("--phases.0.start soon", "--phases.0.start is 'soon'; give a number of environment steps"),
        ("--phases.0.clip 1", "phases.clip is now called phases.options.ppo.clip; use that"),
        ("--phases.0.size l", "--phases.0.size is no option of a phase; it has --phases.N.start and"),
        ("--phases.0.options.ppo.clip x", "ppo.clip"),
        ("--phases.0.options.policy.num_layers 3", "phase 1: policy.num_layers cannot change within a run"),
    ],
)
def test_a_phase_of_a_recipe_that_cannot_be_overridden(capsys, words, message):
    assert message in _refusal(capsys, "--recipe", "pretrain_all", *words.split())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[[phases]]\nstart = 9\nsize = 'l'",
            "phase 1 has 'size'; it has start, and options = {} with settings by full names in quotes",
        ),
        ("[[phases]]\noptions = {}", "phase 1 has no start"),
        ("[[phases]]\nstart = 1.5", "config field phases.0.start is 1.5; int is needed"),
        (
            "[[phases]]\nstart = 900\nnum_envs = 18",
            "phase 1: phases.num_envs is now called phases.options.rollout.num_",
        ),
        (
            "[[phases]]\nstart = 900\noptions = {'rollout.num_envs' = 18}",
            "phases.toml: phase 1: RolloutConfig.num_envs 18 is not a multiple",
        ),
        (
            "[[phases]]\nstart = 900\n[phases.options]\n'curriculum.sizes' = { xl = 1 }",
            "CurriculumConfig.sizes has 'xl'; sizes are s, m, l",
        ),
        (
            "[[phases]]\nstart = 900\noptions = {'curriculum.name' = 'fixed', 'curriculum.levels' = 'designed_m'}",
            "ramp_car.json: level has 6 polygons, walls included; the size has room for 5",
        ),
        ("[[phases]\n", "phases.toml cannot be read as TOML"),
        ("start = 3", "phases.toml holds no phases; write a table [[phases]] for each"),
    ],
)
def test_phases_of_a_file_that_cannot_run(capsys, tmp_path, text, message):
    (tmp_path / "phases.toml").write_text(text)
    assert message in _refusal(capsys, "--recipe", "tiny", "--phases", tmp_path / "phases.toml")


def test_a_file_of_phases_that_is_no_text(capsys, tmp_path):
    (tmp_path / "phases.toml").write_bytes(b"\xe4\x00")
    line = _refusal(capsys, "--recipe", "tiny", "--phases", tmp_path / "phases.toml")
    assert "phases.toml cannot be read as TOML: 'utf-8' codec" in line


def test_phases_are_those_of_a_file_or_of_the_command_line(capsys, tmp_path):
    (tmp_path / "phases.toml").write_text("[[phases]]\nstart = 256\noptions = {'ppo.clip' = 0.1}\n")
    line = _refusal(
        capsys, "--recipe", "tiny", "--phases", tmp_path / "phases.toml", "--phases.0.options.ppo.clip", "0.2"
    )
    assert "--phases FILE has all phases, and --phases.0.options.ppo.clip is of one" in line


def test_a_file_of_phases_that_is_not_there(capsys):
    assert "nowhere.toml" in _refusal(capsys, "--recipe", "tiny", "--phases", "nowhere.toml")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ("s -1 m 2", "CurriculumConfig.sizes gives 's' the weight -1.0; weights must be 0 or more"),
        ("s 0 m 0", "CurriculumConfig.sizes gives all sizes the weight 0"),
        ("xl 1", "CurriculumConfig.sizes has 'xl'; sizes are s, m, l"),
        ("m 1 l 1", "curriculum.sizes has 'l', which does not fit env.size 'm', the size of the arrays"),
        ("s 1 m 99", "none would be of size 's'; raise its weight, or draw more levels together"),
    ],
)
def test_a_mixture_of_sizes_that_means_nothing(capsys, sizes, message):
    assert message in _refusal(capsys, "--recipe", "tiny", "--env.size", "m", "--curriculum.sizes", *sizes.split())


# Starting from a policy


def test_a_start_that_is_none_is_refused_before_a_directory_is_made(capsys, tmp_path):
    run = _a_run(tmp_path / "other")
    save_checkpoint(run.checkpoints, 2, {"x": np.zeros(1)}, {"config": {}}, keep=1)
    run.close()
    for start, says in (
        ("", "--from is empty"),
        ("nothing", "no checkpoint nothing"),
        (tmp_path / "other", "is a run; name one of"),
        (tmp_path / "other" / "checkpoints" / "00000002", "config"),
    ):
        assert says in _refusal(capsys, "--recipe", "tiny", "--run", tmp_path / "run", "--from", start)
        assert not (tmp_path / "run").exists()


def test_a_start_stays_the_path_that_it_was(tmp_path, monkeypatch):
    (tmp_path / "here" / "policy").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    assert parse(["--from", "policy"]).config.run.start_from == str(tmp_path / "here" / "policy")
    assert parse(["--from", "generalist"]).config.run.start_from == "generalist"


def test_a_checkpoint_of_other_settings_of_the_engine_is_refused(capsys, tmp_path):
    options = ["--recipe", "pretrain_l", "--run.device", "cpu", "--env.physics.spring_hertz", "60"]
    line = _refusal(capsys, *options, *FROM_GENERALIST, "--run", tmp_path / "run")
    assert "learned with other settings of the engine: spring_hertz 88.0 instead of 60.0" in line
    assert "--run.start_other_engine True" in line


def test_a_checkpoint_without_an_optimiser_is_refused_where_one_is_requested(capsys, tmp_path):
    options = ["--recipe", "pretrain_l", "--run.start_optimizer", "True", "--run.device", "cpu"]
    line = _refusal(capsys, *options, *FROM_GENERALIST, "--run", tmp_path / "run")
    assert "pretrained/generalist holds the parameters of a policy and no optimiser" in line
    assert "start_from names no checkpoint; give one (--from)" in _refusal(capsys, "--run.start_optimizer", "True")


def test_a_resumed_run_goes_on_from_its_own_checkpoints(capsys, tmp_path):
    line = _refusal(capsys, "--resume", "--run", tmp_path / "run", *FROM_GENERALIST)
    assert "--from is for a new run" in line


FROM_GENERALIST = ["--from", "generalist", "--run.placement", "local"]


# Physics


@pytest.mark.parametrize(
    ("ends", "steps", "seconds", "options"),
    [
        ({"total_env_steps": 100}, 128, 5.0, "--run.total_env_steps 256"),
        ({"total_env_steps": 0, "max_seconds": 30.0}, 128, 30.5, "--run.max_seconds 60"),
        ({"total_env_steps": 1000, "max_seconds": 30.0}, 128, 30.5, "--run.max_seconds 60"),
        ({"total_env_steps": 100, "max_seconds": 30.0}, 128, 5.0, "--run.total_env_steps 256"),
        ({"total_env_steps": 100, "max_seconds": 30.0}, 128, 31.0, "--run.total_env_steps 256 --run.max_seconds 60"),
    ],
)
def test_a_run_goes_on_past_what_ended_it(ends, steps, seconds, options):
    run = dataclasses.replace(recipe("tiny").run, **ends)
    assert longer(run, {"env_steps": steps, "training_seconds": seconds}) == options


def test_a_preset_is_replaced_first_and_single_fields_after_it_in_any_order():
    fine = preset("fine").replace(max_speed=50.0)
    for options in ("--env.preset fine --env.physics.max_speed 50", "--env.physics.max_speed 50 --env.preset=fine"):
        assert parse(["--recipe", "tiny", *options.split()]).config.env.physics == fine
    twice = parse(["--recipe", "tiny", "--env.preset", "fine", "--env.preset", "draft"])
    assert twice.config.env.physics == preset("draft")


def test_a_generator_is_replaced_first_and_single_fields_after_it():
    options = ["--curriculum.generator.triangle_chance", "0.5", "--curriculum.generator", "kinetix"]
    found = parse(["--recipe", "tiny", *options]).config.curriculum.generator
    assert found == dataclasses.replace(generator("kinetix"), triangle_chance=0.5)


@pytest.mark.long
@pytest.mark.parametrize("field", dataclasses.fields(Settings), ids=lambda field: field.name)
def test_every_field_of_the_physics_can_be_given_on_the_command_line(field):
    other = {"solver": "sequential_impulses", "friction_mixing": "root_sum_square", "dt": 0.02}
    if field.name == "solver_batch_size":
        pytest.skip("of the reference backend alone: refused below")
    of_type = {bool: not field.default, int: 3, float: 0.75}
    value = other[field.name] if field.name in other else of_type[type(field.default)]
    config = parse(["--recipe", "tiny", f"--env.physics.{field.name}", str(value)]).config
    assert config.env.physics == preset("standard").replace(**{field.name: value})
    assert config.hash != recipe("tiny").hash
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_an_unknown_preset_and_bad_physics_are_refused(capsys):
    assert "unknown preset 'good'; known presets: draft, fine" in _refusal(capsys, "--env.preset", "good")
    assert "unknown generator 'good'; generators are default" in _refusal(capsys, "--curriculum.generator", "good")
    assert "Settings.substeps is 0" in _refusal(capsys, "--recipe", "tiny", "--env.physics.substeps", "0")
    line = _refusal(capsys, "--env.preset", "paper", "--env.physics.solver_batch_size", "16")
    assert "environments, solves one contact after another: use 1" in line


@pytest.mark.parametrize(
    ("options", "size", "families"),
    [
        (("--curriculum.generator", "runner"), "s", "arm, pendulum, unicycle, turner, or"),
        (("--env.size", "m", "--curriculum.generator", "runner"), "m", "cartpole, beam"),
        (("--env.size", "l", "--curriculum.generator", "car", "--curriculum.sizes", "s", "1", "l", "1"), "s", "arm"),
    ],
)
def test_a_family_of_mechanisms_that_a_size_has_no_room_for(capsys, options, size, families):
    said = _refusal(capsys, *options)
    assert f"levels of size '{size}' have room for none; add one of " in said and families in said
    # Where they fit, whatever comes first on the command line.
    parse(["--recipe", "tiny", "--curriculum.generator", "runner", "--env.size", "l"])


def test_an_action_space_that_training_has_no_policy_for(capsys, monkeypatch):
    no_policy = type("NoPolicy", (MultiDiscrete,), {"distribution": None})
    monkeypatch.setattr(ACTION_SPACES, "_parts", {**ACTION_SPACES._parts, "mine": no_policy()})
    line = _refusal(capsys, "--recipe", "tiny", "--env.action_space", "mine")
    assert "env.action_space is 'mine'" in line and "use 'multi_discrete' or 'continuous' or 'discrete'" in line


def test_a_run_keeps_its_physics_when_the_preset_changes(tmp_path, monkeypatch):
    before = recipe("tiny")
    _a_run(tmp_path / "run").close()
    monkeypatch.setitem(PRESETS, "standard", preset("standard").replace(substeps=5))
    args = parse(["--run", str(tmp_path / "run"), "--resume"])
    assert args.config.env.physics.substeps == 4 and args.config.hash == before.hash
    changed = parse(["--run", str(tmp_path / "run"), "--resume", "--env.preset", "standard"]).config
    assert differences(changed, before) == ["env.physics.substeps 5 instead of 4"]


def test_the_pretrained_policy_learned_with_the_physics_that_is_played_with():
    description = json.loads((REPOSITORY / "pretrained" / "generalist" / "checkpoint.json").read_text())
    assert from_dict_for_playing(description["config"]).env.physics == preset("standard")


def test_physics_in_words():
    standard = preset("standard")
    assert describe(standard) == "standard"
    assert describe(preset("paper")) == "paper"
    assert describe(standard.replace(substeps=8)) == "standard with substeps 8"
    assert describe(preset("fine").replace(push_out_speed=3.0)) == "fine with push_out_speed 3.0"


# Devices


@pytest.mark.parametrize("options", ["--run.placement colocated", "--run.placement local --run.device cpu"])
def test_the_command_keeps_off_gpus_before_it_reads_levels(options, tmp_path):
    """Reading levels computes: JAX would start on a GPU and take three quarters of its memory from the workers."""
    code = (
        "import sys, jax\n"
        "from kinetix_dist.cli import main, train\n"
        "from kinetix_dist.errors import UserError\n"
        "def stop(config, is_new):\n"
        "    raise UserError(f'platforms {jax.config.jax_platforms}')\n"
        "train._check_inputs = stop\n"
        "sys.exit(main.main(sys.argv[1:]))"
    )
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    command = [sys.executable, "-c", code, "train", "--recipe", "tiny", *options.split()]
    environment |= {"PYTHONPATH": python_path()}
    done = subprocess.run(
        command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert done.returncode == 2 and "platforms cpu" in done.stderr, done.stderr
