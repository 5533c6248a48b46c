"""Files of studies: those of the package, and what is refused, in one line and with exit status 2."""

import dataclasses
import time

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import parse
from kinetix_dist.config.sections import LAST_SEED
from kinetix_dist.recipes import recipe
from kinetix_dist.study.library import STUDIES, study_names
from kinetix_dist.study.plan import SET_BY_STUDY, plan_of
from kinetix_dist.sweep.arms import make_run, train_arguments
from tests.study.studies import (
    OF_TRAINING,
    OWN_LENGTH,
    SMALL,
    TEXT,
    plan,
    read_training_study,
    trained,
    training_study,
    write,
)

TINY_STEPS = 128  # environment steps of an update of the recipe `tiny`


@pytest.fixture(autouse=True)
def _working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


def refusal(capsys, *arguments):
    """The one line on stderr; fails unless the exit status is 2."""
    assert main(["study", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


# Those of the package


def test_there_are_studies():
    assert {"curricula", "curricula_paper", "filter"} <= set(study_names())


@pytest.mark.parametrize("name", OF_TRAINING)
def test_a_study_of_the_package_can_be_planned_and_has_a_small_version(name):
    study = training_study(name)
    assert study.name == name and study.question.endswith("?") and study.paper.endswith(".")
    assert f"kinetix-dist study {name} --plan" in (STUDIES / f"{name}.toml").read_text()
    assert len(plan_of(study).runs) == study.seeds * len(study.arms)
    small = plan_of(study.as_small)
    assert all(run.config.run.device == "cpu" and run.config.run.placement == "local" for run in small.runs)
    assert study.small is not None
    assert {run.arm.name for run in small.runs} == set(study.small.arms or (arm.name for arm in study.arms))
    assert len({run.config.hash for run in small.runs}) == len(small.runs)


def test_the_hyperparameters_of_the_paper_are_those_of_the_recipes():
    runs = plan_of(training_study("curricula_paper"), seeds=1).runs
    for run in runs:
        named = recipe(f"{run.arm.name}_m")
        for section in ("env", "policy", "ppo", "curriculum", "rollout"):
            assert getattr(run.config, section) == getattr(named, section), (run.arm.name, section)


@pytest.mark.parametrize("name", OF_TRAINING)
def test_the_command_of_an_arm_gives_its_configuration(name, tmp_path):
    for study in (training_study(name), training_study(name).as_small):
        for run in plan_of(study, seeds=1).runs:
            assert parse(train_arguments(run, study.recipe, tmp_path)).config == run.config
            arm = run.arm.name
            assert run.config.run.total_env_steps == pytest.approx(study.env_steps_of(arm), rel=0.05)
            updates = run.config.run.total_env_steps / run.config.rollout.steps_per_update
            assert updates == study.num_points_of(arm) * run.config.evaluation.every
            assert run.config.evaluation.sets == study.sets_of(arm)


# What is refused


def test_an_unknown_study_or_arm(capsys, tmp_path):
    assert "unknown study 'filtre'; did you mean 'filter'?" in refusal(capsys, "filtre")
    assert "unknown study 'xyz'; studies are compute, curricula, " in refusal(capsys, "xyz")
    line = refusal(capsys, write(tmp_path), "--arms", "wider")
    assert "unknown arm 'wider' of study mine; did you mean 'wide'?" in line
    assert "arms are plain, wide" in refusal(capsys, write(tmp_path), "--arms", "xyz")


def test_a_file_that_is_none(capsys, tmp_path):
    assert "nowhere.toml cannot be read as a study (No such file or directory)" in refusal(capsys, "nowhere.toml")
    assert "cannot be read as a study (Invalid value" in refusal(capsys, write(tmp_path, "name = "))


@pytest.mark.parametrize(
    ("before", "after", "what"),
    [
        ('recipe = "tiny"', 'recipe = "tinny"', "unknown recipe 'tinny'; did you mean 'tiny'?"),
        ('reference = "plain"', 'reference = "plan"', "reference 'plan' is no arm; did you mean 'plain'?"),
        ('name = "wide"', 'name = "plain"', "two of them have the arm name 'plain'; change one"),
        (
            'name = "wide"',
            'name = "PLAIN"',
            "two of them have the arm name 'plain' or 'PLAIN', which",
        ),
        ("seeds = 2", "seeds = 1001", "seeds of the study is 1,001; give 1,000 or fewer"),
        ('"ppo.clip"', '"ppo.clp"', "unknown option 'ppo.clp' of arm wide; did you mean 'ppo.clip'?"),
        ("0.3}", '"much"}', "arm wide: config field ppo.clip is 'much'; float is needed"),
        ('["designed_s"]', '["designed_xs"]', "unknown level set 'designed_xs'; did you mean 'designed_s'?"),
        ('["designed_s"]', '["nowhere.json"]', "there is no level file or directory nowhere.json"),
        ('["designed_s"]', "[]", "sets are none; name one level set or more"),
        ('["designed_s"]', '["designed_s", "designed_s"]', "name one level set or more, each once"),
        ("env_steps = 256", "env_steps = 200", "env_steps is 200 and every_steps 128; give a multiple"),
        ("every_steps = 128", "every_steps = 0", "env_steps is 256 and every_steps 0"),
        ("env_steps = 256\nevery_steps = 128", "env_steps = 320\nevery_steps = 160", "plays 128 environment steps"),
        ("seeds = 2", "seeds = 0", "Study.seeds is 0; it must be 1 or more"),
        (
            'name = "wide"',
            'name = "wide"\nenv_steps = 200',
            "env_steps of arm wide is 200 and every_steps 128; give a multiple",
        ),
        ('name = "wide"', 'name = "wide"\nenv_steps = 0', "env_steps of arm wide is 0 and every_steps 128"),
        (
            'name = "wide"',
            'name = "wide"\nsets = ["random_s"]',
            "arm wide has set random_s, which is not one of the sets; add it to them",
        ),
        ("seeds = 2", "format = 2", "format is 2; this version reads format 1"),
        ("seeds = 2", "speed = 2", "config field speed is unknown"),
        ("steps_per_second = 64.0", "steps_per_second = 0.0", "Cost.steps_per_second is 0.0; it must be above 0"),
        ('name = "mine"', 'name = "../mine"', "study name '../mine' is none"),
        ('paper = "It does not say."', "", "config field paper is missing"),
        ("[cost]", '[figure]\nkind = "bars"\n[cost]', "Figure.kind is 'bars'; choose one of curves, levels"),
        ("[cost]", '[figure]\nsets = ["random_s"]\n[cost]', "figure.sets has random_s, which is not one of the sets"),
    ],
)
def test_studies_that_are_none(capsys, tmp_path, before, after, what):
    assert before in TEXT
    line = refusal(capsys, write(tmp_path, TEXT.replace(before, after)), "--plan")
    assert what in line
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("option", SET_BY_STUDY)
def test_what_the_study_sets_cannot_be_an_option(capsys, tmp_path, option):
    content = TEXT.replace('"ppo.clip" = 0.3', f'"{option}" = 1')
    line = refusal(capsys, write(tmp_path, content), "--plan")
    assert f"option {option} cannot be set in a study: {SET_BY_STUDY[option]}" in line


def test_a_section_that_makes_no_small_study(capsys, tmp_path):
    assert "study mine has no small version; add a section [small]" in refusal(capsys, write(tmp_path), "--small")
    unknown = SMALL.replace("[small]\n", '[small]\narms = ["wid"]\n')
    line = refusal(capsys, write(tmp_path, TEXT + unknown), "--plan")
    assert "small.arms has 'wid'; did you mean 'wide'?" in line
    wrong = SMALL.replace("every_steps = 128", "every_steps = 100")
    assert "small: env_steps is 128 and every_steps 100" in refusal(capsys, write(tmp_path, TEXT + wrong), "--plan")


def test_numbers_that_are_none(capsys, tmp_path):
    file = write(tmp_path)
    assert "--minutes is 0; give a number above 0" in refusal(capsys, file, "--minutes", "0")
    assert "--gpus is -1; give a number of 1 or more, or 0" in refusal(capsys, file, "--gpus", "-1")
    assert "999 slots are requested, but this process may use" in refusal(capsys, file, "--gpus", "999")
    assert "--seeds is 0; give 1 or more" in refusal(capsys, file, "--seeds", "0")
    assert "--plan and --draw are both given" in refusal(capsys, file, "--plan", "--draw")
    assert "study list` takes --out alone" in refusal(capsys, "list", "--seeds", "2")


def test_fewer_minutes_than_one_run_takes(capsys, tmp_path):
    for options in ([], ["--plan"]):
        line = refusal(capsys, write(tmp_path), "--minutes", "0.1", *options)
        assert "--minutes is 0.1, and one run takes 0.2 minutes; give --minutes 0.2 or more" in line
    assert not (tmp_path / "runs").exists()


def test_results_of_another_study_in_the_directory(capsys, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "design.json").write_text('{"hash": "0123456789abcdef"}')
    for options in ([], ["--plan"], ["--draw"]):
        line = refusal(capsys, write(tmp_path), "--out", out, *options)
        assert "holds results of another design (hash 0123456789abcdef, this one has" in line and "--out" in line


def test_nothing_to_draw(capsys, tmp_path):
    line = refusal(capsys, write(tmp_path), "--draw")
    assert "runs/studies/mine holds no results of study mine; train it first" in line


# What a plan is


def test_a_plan_says_what_it_costs_and_writes_nothing(capsys, tmp_path):
    assert main(["study", str(write(tmp_path)), "--plan"]) == 0
    said = capsys.readouterr().out
    # 4 runs of 6 s and 256 steps at 64 a second.
    assert "4 of 4 are left" in said and "0.7 minutes predicted" in said and "Is a wide clip better?" in said
    assert not (tmp_path / "runs").exists()


def test_the_first_seed_of_all_arms_comes_first(tmp_path):
    assert [run.name for run in plan(tmp_path).runs] == ["plain-seed1", "wide-seed1", "plain-seed2", "wide-seed2"]
    assert [run.name for run in plan(tmp_path, arms=["wide"], seeds=3).chosen] == [f"wide-seed{n}" for n in (1, 2, 3)]


def test_runs_that_are_there_are_part_of_the_study_whatever_is_chosen(tmp_path):
    planned = plan(tmp_path)
    trained(tmp_path / "out", planned.runs[3], [0.0, 0.5, 0.5])  # wide-seed2
    again = plan(tmp_path, seeds=1, path=tmp_path / "out")
    assert [run.name for run in again.chosen] == ["plain-seed1", "wide-seed1"]
    assert [run.seed for run in again.runs] == [1, 1, 2, 2]


def test_words_and_numbers_of_seeds_are_no_part_of_the_hash(tmp_path):
    before = plan(tmp_path).hash
    for old, new in (
        ("Is a", "Would a"),
        ("seeds = 2", "seeds = 3"),
        ("6.0", "60.0"),
        ('"plain"\n[cost', '"wide"\n[cost'),
    ):
        assert plan(tmp_path, TEXT.replace(old, new)).hash == before, old
    for old, new in (("0.3", "0.4"), ("env_steps = 256", "env_steps = 384"), ("designed_s", "quickstart_s")):
        assert plan(tmp_path, TEXT.replace(old, new)).hash != before, old


def test_an_arm_has_steps_and_sets_of_its_own(tmp_path):
    planned = plan(tmp_path, OWN_LENGTH, seeds=1)
    assert [run.config.run.total_env_steps for run in planned.runs] == [512, 256]
    assert [run.config.evaluation.sets for run in planned.runs] == [("designed_s", "quickstart_s"), ("designed_s",)]
    assert [planned.last_point(run) for run in planned.runs] == [4, 2]
    other = OWN_LENGTH.replace("env_steps = 256", "env_steps = 128")
    assert plan(tmp_path, other, seeds=1).hash != planned.hash


def test_results_from_before_arms_had_their_own_steps_go_on(tmp_path, monkeypatch):
    hashed = []
    monkeypatch.setattr("kinetix_dist.study.plan.short_hash", hashed.append)
    plan(tmp_path)
    assert hashed[0][0]["arms"] == [{"name": "plain", "options": {}}, {"name": "wide", "options": {"ppo.clip": 0.3}}]


def test_the_small_version_keeps_the_shares_and_sets_of_arms(tmp_path, capsys):
    small = SMALL.replace("env_steps = 128", "env_steps = 256").replace("quickstart_s", "designed_s")
    made = read_training_study(write(tmp_path, OWN_LENGTH + small)).as_small
    assert [made.env_steps_of(arm.name) for arm in made.arms] == [256, 128]
    assert [made.sets_of(arm.name) for arm in made.arms] == [("designed_s",)] * 2
    line = refusal(capsys, write(tmp_path, OWN_LENGTH + SMALL), "--plan")
    assert "small.sets has none of the sets of arm wide; add one, or leave it out of arms" in line
    short = small.replace("env_steps = 256", "env_steps = 128")
    line = refusal(capsys, write(tmp_path, OWN_LENGTH + short), "--plan")
    assert "small: env_steps of arm wide is 64 and every_steps 128; give a multiple" in line


def test_the_small_version_has_its_own_name_and_overrides_arms(tmp_path):
    small = read_training_study(write(tmp_path, TEXT + SMALL)).as_small
    assert (small.name, small.env_steps, small.seeds, small.sets) == ("mine_small", 128, 1, ("quickstart_s",))
    assert [run.config.ppo.clip for run in plan_of(small).runs] == [0.4, 0.4]
    assert dataclasses.replace(small).small is None


# Seeds


def test_more_seeds_than_a_plan_checks_are_refused_at_once(tmp_path, capsys):
    begun = time.monotonic()
    line = refusal(capsys, write(tmp_path), "--seeds", "1000000", "--plan")
    assert "--seeds is 1,000,000; give 1,000 or fewer" in line and time.monotonic() - begun < 30.0


def test_a_plan_checks_each_arm_once_and_not_each_seed(tmp_path, monkeypatch):
    made = []

    def counted(*given):
        made.append(given)
        return make_run(*given)

    monkeypatch.setattr("kinetix_dist.study.plan.make_run", counted)
    study = read_training_study(write(tmp_path))
    runs = plan_of(study, seeds=200).runs
    assert len(runs) == 200 * len(study.arms) and len(made) == 2 * len(study.arms)
    assert [run.name for run in runs[:3]] == ["plain-seed1", "wide-seed1", "plain-seed2"]


def test_runs_of_other_seeds_are_those_that_are_made_one_by_one(tmp_path):
    study = read_training_study(write(tmp_path))
    for run in plan_of(study, seeds=3).runs:
        forced = {name: value for name, value in run.options.items() if name not in run.arm.options}
        assert run == make_run(recipe(study.recipe), run.arm, run.seed, forced)


def test_a_seed_beyond_the_last_one_is_one_line(tmp_path, capsys):
    content = TEXT.replace("seeds = 2", f"seeds = 2\nfirst_seed = {LAST_SEED}")
    assert "RunConfig.seed is 4294967296" in refusal(capsys, write(tmp_path, content), "--plan")
