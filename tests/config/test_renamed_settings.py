"""Old spellings of settings: refused where a person writes them, translated where a configuration was stored."""

import copy
import json

import numpy as np
import pytest

from kinetix_dist import renamed_settings
from kinetix_dist.benchmarks.training_options import with_fields
from kinetix_dist.checkpoint import save_checkpoint
from kinetix_dist.cli.main import main
from kinetix_dist.config import (
    ConfigError,
    curriculum_from_dict,
    flat,
    from_dict,
    from_dict_for_playing,
    has_same_numbers,
    to_dict,
)
from kinetix_dist.config.phases import read_phases
from kinetix_dist.recipes import RECIPES, recipe
from kinetix_dist.renamed_settings import (
    MOVED_VALUES,
    PHASE_NAMES,
    REMOVED,
    REMOVED_VALUES,
    RENAMED,
    RENAMED_RECIPES,
    RENAMED_VALUES,
    Removed,
    RenamedSettingError,
    refuse_old_options,
    translated,
)
from kinetix_dist.runtime.driver.checkpoints import newest_checkpoint
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.sweep.arms import runs_of
from kinetix_dist.sweep.design import ArmOptions, Design, DesignError, Objective
from tests.helpers import REPOSITORY
from tests.runtime.runs import QuietReporter

HASH_OF_PHASES, HASH_OF_PRETRAIN_ALL = "7b1e2d848873ada8", "2bda1323cac94881"  # with joint_correction
PATHS = {"ppo.clip_range": "ppo.clip", "annealing": "ppo.anneal"}


@pytest.fixture
def tables(monkeypatch):
    """Tables of their own for a test: `PATHS`, a renamed value, a removed field."""
    monkeypatch.setattr(renamed_settings, "RENAMED", PATHS)
    monkeypatch.setattr(renamed_settings, "RENAMED_VALUES", {("run.device", "cuda"): "gpu"})
    monkeypatch.setattr(renamed_settings, "MOVED_VALUES", {("ppo.epochs", 0): ("ppo.minibatches", 2)})
    monkeypatch.setattr(renamed_settings, "REMOVED", {"env.haste": Removed(why="it gained nothing", off=(0,))})
    monkeypatch.setattr(
        renamed_settings, "REMOVED_VALUES", {("curriculum.name", "luck"): ("sfl", "plain SFL is as good")}
    )


def _old(config, **env):
    """The same as a version before the renames of `tables` stored it."""
    data = copy.deepcopy(to_dict(config))
    data["ppo"]["clip_range"] = data["ppo"].pop("clip")
    data["annealing"] = data["ppo"].pop("anneal")
    data["env"] |= env
    data["phases"] = [{"start": 1024, "options": {"ppo.clip_range": 0.1}}]
    return data


def _todays():
    return from_dict(to_dict(recipe("tiny")) | {"phases": [{"start": 1024, "options": {"ppo.clip": 0.1}}]})


def test_every_new_name_exists_and_no_old_one_does():
    known = flat(to_dict(recipe("tiny")))
    assert set(PHASE_NAMES.values()) <= known.keys()
    sections = {".".join(name.split(".")[:length]) for name in known for length in range(1, 4)}
    assert set(RENAMED.values()) <= sections
    assert not {*RENAMED, *REMOVED} & sections
    assert {path for path, _ in [*RENAMED_VALUES, *REMOVED_VALUES, *MOVED_VALUES, *MOVED_VALUES.values()]} <= sections
    assert set(RENAMED_RECIPES.values()) <= set(RECIPES) and not set(RENAMED_RECIPES) & set(RECIPES)


def test_a_stored_config_is_translated(tables):
    assert from_dict(_old(recipe("tiny"), haste=0)) == _todays()


def test_a_stored_config_of_today_stays_as_it_is():
    for name in RECIPES:
        assert translated(to_dict(recipe(name))) == to_dict(recipe(name))


def test_phases_of_before_they_had_options_are_read_and_keep_their_hash():
    data = to_dict(recipe("tiny"))
    data["phases"] = [
        {"start": 100, **dict.fromkeys(PHASE_NAMES), "clip": 0.1, "epochs": 1},
        {"start": 384, **dict.fromkeys(PHASE_NAMES), "num_envs": 32, "sizes": [["s", 1.0]]},
    ]
    config = from_dict(data)
    assert [phase.options for phase in config.phases] == [
        {"ppo.epochs": 1, "ppo.clip": 0.1},
        {"rollout.num_envs": 32, "curriculum.sizes": [["s", 1.0]]},
    ]
    assert config.hash == HASH_OF_PHASES and from_dict(to_dict(config)) == config
    assert recipe("pretrain_all").hash == HASH_OF_PRETRAIN_ALL


