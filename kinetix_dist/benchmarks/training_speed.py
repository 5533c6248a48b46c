"""`bench train`: environment steps per second of a recipe, everything included, and where the time goes.

A short run through the same `train` as `kinetix-dist train`, in a temporary directory. The first two updates are not
measured. One record (`TrainingRecord`).
"""

from __future__ import annotations

import dataclasses
import statistics
from typing import Any, Literal

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.benchmarks.training_options import (
    NUM_WARM_UPDATES,
    TrainingOptions,
    shares_of_time,
    shortened,
    speeds,
)
from kinetix_dist.benchmarks.training_run import TrainingRun, check_placement, number_of_gpus, run_training
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import user_errors


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(TrainingOptions):
    """Environment steps per second of training, and where the time goes."""

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
    compile_seconds: float | None  # of the process that learns; None where it is not reported
    wall_seconds: float  # of the run, compiling included
    config_hash: str
    versions: dict[str, str]


def measure(options: Options, results: Results) -> None:
    """One record."""
    gpus = number_of_gpus(options.config().run.device)
    config = shortened(options.config(), options.updates)
    with user_errors(ValueError):
        check_placement(config, gpus)
    record = record_of(options, config, run_training(config), gpus)
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
