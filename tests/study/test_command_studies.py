"""Studies of commands: their file, their runs in worker slots, what they leave, and one line for what cannot be."""

import json
import subprocess
import sys

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.errors import UserError
from kinetix_dist.study.command_file import CommandStudy, words_of
from kinetix_dist.study.command_plan import CommandStudyDirectory, command_plan_of
from kinetix_dist.study.command_results import RESULTS, Written
from kinetix_dist.study.library import find_study, read_study
from kinetix_dist.sweep import run_loop
from kinetix_dist.sweep.design import DesignError
from kinetix_dist.sweep.run_loop import RunsFailedError
from kinetix_dist.sweep.slots import Slot
from tests.study.studies import OF_COMMANDS

SLOTS = [Slot(name="cpu 0"), Slot(name="cpu 1")]
TEXT = """
name = "mine"
question = "Is a wide body steered better?"
paper = "It does not say."
command = ["bench", "goals", "--checkpoint", "{policy}", "{more}", "--seed", "{seed}", "--json", "{out}/records.json"]
results = "goal_following"
seeds = 2
[values]
more = ["--levels", 8]
[cost]
minutes = 2.0
[[arms]]
name = "good"
values = {policy = "generalist"}
[[arms]]
name = "bad"
values = {policy = "random_only"}
"""
# Writes what `bench goals` would; a policy named "broken" fails.
PROGRAM = """
import json, sys
words = sys.argv[1:]
value = lambda flag: words[words.index(flag) + 1]
if value("--checkpoint") == "broken":
    sys.exit("kinetix-dist: broken is no checkpoint")
r = {"generalist": 0.9, "random_only": 0.2}[value("--checkpoint")]
row = {"morphology": "car", "size": "m", "levels": 8, "low": r - 0.1, "high": r + 0.1, "distance_m": 1.0}
row["counts"] = [[1] * 20] * 20
records = [row | {"actions": "policy", "correlation": r}, row | {"actions": "random", "correlation": 0.05}]
open(value("--json"), "w").write(json.dumps(records))
"""


def plan(folder, content=TEXT, **choices):
    file = folder / "mine.toml"
    file.write_text(content)
    study = read_study(file)
    assert isinstance(study, CommandStudy)
    return command_plan_of(study, **choices)


@pytest.fixture
def started(monkeypatch):
    """Words of all commands that were started, each by a stand-in."""
    commands = []

    def start(words, slot, log):
        commands.append((slot.name, words))
        command = [sys.executable, "-S", "-c", PROGRAM, *words]
        return subprocess.Popen(command, stdout=log.open("ab"), stderr=subprocess.STDOUT, start_new_session=True)

    monkeypatch.setattr(run_loop, "start_command", start)
    monkeypatch.setattr(run_loop, "POLL_S", 0.02)
    return commands


def run(planned, path):
    directory = CommandStudyDirectory(planned, path)
    with directory.taken():
        try:
            directory.train(SLOTS, report=lambda line: None, must_stop=lambda: None)
        finally:
            directory.write()


def test_values_stand_in_braces_and_a_list_for_as_many_words(tmp_path):
    (first, *_) = plan(tmp_path).runs
    expected = "bench goals --checkpoint generalist --levels 8 --seed 0 --json {out}/records.json"
    assert " ".join(first.command) == expected and first.name == "good-seed0"
    assert words_of(["{a}", "{a}x", "b"], {"a": []}) == ["[]x", "b"]


def test_parts_are_runs_of_their_own(tmp_path):
    content = TEXT.replace("seeds = 2", "parts = 3").replace('"{more}"', '"{part}/{parts}"')
    runs = plan(tmp_path, content).runs
    assert [one.name for one in runs[:3]] == ["good-seed0-part0", "good-seed0-part1", "good-seed0-part2"]
    assert [one.command[4] for one in runs] == ["0/3", "1/3", "2/3"] * 2


def test_all_commands_run_once_and_results_are_written(tmp_path, started):
    planned, path = plan(tmp_path), tmp_path / "out"
    assert list(CommandStudyDirectory(planned, path).seconds_left().values()) == [120.0] * 4
    run(planned, path)
    assert sorted(words[3] for _, words in started) == ["generalist"] * 2 + ["random_only"] * 2
    assert {slot for slot, _ in started} == {"cpu 0", "cpu 1"}
    text = " ".join((path / "mine.md").read_text().split())
    assert "good: car 0.90 (0.80 to 1.00), car 0.90" in text and "4 of 4 runs" in text and "Not done" not in text
    lines = (path / "mine.csv").read_text().splitlines()
    assert len(lines) == 1 + 4 * 2 and lines[0].startswith("arm,seed,morphology") and "counts" not in lines[0]
    known = json.loads((path / "study.json").read_text())
    assert known["finding"].startswith("correlation of body and goal: good car 0.90")
    started.clear()
    run(planned, path)
    assert not started and not CommandStudyDirectory(planned, path).seconds_left()


def test_a_command_that_fails_is_named_and_tried_again(tmp_path, started):
    planned, path = plan(tmp_path, TEXT.replace("random_only", "broken"), seeds=1), tmp_path / "out"
    with pytest.raises(RunsFailedError, match=r"bad-seed0 failed .exit status 1: kinetix-dist: broken is no"):
        run(planned, path)
    assert "Not done: bad-seed0." in (path / "mine.md").read_text()
    started.clear()
    with pytest.raises(RunsFailedError):
        run(planned, path)
    assert [words[3] for _, words in started] == ["broken"]


