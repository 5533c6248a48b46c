"""Forgetting matrices: hand-worked numbers, what is written, and phases that give none."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kinetix_dist.study.driver import write_results
from kinetix_dist.study.forgetting import Trained, forgetting, measures, trained_runs
from kinetix_dist.study.plan import plan_of
from kinetix_dist.study.study_file import Study
from kinetix_dist.study.summary import summarise
from kinetix_dist.sweep.design import DesignError
from kinetix_dist.sweep.results_directory import directory_of
from tests.study.studies import read_training_study

SETS = ("designed_s", "designed_m")
LEVELS = 10  # in the evaluations that are made up
TEXT = """
name = "mine"
question = "What is forgotten?"
paper = "It does not say."
recipe = "tiny"
env_steps = 768
every_steps = 128
sets = ["designed_s", "designed_m"]
seeds = 2
reference = "at_once"
cost = {steps_per_second = 64.0}
figure = {kind = "forgetting", tasks = ["designed_s", "designed_m", "designed_s"]}
[[arms]]
name = "at_once"
[[arms]]
name = "in_turn"
[arms.options]
phases = [
    {start = 256, options = {"env.size" = "m"}},
    {start = 512, options = {"env.size" = "s"}},
]
"""
# Solve rates in tenths on S and M, at the seven evaluations of each run; those of "in_turn" by seed.
AT_ONCE = [(1, 0), (2, 2), (3, 3), (4, 4), (5, 5), (6, 6), (7, 6)]
IN_TURN = {
    1: [(1, 0), (4, 1), (6, 2), (5, 4), (3, 5), (5, 4), (7, 3)],
    2: [(1, 0), (4, 1), (8, 2), (5, 4), (3, 7), (5, 4), (7, 1)],
}


def _study(folder: Path, content: str = TEXT) -> Study:
    file = folder / "mine.toml"
    file.write_text(content)
    return read_training_study(file)


def _write_runs(path, plan, *, without=(), sets=None, ends=None):
    """Run directories with evaluations that are made up. without: (arm, number of an evaluation) that is missing; sets:
    of arms that have others, half solved beyond `SETS`; ends: last evaluations of arms that end earlier."""
    for run in plan.runs:
        directory = directory_of(path, run)
        (directory / "metrics").mkdir(parents=True)
        (directory / "config.json").write_text(json.dumps({"hash": run.config.hash}))
        lines = []
        own, end = (sets or {}).get(run.arm.name, SETS), (ends or {}).get(run.arm.name, 6)
        for number, tenths in enumerate((AT_ONCE if run.arm.name == "at_once" else IN_TURN[run.seed])[: end + 1]):
            if (run.arm.name, number) in without:
                continue
            rates = {
                name: {"names": list("abcdefghij"), "solved": [int(i < solved) for i in range(LEVELS)], "attempts": 1}
                for name, solved in zip(own, (*tenths, *[5] * (len(own) - 2)), strict=True)
            }
            phase = "before" if number == 0 else "after" if number == end else "training"
            lines.append({"phase": phase, "update": number, "env_steps": 128 * number, "sets": rates})
        (directory / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        row = {"update": 6, "progress/env_steps": 768, "progress/seconds": 9.0, "progress/warmup_seconds": 1.0}
        (directory / "metrics" / "metrics.jsonl").write_text(json.dumps(row) + "\n")


@pytest.fixture
def results(tmp_path):
    """(plan, directory) of complete runs."""
    plan = plan_of(_study(tmp_path))
    _write_runs(tmp_path / "out", plan)
    return plan, tmp_path / "out"


def test_a_matrix_has_a_row_before_training_and_after_each_phase(results):
    plan, path = results
    at_once, in_turn = forgetting(plan, trained_runs(plan, summarise(path, plan)))
    np.testing.assert_allclose(at_once.rates, [[0.1, 0.0], [0.7, 0.6]])
    np.testing.assert_allclose(in_turn.rates, [[0.1, 0.0], [0.7, 0.2], [0.3, 0.6], [0.7, 0.2]])  # means over two seeds
    assert (at_once.tasks, in_turn.tasks) == ((), ("designed_s", "designed_m", "designed_s"))


def test_the_numbers_of_the_field_worked_by_hand(results):
    """Seed 1: R = S 0.1, 0.6, 0.3, 0.7; M 0.0, 0.2, 0.5, 0.3. The last phase trains for S, so that M alone can be
    forgotten; M alone is learned after the first phase."""
    plan, path = results
    runs = trained_runs(plan, summarise(path, plan))
    found = {(each.run.arm.name, each.run.seed): measures(each, plan.study.figure.tasks) for each in runs}
    assert found["in_turn", 1] == pytest.approx(
        {"average rate": 0.5, "forgetting": 0.2, "backward transfer": -0.2, "forward transfer": 0.2}
    )
    assert found["in_turn", 2] == pytest.approx(
        {"average rate": 0.4, "forgetting": 0.6, "backward transfer": -0.6, "forward transfer": 0.2}
    )
    assert found["at_once", 1] == pytest.approx({"average rate": 0.65})


def test_with_a_set_for_each_phase_these_are_the_published_formulas(tmp_path):
    """Lopez-Paz & Ranzato 2017 and Chaudhry et al. 2018 on a random matrix of five tasks."""

    tasks, matrix = tuple("abcde"), np.random.default_rng(0).random((6, 5))

    class OfFive(Trained):
        def rates(self, sets):
            return matrix

    r, b, last = matrix[1:], matrix[0], 4
    found = measures(OfFive(run=plan_of(_study(tmp_path)).runs[0], tasks=tasks, points=()), tasks)
    assert found["average rate"] == pytest.approx(r[last].mean())
    assert found["backward transfer"] == pytest.approx(np.mean([r[last, i] - r[i, i] for i in range(4)]))
    assert found["forward transfer"] == pytest.approx(np.mean([r[i - 1, i] - b[i] for i in range(1, 5)]))
    assert found["forgetting"] == pytest.approx(np.mean([r[:last, j].max() - r[last, j] for j in range(4)]))


def test_what_is_written(results):
    plan, path = results
    files = {file.name: file for file in write_results(path, plan)}
    assert files.keys() == {"mine.csv", "mine.md", "mine_forgetting.csv", "mine_transfer.csv", "mine.png"}
    with files["mine_forgetting.csv"].open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 2 + 2 * 4 * 2
    (one,) = (
        row
        for row in rows
        if (row["arm"], row["seed"], row["after_phase"], row["set"]) == ("in_turn", "2", "2", "designed_m")
    )
    assert (one["trained_for"], one["solved"], one["attempts"]) == ("designed_m", "7", "10")
    with files["mine_transfer.csv"].open() as file:
        rows = {(row["arm"], row["seed"]): row for row in csv.DictReader(file)}
    assert rows["in_turn", "2"]["forgetting"] == "0.6000" and rows["in_turn", "2"]["backward_transfer"] == "-0.6000"
    assert rows["at_once", "1"]["average_rate"] == "0.6500" and rows["at_once", "1"]["forgetting"] == ""
    text = files["mine.md"].read_text()
    words = " ".join(text.split())
    assert "in_turn: 45.0 (40.0 to 50.0) % solved at the end; forgetting +40.0 (+20.0 to +60.0), backward" in words
    assert "at_once: 65.0 (no spread) % solved at the end; it has no phases." in words
    assert "| in_turn, % | designed_s | designed_m |" in text and "| 2: designed_m | 30.0 | 60.0 |" in text
    known = json.loads((path / "study.json").read_text())
    assert known["finding"].endswith("in_turn 45.0 (40.0 to 50.0) % at the end, +40.0 (+20.0 to +60.0) forgotten")
    with Image.open(files["mine.png"]) as image:
        assert np.asarray(image.convert("L")).std() > 5  # something is drawn


def test_a_run_without_the_evaluation_at_the_end_of_a_phase_has_no_matrix(tmp_path):
    plan = plan_of(_study(tmp_path))
    _write_runs(tmp_path / "out", plan, without={("in_turn", 4), ("at_once", 3)})
    summary = summarise(tmp_path / "out", plan)
    assert {each.run.arm.name for each in trained_runs(plan, summary)} == {"at_once"}
    assert "in_turn-seed1" in summary.gaps
    write_results(tmp_path / "out", plan)
    words = " ".join((tmp_path / "out" / "mine.md").read_text().split())
    assert "Evaluations during training are missing in" in words


def test_an_arm_may_have_steps_and_sets_of_its_own(tmp_path):
    """Of "at_once" the matrix ends at its own end; its third set, which is no task, is in the matrix of it alone."""
    text = TEXT.replace('sets = ["designed_s", "designed_m"]', 'sets = ["designed_s", "designed_m", "random_s"]', 1)
    text = text.replace('name = "in_turn"\n', 'name = "in_turn"\nsets = ["designed_m", "designed_s"]\n')
    plan = plan_of(_study(tmp_path, text.replace('name = "at_once"\n', 'name = "at_once"\nenv_steps = 384\n')))
    path = tmp_path / "out"
    _write_runs(path, plan, sets={"at_once": (*SETS, "random_s")}, ends={"at_once": 3})
    at_once, in_turn = forgetting(plan, trained_runs(plan, summarise(path, plan)))
    assert (at_once.sets, in_turn.sets) == (("designed_s", "designed_m", "random_s"), SETS)
    np.testing.assert_allclose(at_once.rates, [[0.1, 0.0, 0.5], [0.4, 0.4, 0.5]])
    assert in_turn.rates.shape == (4, 2) and at_once.measures["average rate"].value == pytest.approx(0.4)
    write_results(path, plan)
    lines = (path / "mine.md").read_text().splitlines()
    assert "| at_once, % | designed_s | designed_m | random_s |" in lines
    assert "| in_turn, % | designed_s | designed_m |" in lines
    rows = (path / "mine_forgetting.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 2 * 3 + 2 * 4 * 2 and "at_once,1,1,,random_s,5,10" in rows


def test_nothing_is_complete(tmp_path):
    plan = plan_of(_study(tmp_path))
    files = write_results(tmp_path, plan)
    assert len(files) == 5 and json.loads((tmp_path / "study.json").read_text())["finding"] == "not run yet"


@pytest.mark.parametrize(
    ("before", "after", "what"),
    [
        (
            ', tasks = ["designed_s", "designed_m", "designed_s"]',
            "",
            "figure.kind is 'forgetting' and figure.tasks none",
        ),
        ('kind = "forgetting"', 'kind = "curves"', "figure.kind is 'curves' and figure.tasks designed_s, designed_m"),
        ('tasks = ["designed_s", ', 'tasks = ["random_s", ', "figure.tasks has random_s, which is not one of the sets"),
        ('tasks = ["designed_s", ', "tasks = [", "arm in_turn has 3 phases, the one that it begins with included, and"),
        (
            "every_steps = 128",
            "every_steps = 384",
            "phase 1 begins after 2 updates, between two evaluations, which are 3",
        ),
        (
            "start = 512",
            "start = 1024",
            "arm in_turn: phase 2 begins after 1,024 environment steps, and the run ends at",
        ),
        (
            'name = "at_once"\n[[',
            'name = "at_once"\nsets = ["designed_s"]\n[[',
            "arm at_once is not evaluated on designed_m,",
        ),
        ('"env.size" = "m"', '"env.sise" = "m"', "arm in_turn: phase 1: unknown setting 'env.sise'; did you mean"),
    ],
)
def test_phases_that_give_no_matrix(tmp_path, before, after, what):
    assert before in TEXT
    with pytest.raises(DesignError, match=what):
        plan_of(_study(tmp_path, TEXT.replace(before, after)))


def test_phases_of_the_small_version_are_those_of_arms_that_have_any(tmp_path):
    small = """
[small]
recipe = "tiny"
env_steps = 256
every_steps = 128
sets = ["designed_s", "designed_m"]
tasks = ["designed_s", "designed_m"]
phases = [{start = 128, options = {"env.size" = "m"}}]
cost = {steps_per_second = 64.0}
"""
    plan = plan_of(_study(tmp_path, TEXT + small).as_small)
    assert [len(run.config.phases) for run in plan.runs] == [0, 1]
    assert plan.study.figure.tasks == ("designed_s", "designed_m")
