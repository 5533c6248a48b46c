"""A study from its first run to its results, around a stand-in for training."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kinetix_dist.cli.main import main
from kinetix_dist.errors import UserError
from kinetix_dist.study.cost import seconds_left
from kinetix_dist.study.driver import TrainingStudyDirectory, write_results
from kinetix_dist.sweep.run_loop import RunsFailedError, RunsStoppedError
from kinetix_dist.sweep.slots import Slot
from tests.study.studies import OWN_LENGTH, TEXT, plan, trained, write
from tests.sweep.stand_in_training import replace_training

SLOTS = [Slot(name="cpu 0"), Slot(name="cpu 1")]
STAND_IN = Path(__file__).with_name("stand_in.py")
RATES = {"plain-seed1": 0.2, "wide-seed1": 0.5, "plain-seed2": 0.4, "wide-seed2": 0.7}


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Training is a stand-in; a list of the arguments of all that were started, and the facts that they read."""
    monkeypatch.chdir(tmp_path)
    facts = {"hashes": {}, "rates": RATES | {"plain-seed3": 0.3}, "fails": [], "held": []}
    return replace_training(monkeypatch, tmp_path, STAND_IN, facts), facts


def train(tmp_path, facts, must_stop=lambda: None, content=TEXT, **choices):
    path = tmp_path / "out"
    planned = plan(tmp_path, content, path=path, **choices)
    facts["hashes"] = {run.name: run.config.hash for run in planned.runs}
    directory = TrainingStudyDirectory(planned, path)
    with directory.taken():
        try:
            directory.train(SLOTS, report=lambda line: None, must_stop=must_stop)
        finally:
            directory.write()
    return planned


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_all_arms_are_trained_and_results_written(tmp_path, started):
    commands, facts = started
    train(tmp_path, facts)
    assert sorted(Path(arguments[1]).name for _, arguments in commands) == sorted(RATES)
    found = rows(tmp_path / "out" / "mine.csv")
    assert len(found) == 4 * 3  # runs, points
    last = {(row["arm"], row["seed"]): row for row in found if row["point"] == "2"}
    assert last["wide", "2"]["solved"] == "14" and last["wide", "2"]["attempts"] == "20"
    assert last["wide", "2"]["env_steps"] == "256" and last["wide", "2"]["set"] == "designed_s"
    text = (tmp_path / "out" / "mine.md").read_text()
    assert "plain 30.0 (20.0 to 40.0), wide 60.0 (50.0 to 70.0)" in " ".join(text.split())
    assert "wide less plain: +30.0 (+10.0 to +50.0)" in " ".join(text.split())
    assert "4 of 4 runs" in text and "did not finish" not in text
    known = json.loads((tmp_path / "out" / "study.json").read_text())
    assert known["state"] == "4 of 4 runs" and known["minutes"] == pytest.approx(4 * 11 / 60, abs=0.1)
    assert known["finding"].startswith("designed_s, points less plain: wide +30.0")
    with Image.open(tmp_path / "out" / "mine.png") as image:
        assert np.asarray(image.convert("L")).std() > 5  # something is drawn


def test_a_study_that_was_stopped_goes_on_and_names_what_is_missing(tmp_path, started):
    commands, facts = started
    facts["held"] = ["plain-seed2", "wide-seed2"]

    def is_held():
        texts = [tmp_path / "out" / "arms" / name / "metrics" / "metrics.jsonl" for name in facts["held"]]
        return "stopped by SIGTERM" if all(text.exists() and text.read_text() for text in texts) else None

    with pytest.raises(RunsStoppedError, match="stopped by SIGTERM, with 2 of 4 runs to go"):
        train(tmp_path, facts, is_held)
    text = " ".join((tmp_path / "out" / "mine.md").read_text().split())
    assert "plain-seed2 did not finish: it has 128 of 256 steps." in text and "2 of 4 runs" in text
    # With one seed each, intervals are over the levels of the set.
    assert "wide less plain: +30.0 (+8.0 to +52.0) points" in text and "say nothing of seeds" in text
    commands.clear()
    train(tmp_path, facts)
    assert sorted((Path(arguments[1]).name, arguments[2]) for _, arguments in commands) == [
        ("plain-seed2", "--resume"),
        ("wide-seed2", "--resume"),
    ]
    assert "4 of 4 runs" in (tmp_path / "out" / "mine.md").read_text()


