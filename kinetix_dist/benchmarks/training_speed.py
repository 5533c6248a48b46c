"""`bench train`: environment steps per second of a recipe, everything included, and time by role.

A short run through the same `train` as `kinetix-dist train`, in a temporary directory, that does nothing but update
(`run.only_updates`). The first two updates are not measured. It prints a line after each update. One record
(`TrainingRecord`).
"""

from __future__ import annotations

import dataclasses
import statistics
from typing import Any, Literal

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.benchmarks.training_options import (
    NUM_WARM_UPDATES,
    TrainingOptions,
    seconds_before,
    shares_of_time,
    shortened,
    speeds,
)
from kinetix_dist.benchmarks.training_run import (
    RunFailedError,
    TrainingRun,
    UpdateLines,
    check_placement,
    number_of_gpus,
    run_training,
)
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import user_errors


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(TrainingOptions):
    """Environment steps per second of training, and time by role."""

    updates: int = 8
    """Updates of the run; those after the first two are measured."""
    placement: Literal["local", "colocated", "split"] | None = None
    """Default: as the recipe says."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_updates(self.updates)

    def config(self) -> TrainConfig:
        config = super().config()
        if self.placement is None:
            return config
        return dataclasses.replace(config, run=dataclasses.replace(config.run, placement=self.placement))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingRecord:
    """One run."""

    benchmark: str = "train"
    recipe: str
    overrides: tuple[str, ...]  # fields that --set changed
    size: str
    placement: str
    platform: str  # "cpu" or "gpu"
    device: str  # its model
    devices: int  # that learn
    gpus: int  # that the run had, for all roles
    worlds: int
    env_steps_per_update: int
    updates: int  # measured
    env_steps_per_second: float  # median over these
    slowest: float
    fastest: float
    share_of_time: dict[str, float]  # by role
    compile_seconds: float | None  # of the process that learns; None if it is not reported
    first_update_seconds: float  # of training until the first update was done: it compiles
    unmeasured_seconds: float  # between the first update and the measured ones
    wall_seconds: float  # of the run, compiling included
    config_hash: str
    versions: dict[str, str]


def measure(options: Options, results: Results) -> None:
    """Add one record, or a failure."""
    gpus = number_of_gpus(options.config().run.device)
    config = shortened(options.config(), options.updates)
    with user_errors(ValueError):
        check_placement(config, gpus)
    where = "GPU" if gpus else "CPU"
    results.report(f"  starting {options.recipe} {config.env.size.upper()}, {config.run.placement}, on the {where}")
    progress = UpdateLines(results.report, num_updates=options.updates, num_warm=NUM_WARM_UPDATES)
    try:
        run = run_training(config, progress)
    except RunFailedError as error:
        results.fail(f"{options.recipe}: {error}")
        return
    record = record_of(options, config, run, gpus)
    results.add(dataclasses.asdict(record))
    results.report(row(record))


def check_updates(updates: int) -> None:
    if updates <= NUM_WARM_UPDATES:
        raise ValueError(
            f"--updates is {updates}; give {NUM_WARM_UPDATES + 1} or more, since the first {NUM_WARM_UPDATES} are not "
            "measured"
        )


def record_of(options: TrainingOptions, config: TrainConfig, run: TrainingRun, gpus: int) -> TrainingRecord:
    """The record of a run of `config`."""
    report: dict[str, Any] = run.report
    found = speeds(run.rows)
    return TrainingRecord(
        recipe=options.recipe,
        overrides=options.set,
        size=config.env.size,
        placement=config.run.placement,
        platform=report["device"]["platform"],
        device=report["device"]["kind"],
        devices=report["device"]["count"],
        gpus=gpus,
        worlds=config.rollout.num_envs,
        env_steps_per_update=config.rollout.steps_per_update,
        updates=len(found),
        env_steps_per_second=round(statistics.median(found), 1),
        slowest=round(min(found), 1),
        fastest=round(max(found), 1),
        share_of_time=shares_of_time(run.rows),
        compile_seconds=report.get("compile_seconds"),
        first_update_seconds=round(run.rows[0]["progress/seconds"], 3),
        unmeasured_seconds=round(seconds_before(run.rows), 3),
        wall_seconds=report["wall_seconds"],
        config_hash=report["config_hash"],
        versions=report["versions"],
    )


def row(record: TrainingRecord) -> str:
    """One line for a person."""
    roles = sorted(record.share_of_time.items(), key=lambda item: -item[1])
    shares = ", ".join(f"{role} {share:.0%}" for role, share in roles if share >= 0.005)
    return (
        f"  {record.recipe} {record.size.upper()} {record.placement:<9} {record.devices} x {record.device}, "
        f"{record.worlds} worlds {record.env_steps_per_second:>12,.0f} env steps/s "
        f"({record.slowest:,.0f}-{record.fastest:,.0f}, {record.updates} updates; {shares})"
    )
