"""Small versions of all studies of the package, arm by arm, for real. Training goes on in this process: equal arms of
several studies share their programs. `test_study_driver.py` has the loop, tests/sweep/test_slots.py the processes."""

import csv
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.study.library import find_study
from kinetix_dist.study.plan import plan_of
from kinetix_dist.sweep import run_loop
from tests.study.studies import OF_COMMANDS, OF_TRAINING, training_study

pytestmark = pytest.mark.long
SLOW = "compute"  # a program for each number of worlds
ARMS = [
    pytest.param(name, arm.name, marks=[pytest.mark.slow] if name == SLOW else [])
    for name in OF_TRAINING
    for arm in training_study(name).as_small.arms
]


class _Ended:
    """Process that has ended."""

    pid = -1

    def __init__(self, returncode: int) -> None:
        self.returncode = returncode

    def poll(self) -> int:
        return self.returncode


@pytest.fixture(scope="module")
def directory(tmp_path_factory) -> Path:
    """Directory in which the studies are run."""
    return tmp_path_factory.mktemp("studies")


@pytest.fixture(autouse=True)
def _here(directory, monkeypatch):
    monkeypatch.chdir(directory)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)

    def start(words, slot, log):
        log.touch()
        return _Ended(main(words))

    monkeypatch.setattr(run_loop, "start_command", start)
    monkeypatch.setattr(run_loop, "POLL_S", 0.0)


@pytest.mark.parametrize(("study", "arm"), ARMS)
def test_an_arm_trains_and_is_evaluated(study, arm):
    assert main(["study", study, "--small", "--arms", arm]) == 0
    path = Path("runs/studies") / f"{study}_small"
    with (path / f"{study}_small.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["arm"] == arm]
    small = training_study(study).as_small
    points = {(row["set"], int(row["point"])) for row in rows}
    numbers = range(small.num_points_of(arm) + 1)
    assert points == {(name, number) for name in small.sets_of(arm) for number in numbers}


@pytest.mark.parametrize("study", OF_TRAINING)
def test_the_study_is_complete_then(study, capsys):
    path = Path("runs/studies") / f"{study}_small"
    plan = plan_of(training_study(study).as_small)
    if not all((path / "arms" / run.name).is_dir() for run in plan.runs):
        pytest.skip("its arms were not run")
    assert main(["study", study, "--small", "--draw"]) == 0
    said = capsys.readouterr().out
    assert f"{len(plan.runs)} of {len(plan.runs)} runs" in said and "did not finish" not in said
    assert (path / f"{study}_small.png").stat().st_size > 10_000


def test_the_learnability_of_chosen_levels_is_written_and_said():
    path = Path("runs/studies/curricula_small")
    if not (path / "curricula_small.csv").exists():
        pytest.skip("its arms were not run")
    with (path / "curricula_small_learnability.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["arm"] for row in rows} == {"sfl"}
    assert all(0 <= float(row["claimed"]) <= 0.25 and 0 <= float(row["learnable_share"]) <= 1 for row in rows)


@pytest.mark.parametrize("study", OF_COMMANDS)
def test_a_study_of_commands_runs_them_and_draws_what_they_wrote(study, capsys):
    assert main(["study", study, "--small"]) == 0
    said = capsys.readouterr().out
    small = find_study(study).as_small
    assert f"{len(small.arms)} of {len(small.arms)} runs" in said
    path = Path("runs/studies") / f"{study}_small"
    with (path / f"{study}_small.csv").open() as file:
        assert {row["arm"] for row in csv.DictReader(file)} == {arm.name for arm in small.arms}
    assert (path / f"{study}_small.png").stat().st_size > 5_000