def test_a_run_that_fails_stops_no_other_and_is_named(tmp_path, started):
    _, facts = started
    facts["fails"] = ["wide-seed1"]
    with pytest.raises(RunsFailedError, match=r"wide-seed1 failed \(exit status 1: kinetix-dist: out of memory; see"):
        train(tmp_path, facts)
    text = " ".join((tmp_path / "out" / "mine.md").read_text().split())
    assert "3 of 4 runs" in text and "wide was not begun with seed 1." in text
    facts["fails"] = []
    train(tmp_path, facts)
    assert "4 of 4 runs" in (tmp_path / "out" / "mine.md").read_text()


def test_seeds_and_arms_can_be_added_in_the_same_directory(tmp_path, started):
    commands, facts = started
    train(tmp_path, facts, seeds=1, arms=["plain"])
    assert len(commands) == 1
    text = " ".join((tmp_path / "out" / "mine.md").read_text().split())
    assert "wide was not begun with seed 1." in text
    train(tmp_path, facts)
    assert len(commands) == 4
    train(tmp_path, facts, seeds=3, arms=["plain"])
    assert len(commands) == 5
    text = " ".join((tmp_path / "out" / "mine.md").read_text().split())
    assert "plain 30.0" in text and "5 of 6 runs" in text and "wide was not begun with seed 3." in text


def test_another_study_is_refused_and_the_directory_kept(tmp_path, started):
    _, facts = started
    train(tmp_path, facts, seeds=1)
    with pytest.raises(
        UserError, match=r"holds results of another design \(hash .*; name another directory with --out"
    ):
        train(tmp_path, facts, content=TEXT.replace("0.3", "0.4"))
    assert len(rows(tmp_path / "out" / "mine.csv")) == 2 * 3


def test_the_command_trains_reports_and_draws_again(tmp_path, started, capsys):
    commands, facts = started
    facts["hashes"] = {run.name: run.config.hash for run in plan(tmp_path).runs}
    file = str(write(tmp_path))
    assert main(["study", file, "--gpus", "1", "--minutes", "5"]) == 0
    said = capsys.readouterr().out
    assert "4 runs, 0.7 minutes predicted" in said and "wide less plain: +30.0" in said
    before = {each: (tmp_path / "runs/studies/mine" / each).read_text() for each in ("mine.csv", "mine.md")}
    for name in before:
        (tmp_path / "runs/studies/mine" / name).unlink()
    assert main(["study", file, "--draw"]) == 0
    assert {each: (tmp_path / "runs/studies/mine" / each).read_text() for each in before} == before
    assert main(["study", file]) == 0 and len(commands) == 4  # nothing is left
    facts["fails"] = ["plain-seed3"]
    assert main(["study", file, "--seeds", "3", "--arms", "plain"]) == 1
    assert "plain-seed3 failed (exit status 1" in capsys.readouterr().err


def test_minutes_are_predicted_by_the_speed_of_the_arm(tmp_path):
    planned, path = plan(tmp_path), tmp_path / "out"
    assert seconds_left(path, planned) == dict.fromkeys(RATES, 6 + 256 / 64)
    trained(path, planned.runs[0], [0.0, 0.1, 0.2], seconds_an_update=2.0)  # 64 steps a second, complete
    trained(path, planned.runs[1], [0.0, 0.1], seconds_an_update=4.0)  # 32 a second, half of it
    assert seconds_left(path, planned) == {"wide-seed1": 6 + 4, "plain-seed2": 6 + 4, "wide-seed2": 6 + 8}


def test_a_study_of_levels_has_a_row_per_level_and_a_panel_per_arm(tmp_path):
    planned, path = plan(tmp_path, TEXT.replace("[cost]", '[figure]\nkind = "levels"\n[cost]')), tmp_path / "out"
    for run in planned.runs[:2]:
        trained(path, run, [0.0, 0.5, RATES[run.name]])
    files = write_results(path, planned)
    assert [file.name for file in files] == ["mine.csv", "mine.md", "mine_levels.csv", "mine.png"]
    found = rows(path / "mine_levels.csv")
    assert len(found) == 2 * 20 and sum(int(row["solved_at_point_2"]) for row in found if row["arm"] == "wide") == 10
    with Image.open(path / "mine.png") as image:
        assert image.height > 2.5 * image.width / 2  # three panels, one below the other


