"""The loop of a sweep, around a stand-in for training; tests/sweep/test_sweep_command.py has the real one."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kinetix_dist.errors import UserError
from kinetix_dist.sweep import driver
from kinetix_dist.sweep.arms import runs_of
from kinetix_dist.sweep.driver import Sweep
from kinetix_dist.sweep.objective import read_curve
from kinetix_dist.sweep.results import draw
from kinetix_dist.sweep.results_directory import DESIGN, done_so_far
from kinetix_dist.sweep.run_loop import RunsFailedError, RunsStoppedError
from kinetix_dist.sweep.slots import Slot
from tests.sweep.designs import design, halving_text, text
from tests.sweep.stand_in_training import replace_training

SLOTS = [Slot(name="cpu 0"), Slot(name="cpu 1")]
STAND_IN = Path(__file__).with_name("stand_in.py")


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Training is a stand-in; a list of the arguments of all that were started, and the facts that they read."""
    facts = {"hashes": {}, "rates": {}, "fails": []}
    return replace_training(monkeypatch, tmp_path, STAND_IN, facts), facts


def sweep_of(tmp_path, facts, content, rates, name="results"):
    """rates: of each run, solved share after 100 s."""
    planned = design(tmp_path, content)
    runs = runs_of(planned)
    facts["hashes"] = {run.name: run.config.hash for run in runs}
    facts["rates"] = dict(zip((run.name for run in runs), rates, strict=True))
    return Sweep(planned, runs, tmp_path / name)


def train(sweep, must_stop=lambda: None):
    said = []
    try:
        sweep.train(SLOTS, report=said.append, must_stop=must_stop)
    finally:
        sweep.close()
    return said


def results(sweep):
    return json.loads((sweep.path / driver.RESULTS).read_text())


def test_every_arm_is_trained_once_until_its_second_and_then_stopped(tmp_path, started):
    commands, facts = started
    sweep = sweep_of(tmp_path, facts, text(), [0.5, 0.5, 1.0, 1.0])  # a1, a2: low rate; a3, a4: high
    train(sweep)
    assert len(commands) == 4 and {slot for slot, _ in commands} == {"cpu 0", "cpu 1"}
    done = done_so_far(sweep.path, sweep.runs)
    assert all(seconds >= 20 for seconds in done.values()), done
    found = results(sweep)
    assert found["state"] == "complete" and [run["state"] for run in found["runs"]] == ["done"] * 4
    # The curves are lines, from 0 to 0.1 or 0.2 at 20 s; their areas lie at half of that.
    assert [run["scores"][0]["area"] for run in found["runs"]] == pytest.approx([0.05, 0.05, 0.1, 0.1])
    effects = {effect["name"]: effect["value"] for effect in found["effects"]["area"]}
    assert effects == pytest.approx({"epochs": 0.0, "rate": 0.05})


def test_a_sweep_that_was_stopped_goes_on_and_repeats_nothing(tmp_path, started):
    commands, facts = started
    rates = [0.5, 0.5, 1.0, 1.0]
    facts["held"] = ["a3-seed0", "a4-seed0"]
    sweep = sweep_of(tmp_path, facts, text(seconds="seconds = 100"), rates)

    def half_way():
        seconds = done_so_far(sweep.path, sweep.runs)
        return "stopped by SIGTERM" if min(seconds["a3-seed0"], seconds["a4-seed0"]) > 10 else None

    with pytest.raises(RunsStoppedError, match=r"stopped by SIGTERM, with 2 of 4 runs to go"):
        train(sweep, half_way)
    assert [run["state"] for run in results(sweep)["runs"]] == ["done", "done", "part", "part"]
    assert results(sweep)["state"] == "incomplete" and results(sweep)["effects"] is None
    before = done_so_far(sweep.path, sweep.runs)
    commands.clear()
    again = sweep_of(tmp_path, facts, text(seconds="seconds = 100"), rates)
    train(again)
    assert [arguments[1:] for _, arguments in commands] == [
        [str(tmp_path / "results" / "arms" / name), "--resume"] for name in ("a3-seed0", "a4-seed0")
    ]
    assert results(again)["state"] == "complete"
    after = done_so_far(sweep.path, sweep.runs)
    assert after["a1-seed0"] == before["a1-seed0"] and after["a3-seed0"] >= 100


