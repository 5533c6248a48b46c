"""Studies that several tests use, as text of the file, and run directories with evaluations that are made up."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.study.library import find_study, read_study, study_names
from kinetix_dist.study.plan import Plan, plan_of
from kinetix_dist.study.study_file import Study
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.results_directory import directory_of

# Studies of the package, by kind of their arms.
OF_TRAINING = [name for name in study_names() if isinstance(find_study(name), Study)]
OF_COMMANDS = [name for name in study_names() if name not in OF_TRAINING]
LEVELS = 20
TEXT = """
name = "mine"
question = "Is a wide clip better?"
paper = "It does not say."
recipe = "tiny"
env_steps = 256
every_steps = 128
sets = ["designed_s"]
seeds = 2
reference = "plain"
[cost]
steps_per_second = 64.0
start_seconds = 6.0
device = "a CPU"
[[arms]]
name = "plain"
[[arms]]
name = "wide"
options = {"ppo.clip" = 0.3}
"""
# `wide` is trained for half of the steps of `plain` and evaluated on one of its two sets.
OWN_LENGTH = (
    TEXT.replace("env_steps = 256", "env_steps = 512")
    .replace('sets = ["designed_s"]', 'sets = ["designed_s", "quickstart_s"]')
    .replace('name = "wide"', 'name = "wide"\nenv_steps = 256\nsets = ["designed_s"]')
)
SMALL = """
[small]
recipe = "tiny"
env_steps = 128
every_steps = 128
sets = ["quickstart_s"]
cost = {steps_per_second = 64.0}
options = {"ppo.clip" = 0.4}
"""


def write(path: Path, content: str = TEXT) -> Path:
    file = path / "mine.toml"
    file.write_text(content)
    return file


def training_study(name: str) -> Study:
    """Return the study of the package whose arms are trainings."""
    study = find_study(name)
    assert isinstance(study, Study)
    return study


def read_training_study(path: Path) -> Study:
    study = read_study(path)
    assert isinstance(study, Study)
    return study


def plan(folder: Path, content: str = TEXT, **choices: Any) -> Plan:
    """Plan of a study whose file is written into a folder; choices: of `plan_of`."""
    return plan_of(read_training_study(write(folder, content)), **choices)


def evaluation(phase: str, update: int, sets: Sequence[str], solved: list[int]) -> dict:
    """Evaluation with one attempt at each level; an update has 128 steps."""
    result = {"names": [str(index) for index in range(len(solved))], "solved": solved, "attempts": 1}
    return {"phase": phase, "update": update, "env_steps": 128 * update, "sets": dict.fromkeys(sets, result)}


def rated(rate: float) -> list[int]:
    """Levels solved once or not at all, so that their mean is the rate."""
    return [int(index < round(rate * LEVELS)) for index in range(LEVELS)]


def trained(path: Path, run: Run, rates: list[float], *, seconds_an_update: float = 1.0, update_at=lambda n: n) -> None:
    """Files of a run that was evaluated at these rates on all of its sets, the first before training."""
    directory = directory_of(path, run)
    (directory / "metrics").mkdir(parents=True)
    (directory / "config.json").write_text(json.dumps({"hash": run.config.hash}))
    lines, rows = [], []
    for number, rate in enumerate(rates):
        phase = "before" if number == 0 else "after" if number == len(rates) - 1 else "training"
        update = update_at(number)
        lines.append(evaluation(phase, update, run.config.evaluation.sets, rated(rate)))
        if number:
            seconds = 7.0 + seconds_an_update * update
            rows.append(
                {
                    "update": update,
                    "progress/env_steps": 128 * update,
                    "progress/seconds": seconds,
                    "progress/warmup_seconds": 7.0,
                }
            )
    (directory / "evaluations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (directory / "metrics" / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