def test_arms_of_their_own_length_and_sets(tmp_path):
    content = OWN_LENGTH.replace("[cost]", '[figure]\nkind = "levels"\n[cost]')
    planned, path = plan(tmp_path, content, seeds=1), tmp_path / "out"
    plain, wide = planned.runs
    assert seconds_left(path, planned) == {"plain-seed1": 6 + 512 / 64, "wide-seed1": 6 + 256 / 64}
    trained(path, wide, [0.0, 0.3, 0.5])
    trained(path, plain, [0.0, 0.1, 0.2])
    write_results(path, planned)
    text = " ".join((path / "mine.md").read_text().split())
    assert "1 of 2 runs" in text and "plain-seed1 did not finish: it has 256 of 512 steps." in text
    shutil.rmtree(path / "arms" / plain.name)
    trained(path, plain, [0.0, 0.1, 0.2, 0.3, 0.4])
    write_results(path, planned)
    text = " ".join((path / "mine.md").read_text().split())
    assert "Solved of designed_s, %: plain (512 steps) 40.0" in text and "wide (256 steps) 50.0" in text
    assert "Solved of quickstart_s, %: plain (512 steps) 40.0" in text and text.count("wide less plain") == 1
    # At the end of each; over training at the steps of both: the mean of 30 and 50 less that of 10 and 20.
    assert "wide less plain: +10.0" in text and "+25.0" in text.split("at the end, ")[1]
    assert "Arms are trained for different steps" in text and "2 of 2 runs" in text and "missing" not in text
    assert len(rows(path / "mine.csv")) == 2 * 5 + 3
    (first, *_) = [row for row in rows(path / "mine_levels.csv") if row["arm"] == "wide"]
    assert first["solved_at_point_2"] == "1" and first["solved_at_point_4"] == ""
    with Image.open(path / "mine.png") as image:
        assert np.asarray(image.convert("L")).std() > 5


def test_a_reference_that_lacks_a_set_has_no_differences_there(tmp_path):
    planned = plan(tmp_path, OWN_LENGTH.replace('reference = "plain"', 'reference = "wide"'), seeds=1)
    path = tmp_path / "out"
    for run in planned.runs:
        trained(path, run, [0.0, *[0.5] * planned.last_point(run)])
    write_results(path, planned)
    text = " ".join((path / "mine.md").read_text().split())
    assert text.count("plain less wide") == 1 and "Solved of quickstart_s, %: plain (512 steps) 50.0" in text


def test_evaluations_that_are_missing_are_named(tmp_path):
    planned, path = plan(tmp_path, seeds=1), tmp_path / "out"
    trained(path, planned.runs[0], [0.0, 0.1, 0.2])
    trained(path, planned.runs[1], [0.0, 0.3], update_at=lambda number: 2 * number)
    write_results(path, planned)
    text = " ".join((path / "mine.md").read_text().split())
    assert "Evaluations during training are missing in wide-seed1." in text


def test_runs_are_named_where_none_is_complete(tmp_path):
    planned, path = plan(tmp_path, seeds=1), tmp_path / "out"
    trained(path, planned.runs[0], [0.0, 0.1])
    write_results(path, planned)
    text = " ".join((path / "mine.md").read_text().split())
    assert "No run is complete. plain-seed1 did not finish: it has 128 of 256 steps. wide was not begun" in text
    assert "0 of 2 runs" in text


def test_list_names_all_studies_and_what_is_known(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["study", "list"]) == 0
    said = capsys.readouterr().out
    assert "filter" in said and "curricula" in said and "not run yet" in said and "not run here" in said
    results = tmp_path / "runs" / "studies" / "filter"
    results.mkdir(parents=True)
    known = {"state": "2 of 6 runs", "finding": "found something", "minutes": 12.5}
    (results / "study.json").write_text(json.dumps(known))
    assert main(["study", "list"]) == 0
    said = capsys.readouterr().out
    assert "found" in said and "12.5" in said and "2 of 6 runs" in said
    (results / "study.json").write_text("{")
    assert main(["study", "list"]) == 2
    assert "study.json is damaged" in capsys.readouterr().err