def test_in_successive_halving_the_best_go_on_from_where_they_were(tmp_path, started):
    commands, facts = started
    sweep = sweep_of(tmp_path, facts, halving_text(), [0.6, 0.2, 1.0, 0.4])  # plain, wide, narrow, slow
    train(sweep)
    resumed = [Path(arguments[1]).name for _, arguments in commands if "--resume" in arguments]
    assert sorted(resumed[:2]) == ["narrow-seed0", "plain-seed0"] and resumed[2:] == ["narrow-seed0"]
    seconds = done_so_far(sweep.path, sweep.runs)
    assert seconds["wide-seed0"] >= 20 and seconds["plain-seed0"] >= 40 and seconds["narrow-seed0"] >= 80
    best = [row["arm"] for row in results(sweep)["arms"] if row["until"] == 80]
    assert best == ["narrow"]


def test_an_arm_that_fails_stops_no_other_and_is_tried_again(tmp_path, started):
    commands, facts = started
    facts["fails"] = ["a2-seed0"]
    sweep = sweep_of(tmp_path, facts, text(), [0.5] * 4)
    with pytest.raises(RunsFailedError, match=r"a2-seed0 failed \(exit status 1: kinetix-dist: out of memory; see "):
        train(sweep)
    assert [run["state"] for run in results(sweep)["runs"]] == ["done", "waiting", "done", "done"]
    commands.clear()
    facts["fails"] = []
    train(sweep_of(tmp_path, facts, text(), [0.5] * 4))
    assert len(commands) == 1


def test_a_run_whose_evaluations_do_not_come_is_stopped(tmp_path, started, monkeypatch):
    monkeypatch.setattr(driver, "LATE_AFTER_S", 30.0)
    _, facts = started
    facts["unevaluated"] = ["a3-seed0"]
    sweep = sweep_of(tmp_path, facts, text(), [0.5] * 4)
    with pytest.raises(
        RunsFailedError, match=r"a3-seed0 failed \(no evaluation came within 30 s after second 20; raise"
    ):
        train(sweep)
    assert results(sweep)["state"] == "incomplete"


def test_a_run_of_another_configuration_is_no_result(tmp_path, started):
    _, facts = started
    sweep = sweep_of(tmp_path, facts, text(), [0.5] * 4)
    facts["hashes"]["a1-seed0"] = "0123456789abcdef"
    with pytest.raises(RunsFailedError, match="it was trained with another configuration"):
        train(sweep)


def test_a_fold_over_that_is_not_complete_leaves_the_effects_of_the_first_half(tmp_path, started):
    _, facts = started
    folded = text().replace("factors = [", "fold_over = true\nfold_over_seeds = [7]\nfactors = [")
    sweep = sweep_of(tmp_path, facts, folded, [0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5])
    assert [run.seed for run in sweep.runs] == [0] * 4 + [7] * 4

    def has_trained(run):
        return read_curve(sweep.directory(run), sweep.design.objective).reaches(20)

    with pytest.raises(RunsStoppedError):
        train(sweep, lambda: "late" if all(map(has_trained, sweep.runs[:4])) else None)
    effects = results(sweep)["effects"]
    assert (effects["of"], effects["is_whole"]) == ("4 arms", False)
    train(sweep_of(tmp_path, facts, folded, [0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5]))
    effects = results(sweep)["effects"]
    assert (effects["of"], effects["is_whole"]) == ("8 arms", True)
    assert {row["name"]: row["value"] for row in effects["area"]} == pytest.approx({"epochs": 0.0, "rate": 0.05})
    for number, found in enumerate((results(sweep), {**results(sweep), "effects": None})):
        picture = tmp_path / f"{number}.png"
        draw(found, picture)
        with Image.open(picture) as image:
            assert np.asarray(image.convert("L")).std() > 5  # something is drawn


def test_results_of_another_design_are_kept(tmp_path, started):
    _, facts = started
    sweep_of(tmp_path, facts, text(), [0.5] * 4).close()
    before = (tmp_path / "results" / DESIGN).read_bytes()
    with pytest.raises(
        UserError, match=r"holds results of another design \(hash .*; name another directory with --out"
    ):
        sweep_of(tmp_path, facts, text(seconds="seconds = 30"), [0.5] * 4)
    assert (tmp_path / "results" / DESIGN).read_bytes() == before
    sweep_of(tmp_path, facts, text().replace("start_seconds = 10", "start_seconds = 99"), [0.5] * 4).close()


def test_a_directory_in_use_or_of_a_run_is_refused(tmp_path, started):
    _, facts = started
    sweep = sweep_of(tmp_path, facts, text(), [0.5] * 4)
    with pytest.raises(UserError, match=r"is in use by process .* choose another --out"):
        sweep_of(tmp_path, facts, text(), [0.5] * 4)
    sweep.close()
    (tmp_path / "a_run").mkdir()
    (tmp_path / "a_run" / "config.json").write_text("{}")
    with pytest.raises(UserError, match="holds a run of `kinetix-dist train`"):
        sweep_of(tmp_path, facts, text(), [0.5] * 4, name="a_run")
