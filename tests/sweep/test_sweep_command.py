"""`kinetix-dist sweep`: what it refuses, in one line and with exit status 2; its plan; and one real sweep."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import parse
from kinetix_dist.cli.worker_slots import slots_for
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import PUBLIC_SOURCE
from kinetix_dist.sweep.arms import SET_BY_SWEEP, hash_of, runs_of, train_arguments
from kinetix_dist.sweep.design import read_design
from kinetix_dist.sweep.slots import cpu_slots, free_gpus
from tests.helpers import REPOSITORY
from tests.sweep.designs import ARMS, FACTORIAL, HALVING, design, halving_text, text, write

EXAMPLES = sorted((REPOSITORY / "examples" / "sweeps").glob("*.toml"))


@pytest.fixture(autouse=True)
def _working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


def refusal(capsys, tmp_path, content, *options):
    """The one line on stderr; fails unless the exit status is 2 and nothing was written."""
    file = write(tmp_path, content)
    before = sorted(tmp_path.iterdir())
    assert main(["sweep", str(file), *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert sorted(tmp_path.iterdir()) == before
    return lines[0]


# Level sets


def test_public_levels_cannot_be_an_objective(capsys, tmp_path):
    public = {"env_state": {}, "env_params": {}, "static_env_params": {}}
    (tmp_path / "public").mkdir()
    (tmp_path / "public" / "unicycle.json").write_text(json.dumps(public))
    for name in ("public", "public/unicycle.json"):
        line = refusal(capsys, tmp_path, text(sets=f'{{dev_designed_s = 1.0, "{name}" = 0.1}}'))
        assert "public levels cannot be an objective: public/unicycle.json is one" in line
        assert "choose of dev_random_s," in line


def test_nor_can_what_was_imported_from_one(capsys, tmp_path):
    document = json.loads((levels_root() / "s" / "kick.json").read_text())
    (tmp_path / "mine.json").write_text(json.dumps({**document, "source": PUBLIC_SOURCE}))
    assert load_level(tmp_path / "mine.json")[1].source == PUBLIC_SOURCE
    assert "public levels cannot be an objective" in refusal(capsys, tmp_path, text(sets='{"mine.json" = 1.0}'))


@pytest.mark.parametrize("name", ["random_s", "kinetix_s", "designed_s", "s/kick"])
def test_sets_that_results_are_reported_on_cannot(capsys, tmp_path, name):
    line = refusal(capsys, tmp_path, text(sets=f'{{"{name}" = 1.0}}'))
    assert f"{name} cannot be an objective: results are reported on it" in line


def test_own_level_files_can_be_an_objective(tmp_path):
    shutil.copy(levels_root() / "s" / "kick.json", tmp_path / "mine.json")
    planned = design(tmp_path, text(sets='{"mine.json" = 1.0}'))
    runs = runs_of(planned)
    assert len(runs) == 4
    # Another level is another objective: results of both are not compared.
    before = hash_of(planned, runs)
    assert hash_of(planned, runs) == before
    shutil.copy(levels_root() / "s" / "hop_home.json", tmp_path / "mine.json")
    assert hash_of(planned, runs) != before


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_numbers_of_a_design_are_finite(capsys, tmp_path, value):
    assert f"seconds is {value}; it must be a finite number" in refusal(
        capsys, tmp_path, text(seconds=f"seconds = {value}")
    )
    assert "finite" in refusal(capsys, tmp_path, text().replace("start_seconds = 10", f"start_seconds = {value}"))


@pytest.mark.parametrize(
    ("sets", "what"),
    [
        ("{dev_random_xs = 1.0}", "unknown level set 'dev_random_xs'"),
        ("{dev_random_m = 1.0}", "level set dev_random_m does not fit arms of env.size 's'"),
        ("{dev_designed_l = 1.0}", "level set dev_designed_l does not fit arms of env.size 's'"),
        ("{frontier_m = 1.0}", "level set frontier_m does not fit arms of env.size 's'"),
        ("{dev_designed_s = -1}", "gives dev_designed_s the weight -1; a number of 0 or more is needed"),
        ('{dev_designed_s = "much"}', "the weight 'much'; a number of 0 or more"),
        ("{dev_designed_s = 0.0, dev_random_s = 0.0}", "all weights of objective.sets are 0"),
        ("{}", "objective.sets is empty"),
    ],
)
def test_objectives_that_are_none(capsys, tmp_path, sets, what):
    assert what in refusal(capsys, tmp_path, text(sets=sets))


# Arms and options


ONE_ARM = '[[arms]]\nname = "a"\noptions = {{{}}}\n'


@pytest.mark.parametrize(
    ("body", "what"),
    [
        ("", "give either factorial or arms"),
        (FACTORIAL + ARMS, "give either factorial or arms"),
        (FACTORIAL.replace('name = "rate"', 'name = "epochs"'), "two of them have the factor name 'epochs'"),
        (
            FACTORIAL.replace("ppo.epochs", "ppo.epohcs"),
            "unknown option 'ppo.epohcs' of arm a1; did you mean 'ppo.epochs'?",
        ),
        (
            FACTORIAL.replace('{"ppo.epochs" = 2}', '{"ppo.clip" = 2}'),
            "factor epochs sets ppo.epochs at low and ppo.clip",
        ),
        (
            FACTORIAL.replace('{"ppo.epochs" = 2}', '{"ppo.epochs" = 1}'),
            "factor epochs has the same values at low and high",
        ),
        (FACTORIAL.replace("ppo.learning_rate", "ppo.epochs"), "factors epochs and rate both set ppo.epochs"),
        (FACTORIAL.replace("1e-3}", '"fast"}'), "arm a3: config field ppo.learning_rate is 'fast'; float is needed"),
        (FACTORIAL.replace('"ppo.epochs" = 2', "ppo.epochs = 2"), "write full names in quotes"),
        (FACTORIAL + "fold_over_seeds = [1]", "has fold_over_seeds but no fold_over"),
        (ARMS.replace('"wide"', '"plain"'), "two of them have the arm name 'plain'; change one"),
        (
            ARMS.replace('"wide"', '"Plain"'),
            "two of them have the arm name 'plain' or 'Plain', which",
        ),
        (ARMS.replace('"wide"', '"../wide"'), "arm name '../wide' is none; use letters, digits"),
        (ARMS + "speed = 3", "config field arms.speed is unknown; fields are name, options"),
        (ARMS + "[[arms]]", "config field arms.name is missing"),
        (ONE_ARM.format('"rollout.num_envs" = 17'), "num_envs 17 is not a multiple of num_groups 4"),
        (ONE_ARM.format('"ppo.anneal.start" = 100, "ppo.anneal.end" = 50'), "arm a: "),
        (ONE_ARM.format('"policy.network" = "flatt"'), "arm a: "),
        (
            ONE_ARM.format('"curriculum.name" = "fixed", "curriculum.levels" = "dev_designed_s"'),
            "arm a trains on dev_designed_s, which is part of the objective",
        ),
        (FACTORIAL + HALVING, "halving compares the arms of a list"),
        (ARMS + HALVING, "with halving its rungs say the seconds; leave out seconds"),
    ],
)
def test_arms_that_are_none(capsys, tmp_path, body, what):
    assert what in refusal(capsys, tmp_path, text(body))


@pytest.mark.parametrize("option", SET_BY_SWEEP)
def test_what_the_sweep_sets_cannot_be_an_option(capsys, tmp_path, option):
    line = refusal(capsys, tmp_path, text(ONE_ARM.format(f'"{option}" = 1')))
    assert f"option {option} cannot be set in a sweep: {SET_BY_SWEEP[option]}" in line


@pytest.mark.parametrize(
    ("rungs", "what"),
    [
        ("[{seconds = 20}]", "halving has 1 rungs; give 2 or more"),
        ("[{seconds = 40, keep = 0.5}, {seconds = 20}]", "seconds of rungs are 40, 20; each has to be above"),
        ("[{seconds = 20, keep = 1.0}, {seconds = 40}]", "has keep 1; give a share below 1, above 0"),
        ("[{seconds = 20, keep = 0.5}, {seconds = 40, keep = 0.5}]", "the last rung has keep 0.5"),
        ("[{seconds = 25, keep = 0.5}, {seconds = 40}]", "25 s, which is no multiple of objective.every_seconds 10"),
        ("3", "config field halving.rungs is 3; a list is needed"),
    ],
)
def test_rungs_that_are_none(capsys, tmp_path, rungs, what):
    content = text(f"[halving]\nrungs = {rungs}\n{ARMS}", seconds="")
    assert what in refusal(capsys, tmp_path, content)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (text().replace('recipe = "tiny"', 'recipe = "tinny"'), "unknown recipe 'tinny'; did you mean 'tiny'?"),
        (text(seconds="seconds = 0"), "arms train for 0 s, but the objective begins at second 0"),
        (text(from_second=20), "arms train for 20 s, but the objective begins at second 20"),
        (text(seconds="seconds = 25"), "25 s, which is no multiple of objective.every_seconds 10"),
        (text().replace("seeds = [0]", "seeds = [0, 0]"), "seeds are 0, 0; give different numbers"),
        (text().replace("seeds = [0]", "seeds = 0"), "config field seeds is 0; a list is needed"),
        (text().replace('name = "mine"', 'name = "mine"\nformat = 2'), "format is 2; this version reads format 1"),
        (text().replace('name = "mine"', 'name = "mine"\nspeed = 2'), "config field speed is unknown"),
        ("name = ", "cannot be read as a design (Invalid value"),
    ],
)
def test_designs_that_are_none(capsys, tmp_path, content, what):
    line = refusal(capsys, tmp_path, content)
    assert what in line and "design.toml" in line


def test_a_design_that_is_not_there(capsys):
    assert main(["sweep", "nowhere.toml"]) == 2
    assert "nowhere.toml cannot be read as a design (No such file or directory)" in capsys.readouterr().err


# Minutes and slots


def test_more_arms_than_fit_the_minutes(capsys, tmp_path):
    for options in ([], ["--plan"]):
        line = refusal(capsys, tmp_path, text(), "--minutes", "1", *options)
        assert "4 runs on 1 slot take 2 minutes, and 1 are given: 2 runs fit; or give --minutes 2 or more slots" in line
    assert "the rungs up to 20 s fit" in refusal(capsys, tmp_path, halving_text(), "--minutes", "2")
    assert "--minutes is 0; give a number above 0" in refusal(capsys, tmp_path, text(), "--minutes", "0")


def test_more_slots_than_there_are(capsys, tmp_path, monkeypatch):
    assert "999 slots are requested, but this process may use" in refusal(capsys, tmp_path, text(), "--slots", "999")
    gpu = text(ARMS.replace('name = "plain"', 'name = "plain"\noptions = {"run.device" = "gpu"}'))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert "some arms run on GPUs and some on CPUs" in refusal(capsys, tmp_path, gpu)
    gpu = text().replace("[objective]", '[options]\n"run.device" = "gpu"\n[objective]')
    assert "but no GPU is visible here" in refusal(capsys, tmp_path, gpu, "--slots", "2")


def test_fewer_free_gpus_than_asked(capsys, tmp_path, monkeypatch):
    gpu = text().replace("[objective]", '[options]\n"run.device" = "gpu"\n[objective]')
    (tmp_path / "bin").mkdir()
    answer = tmp_path / "bin" / "nvidia-smi"
    answer.write_text("#!/bin/sh\necho '0, GPU-a, 3'; echo '1, GPU-b, 70000'; echo '2, GPU-c, 512'\n")
    answer.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1,2")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    line = refusal(capsys, tmp_path, gpu, "--slots", "3")
    assert "3 GPUs are requested, but 2 of 3 are free, 1 in use or not there; lower --slots" in line
    slots = slots_for(runs_of(design(tmp_path, gpu)), 0, "--slots")
    assert [slot.environment["CUDA_VISIBLE_DEVICES"] for slot in slots] == ["0", "2"]


def test_free_gpus_are_named_as_the_environment_does():
    listing = "0, GPU-a, 3\n1, GPU-b, 70000\n"
    assert free_gpus(listing, None) == (["0"], ["1"])
    assert free_gpus(listing, ["GPU-b", "GPU-a"]) == (["GPU-a"], ["GPU-b"])
    assert free_gpus(listing, ["0", "9", "MIG-c"]) == (["0", "MIG-c"], ["9"])


def test_a_cluster_is_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    assert "RAY_ADDRESS is set, but arms run on this machine" in refusal(capsys, tmp_path, text())


def test_cores_are_shared_out(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1, 2, 5, 7})
    assert [slot.cores for slot in cpu_slots(0)] == [(0, 1, 2, 5, 7)]
    assert [slot.cores for slot in cpu_slots(2)] == [(0, 1, 2), (5, 7)]


# The plan, and what arms are trained with


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_can_be_planned(capsys, example):
    words = example.read_text().split("sweep examples/")[1].split("\n")[0].split()  # the command in its first lines
    assert main(["sweep", str(example), *words[1:], "--plan"]) == 0
    said = capsys.readouterr().out
    assert "not there now: arms are to run on GPUs" in said
    if example.stem == "screening":
        assert "resolution IV" in said and "16 runs" in said
        assert said.count("is aliased with no two-factor interaction") == 7


def test_a_plan_writes_nothing_and_names_aliases(capsys, tmp_path):
    body = FACTORIAL.rstrip("]\n") + (
        '\n    {name = "clip", generator = ["epochs", "rate"], low = {"ppo.clip" = 0.1}, high = {"ppo.clip" = 0.2}},\n]'
    )
    assert main(["sweep", str(write(tmp_path, text(body))), "--plan", "--minutes", "5"]) == 0
    said = capsys.readouterr().out
    assert "resolution III" in said and "clip is aliased with epochs x rate" in said
    assert "2.0 minutes predicted" in said and not (tmp_path / "runs").exists()


@pytest.mark.parametrize("example", [None, *EXAMPLES], ids=lambda path: path.stem if path else "tiny")
def test_the_command_of_an_arm_gives_its_configuration(tmp_path, example):
    planned = read_design(example) if example else design(tmp_path, text())
    runs = runs_of(planned)
    for run in (runs[0], runs[-1]):
        assert parse(train_arguments(run, planned.recipe, tmp_path)).config == run.config
        assert run.config.evaluation.sets == tuple(planned.objective.sets)
    assert len({run.config.hash for run in runs}) == len(runs)


def test_tables_reach_the_command_as_a_file(tmp_path):
    run = runs_of(design(tmp_path, text()))[0]
    tables = [{"start": 100, "options": {"ppo.clip": 0.1}}]
    run = dataclasses.replace(run, options={"phases": tables})
    words = train_arguments(run, "tiny", tmp_path)
    assert words[2] == "--phases" and json.loads(Path(words[3]).read_text()) == tables


@pytest.mark.parametrize("options", [{"curriculum.sizes": [["s", 0.5], ["m", 0.5]], "env.size": "m"}, {"phases": []}])
def test_lists_of_lists_and_of_nothing_reach_the_command(tmp_path, options):
    run = dataclasses.replace(runs_of(design(tmp_path, text()))[0], options=options)
    config = parse(train_arguments(run, "tiny", tmp_path)).config
    assert config.phases == ()
    assert config.curriculum.sizes == ((("s", 0.5), ("m", 0.5)) if "env.size" in options else ())


# For real


@pytest.mark.slow
def test_a_real_sweep_stopped_by_its_minutes_goes_on(tmp_path, capsys):
    content = text(ARMS.split('[[arms]]\nname = "narrow"')[0]).replace("start_seconds = 10", "start_seconds = 0")
    file = write(tmp_path, content.replace("every_seconds = 10", "every_seconds = 5"))
    out = tmp_path / "results"
    # What is predicted fits, and what it takes does not: programs are compiled first.
    assert main(["sweep", str(file), "--out", str(out), "--minutes", "0.7"]) in (0, 75)
    assert main(["sweep", str(file), "--out", str(out)]) == 0
    found = json.loads((out / "sweep.json").read_text())
    assert found["state"] == "complete" and [run["state"] for run in found["runs"]] == ["done", "done"]
    for run in found["runs"]:
        seconds = run["curve"]["seconds"]
        assert seconds[0] == 0.0 and seconds[-1] >= 20 and len(seconds) >= 3
    assert (out / "sweep.png").stat().st_size > 10_000
    assert "Arms, mean over seeds" in capsys.readouterr().out