def test_a_removed_setting_that_was_in_use_is_refused_for_training_and_left_out_for_playing(tables):
    data = _old(recipe("tiny"), haste=3)
    with pytest.raises(ConfigError, match=r"env.haste is 3, but this setting is gone: it gained nothing"):
        from_dict(data)
    played = from_dict_for_playing(data)
    assert (played.env, played.policy) == (_todays().env, _todays().policy)
    data = to_dict(recipe("tiny"))
    data["curriculum"]["name"] = "luck"
    with pytest.raises(ConfigError, match=r"curriculum.name is 'luck', which is gone: plain SFL is as good; start a"):
        from_dict(data)
    assert curriculum_from_dict(data).name == "sfl"


def test_a_run_of_before_a_rename_is_resumed(tables, tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    description = {"config": _old(recipe("tiny"), haste=0), "config_hash": "of the old names", "training_seconds": 1.0}
    save_checkpoint(run.checkpoints, 2, {"a": np.zeros(1)}, description, keep=1)
    config = _todays()
    found = newest_checkpoint(run, config, QuietReporter())
    assert found is not None and found.path.name == "00000002"
    run.close()
    description["config"]["ppo"]["clip_range"] = 0.7
    assert not has_same_numbers(config, description["config"], "of the old names")
    del description["config"]["ppo"]["clip_range"]  # of a version without the setting: another program
    assert not has_same_numbers(config, description["config"], "of the old names")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ("--ppo.clip_range 0.1", "ppo.clip_range is now called ppo.clip; use that"),
        ("--ppo.clip-range=0.1", "ppo.clip_range is now called ppo.clip; use that"),
        ("--annealing.end 5", "annealing.end is now called ppo.anneal.end; use that"),
        ("--phases.0.options.ppo.clip_range 0.1", "ppo.clip_range is now called ppo.clip; use that"),
        ("--phases.0.num_envs 32", "phases.num_envs is now called phases.options.rollout.num_envs; use that"),
        ("--run.device cuda", "run.device 'cuda' is now called 'gpu'; use that"),
        ("--env.haste 3", "env.haste is gone: it gained nothing; leave it out"),
        ("--curriculum.name luck", "curriculum.name 'luck' is gone: plain SFL is as good; use 'sfl'"),
    ],
)
def test_old_options_are_refused_by_a_line_with_the_new_name(tables, capsys, options, line):
    for command in ("train", "finetune"):
        assert main([command, "--recipe", "tiny", *options.split()]) == 2
        assert capsys.readouterr().err == f"kinetix-dist: {line}\n"


def test_old_names_in_files_of_a_person_are_refused(tables, tmp_path):
    phases = tmp_path / "phases.toml"
    phases.write_text("[[phases]]\nstart = 5\noptions = {'ppo.clip_range' = 0.1}\n")
    with pytest.raises(ValueError, match=r"phase 1: ppo.clip_range is now called ppo.clip"):
        read_phases(phases)
    design = Design(
        name="x",
        recipe="tiny",
        seconds=9.0,
        objective=Objective(sets={"s/hop_home": 1.0}, every_seconds=3.0),
        arms=(ArmOptions(name="a", options={"ppo.clip_range": 0.1}),),
    )
    with pytest.raises(DesignError, match=r"arm a: ppo.clip_range is now called ppo.clip"):
        runs_of(design)
    with pytest.raises(RenamedSettingError, match=r"ppo.epochs 0 is now called ppo.minibatches 2; use that"):
        refuse_old_options({"ppo.epochs": 0})
    with pytest.raises(RenamedSettingError, match=r"ppo.clip_range is now called ppo.clip"):
        with_fields(recipe("tiny"), ("ppo.clip_range=1",))


def test_entries_of_lists_are_values(tables):
    with pytest.raises(RenamedSettingError, match=r"run.device 'cuda'"):
        refuse_old_options({"run.device": ["cpu", "cuda"]})


def test_a_renamed_recipe(tables, monkeypatch):
    monkeypatch.setitem(RENAMED_RECIPES, "small", "tiny")
    with pytest.raises(ConfigError, match=r"recipe 'small' is now called 'tiny'"):
        recipe("small")


def test_the_pretrained_policy_is_read():
    description = json.loads((REPOSITORY / "pretrained" / "generalist" / "checkpoint.json").read_text())
    assert from_dict_for_playing(description["config"]).env.size == description["config"]["env"]["size"]


def test_what_was_learned_by_kernels_can_be_played_anywhere():
    data = to_dict(recipe("pretrain_m"))
    for kernels in ("mosaic", "fused"):  # at first, and now
        data["policy"]["kernels"] = kernels
        assert from_dict(data).policy.kernels == "fused"
        assert from_dict_for_playing(data).policy == recipe("pretrain_m").policy  # which has "auto"
    data["policy"]["network"] = "transformer_lean"  # has no kernels; at 2dc4c27 it was trained with this setting
    assert from_dict_for_playing(data).policy.kernels == "auto"
