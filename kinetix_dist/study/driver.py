"""Training of a study in one directory, and its results there.

    runs/studies/NAME/   design.json, arms/RUN/ (run directories), logs/RUN.log
                         NAME.csv, NAME.md, NAME.png, study.json and what the figure adds, written again after each run

It holds no state that is not in the run directories: a run is done when it was evaluated at its last step, which is
also how the same command goes on where another one stopped.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.errors import user_errors
from kinetix_dist.studio.runs.run_files import RunFileError
from kinetix_dist.study.cost import seconds_left, trained_minutes
from kinetix_dist.study.directory import RESULTS, StudyDirectory
from kinetix_dist.study.forgetting import forgetting, trained_runs
from kinetix_dist.study.picture import draw
from kinetix_dist.study.plan import Plan
from kinetix_dist.study.records import is_complete, read_records
from kinetix_dist.study.report import finding, forgetting_finding, markdown, state
from kinetix_dist.study.study_file import FORGETTING, LEARNABILITY, LEVELS
from kinetix_dist.study.summary import summarise
from kinetix_dist.study.tables import forgetting_csv, learnability_csv, levels_csv, points_csv, transfer_csv
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.results_directory import write_json
from kinetix_dist.sweep.training_work import TrainingWork, seconds_to_stop


class TrainingStudyDirectory(StudyDirectory[Plan]):
    """Study whose arms are trained, in a directory."""

    def seconds_left(self) -> dict[str, float]:
        return seconds_left(self.path, self.plan)

    def seconds_to_stop(self) -> float:
        return seconds_to_stop(self.plan.chosen)

    def write(self) -> list[Path]:
        return write_results(self.path, self.plan)

    def _work_and_goal(self) -> tuple[TrainingWork, _CompleteGoal]:
        return TrainingWork(self.path, self.plan.study.recipe), _CompleteGoal(self.path, self.plan)


def write_results(path: Path, plan: Plan) -> list[Path]:
    """Writes NAME.csv, NAME.md, NAME.png and study.json; returns the files, study.json aside. Raises UserError."""
    study = plan.study
    with user_errors(RunFileError, prefix=f"{path}: "):
        summary = summarise(path, plan)
        minutes = trained_minutes(path, plan.runs)
    runs = trained_runs(plan, summary) if study.figure.kind == FORGETTING else []
    results = forgetting(plan, runs)
    texts = {
        f"{study.name}.csv": points_csv(summary.records),
        f"{study.name}.md": markdown(plan, summary, results, minutes),
    }
    if study.figure.kind == LEVELS:
        texts[f"{study.name}_levels.csv"] = levels_csv(summary.records, study.num_points)
    if study.figure.kind == LEARNABILITY:
        texts[f"{study.name}_learnability.csv"] = learnability_csv(summary.refreshes)
    if study.figure.kind == FORGETTING:
        texts[f"{study.name}_forgetting.csv"] = forgetting_csv(runs)
        texts[f"{study.name}_transfer.csv"] = transfer_csv(runs, study.figure.tasks)
    picture = path / f"{study.name}.png"
    with user_errors(OSError, prefix=f"{path}: results cannot be written: "):
        for name, text in texts.items():
            replace_file(path / name, text.encode())
        draw(study, summary, results, picture)
    shown = forgetting_finding(results) if study.figure.kind == FORGETTING else finding(plan, summary)
    known = {"state": state(plan, summary), "finding": shown, "minutes": round(minutes, 1)}
    write_json(path / RESULTS, {"name": study.name, "hash": plan.hash, **known})
    return [*(path / name for name in texts), picture]


@dataclasses.dataclass(frozen=True)
class _CompleteGoal:
    """Evaluations of all sets at the last step. Runs end by themselves."""

    path: Path
    plan: Plan

    def is_reached(self, run: Run) -> bool:
        return is_complete(self.path, self.plan, run)

    def must_end(self, run: Run) -> bool:
        del run
        return False

    def why_out_of_reach(self, run: Run) -> str:
        return f"{run.name} was stopped before its end"

    def result(self, run: Run) -> str:
        last = self.plan.last_point(run)
        records = read_records(self.path, self.plan, run)
        return ", ".join(f"{name} {record.points[last].rate:.1%}" for name, record in records.items())