def test_fewer_seeds_leave_no_results_out(tmp_path, started):
    path = tmp_path / "out"
    run(plan(tmp_path), path)
    written = (path / "mine.csv").read_text()
    planned = plan(tmp_path, seeds=1, path=path)
    assert [one.name for one in planned.chosen] == ["good-seed0", "bad-seed0"] and len(planned.runs) == 4
    assert planned.hash == plan(tmp_path).hash
    run(planned, path)
    assert (path / "mine.csv").read_text() == written and "4 of 4 runs" in (path / "mine.md").read_text()


def test_another_command_is_another_design(tmp_path, started):
    run(plan(tmp_path, seeds=1), tmp_path / "out")
    run(plan(tmp_path), tmp_path / "out")  # more seeds are not
    assert len(started) == 4
    with pytest.raises(UserError, match="holds results of another design"):
        run(plan(tmp_path, TEXT.replace("8]", "9]")), tmp_path / "out")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("{policy}", "{polcy}", "command has {polcy}, which has no value; did you mean 'policy'?"),
        ('"goal_following"', '"goals"', "unknown results 'goals'"),
        ("seeds = 2", "seeds = 0", "seeds is 0"),
        ("minutes = 2.0", "minutes = 0", "minutes is 0"),
        ('name = "bad"', 'name = "good"', "two of them have the arm name 'good'"),
        ('name = "bad"', 'name = "Good"', "two of them have the arm name 'good' or 'Good'"),
    ],
)
def test_a_file_that_is_wrong_gets_one_line(tmp_path, old, new, line):
    with pytest.raises(DesignError) as error:
        plan(tmp_path, TEXT.replace(old, new))
    assert line in str(error.value) and "mine.toml" in str(error.value) and "\n" not in str(error.value)


def test_an_unknown_arm_and_no_small_version(tmp_path, capsys):
    file = tmp_path / "mine.toml"
    file.write_text(TEXT)
    assert main(["study", str(file), "--arms", "goood"]) == 2
    assert "unknown arm 'goood' of study mine; did you mean 'good'?" in capsys.readouterr().err
    assert main(["study", str(file), "--small"]) == 2
    assert "study mine has no small version" in capsys.readouterr().err


@pytest.mark.parametrize("name", OF_COMMANDS)
def test_a_study_of_the_package_can_be_planned_on_gpus_that_are_not_there(name, capsys, monkeypatch):
    study = find_study(name)
    assert isinstance(study, CommandStudy)
    assert study.name == name and study.question.endswith("?") and study.paper.endswith(".")
    assert study.as_small.arms
    assert main(["study", name, "--plan", *(["--gpus", "4"] if study.needs_gpu else [])]) == 0
    said = capsys.readouterr().out
    assert f"{len(study.arms) * study.seeds * study.parts} of " in said and study.question in said


def specialist(level, rate, steps_to_90):
    points = [(0, 0.0), (100, rate / 2), (200, rate)]
    curve = [{"updates": i, "env_steps": n, "solved": round(10 * r), "attempts": 10} for i, (n, r) in enumerate(points)]
    return {
        "level": level,
        "start": "s",
        "label": "s",
        "from": None,
        "env_steps_to": {"0.5": None, "0.9": steps_to_90},
        "final": {"rate": rate, "low": 0.0, "high": 1.0, "attempts": 10},
        "env_steps": 200,
        "seconds": {"training": 1.0, "evaluation": 1.0, "compile": 1.0},
        "curve": curve,
    }


def test_specialists_are_compared_level_by_level(tmp_path):
    written = []
    for arm, rates in {"pretrained": (1.0, 0.9, 0.8), "scratch": (0.9, 0.9, 0.0)}.items():
        for part in (0, 1):
            directory = tmp_path / f"{arm}{part}"
            (directory / "specialists" / "s").mkdir(parents=True)
            names = ["a", "b", "c"]
            (directory / "specialists" / "design.json").write_text(json.dumps({"levels": dict.fromkeys(names, "x")}))
            for index in range(part, 3, 2):
                steps = (100 if arm == "pretrained" else 400) if rates[index] >= 0.9 else None
                content = json.dumps(specialist(names[index], rates[index], steps))
                (directory / "specialists" / "s" / f"{names[index]}.json").write_text(content)
            written.append(Written(arm=arm, seed=0, directory=directory))
    kind = RESULTS["specialists"]
    rows = kind.rows(written)
    assert len(rows) == 6
    text = " ".join(kind.sentences(rows))
    assert "pretrained: 3 levels, solved 90.0 %" in text and "3 by 50% or more and 2 by 90% or more" in text
    assert "scratch needs 4.0 times the environment steps of pretrained (median of 2 specialists" in text
    assert kind.finding(rows).endswith("pretrained 3 of 3, scratch 2 of 3")
    kind.draw("Why?", rows, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 5_000
    (tmp_path / "scratch0" / "specialists" / "s" / "a.json").write_text("{")
    with pytest.raises(ValueError, match=r"a\.json"):
        kind.rows(written)
