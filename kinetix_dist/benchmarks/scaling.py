"""`bench scaling`: environment steps per second of a recipe over numbers of devices, for each placement.

    for each repeat: for each placement: for each number of devices: one short run in a process of its own

A process sees as many GPUs as it is to use (CUDA_VISIBLE_DEVICES); on a CPU a device is a worker, a rollout actor or,
in placement `local`, a virtual device of JAX. Runs are interleaved, so that a busy moment of the machine falls on
all. What cannot be divided is left out, and its record says why.

`strong` divides the recipe's worlds and minibatches over the devices; `weak` multiplies its worlds by their number.
Efficiency is speed per device, relative to the first number of devices of the first placement that was measured.
One record (`ScalingRecord`) a point.
"""

from __future__ import annotations

import dataclasses
import statistics
from typing import Any, Literal

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.benchmarks.training_options import TrainingOptions, shares_of_time, shortened, speeds
from kinetix_dist.benchmarks.training_run import (
    RunFailedError,
    TrainingRun,
    check_placement,
    environment_of,
    number_of_gpus,
    run_in_process,
)
from kinetix_dist.benchmarks.training_speed import check_updates
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import one_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(TrainingOptions):
    """Environment steps per second of training, over numbers of devices and placements."""

    devices: tuple[int, ...] = (1, 2)
    """Numbers of GPUs, or of workers on a CPU."""
    placements: tuple[Literal["local", "colocated", "split"], ...] = ("local", "colocated")
    """Placements. In split one device learns and the others play."""
    mode: Literal["strong", "weak"] = "strong"
    """strong: the same worlds for all; weak: as many worlds a device for all."""
    updates: int = 8
    """Updates of a run; those after the first two are measured."""
    repeats: int = 1
    """Runs of each point; the record has their median."""
    run_seconds: float = 1800.0
    """A run that takes longer is ended and counts as failed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_updates(self.updates)
        if not self.devices or min(self.devices) < 1:
            raise ValueError(f"--devices has {list(self.devices)}; give numbers of devices, each 1 or more")
        if not self.placements:
            raise ValueError("--placements is empty; give one or more, such as --placements local")
        if self.repeats < 1:
            raise ValueError(f"--repeats is {self.repeats}; give 1 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScalingRecord:
    """One placement with one number of devices. What was not measured is None, and `left_out` says why."""

    benchmark: str = "scaling"
    recipe: str
    overrides: tuple[str, ...]
    size: str
    mode: str
    placement: str
    devices: int  # given to the run
    platform: str  # "cpu" or "gpu"
    device: str | None = None  # its model
    worlds: int
    runs: int = 0
    env_steps_per_second: float | None = None  # median over runs of the median over updates
    slowest: float | None = None  # run
    fastest: float | None = None
    efficiency: float | None = None  # speed a device, relative to the first point
    share_of_time: dict[str, float] | None = None  # of the last run
    versions: dict[str, str] | None = None
    left_out: str | None = None


@dataclasses.dataclass
class _Point:
    placement: str
    devices: int
    config: TrainConfig | None = None
    left_out: str | None = None
    runs: list[TrainingRun] = dataclasses.field(default_factory=list)

    @property
    def speeds(self) -> list[float]:
        return [statistics.median(speeds(run.rows)) for run in self.runs]


def measure(options: Options, results: Results) -> None:
    """A record for every point; all are written again after every run."""
    num_gpus = number_of_gpus(options.config().run.device)
    points = [
        _point(options, placement, count, num_gpus) for placement in options.placements for count in options.devices
    ]
    platform = "gpu" if num_gpus else "cpu"
    for repeat in range(options.repeats):
        for point in points:
            if point.config is None or point.left_out is not None:
                continue
            where = f"{point.placement}, {point.devices} device{'s' if point.devices > 1 else ''}"
            environment = environment_of(point.placement, point.devices, on_gpu=num_gpus > 0)
            try:
                point.runs.append(run_in_process(point.config, environment, timeout_seconds=options.run_seconds))
                speed = f"{point.speeds[-1]:,.0f} env steps/s"
                results.report(f"  {where}: {speed} (run {repeat + 1} of {options.repeats})")
            except RunFailedError as error:
                results.fail(f"{where}: {error}")
                point.left_out = f"failed: {error}"
            results.replace(map(dataclasses.asdict, _records(options, points, platform)))
    records = _records(options, points, platform)
    results.replace(map(dataclasses.asdict, records))
    for record in records:
        results.report(_row(record))


def config_of(options: Options, placement: str, devices: int) -> TrainConfig:
    """The configuration of one point; raises ValueError where there are too few devices or too many."""
    config = shortened(options.config(), options.updates)
    if options.mode == "weak":
        rollout = dataclasses.replace(config.rollout, num_envs=config.rollout.num_envs * devices)
        config = shortened(dataclasses.replace(config, rollout=rollout), options.updates)
    if placement == "split":
        if devices < 2:
            raise ValueError("split needs 2 devices or more: one learns, the others play")
        run = dataclasses.replace(config.run, placement=placement, num_rollout_actors=devices - 1)
        return dataclasses.replace(config, run=run)
    if devices > config.num_blocks:
        raise ValueError(f"{devices} devices cannot share {config.num_blocks} blocks of worlds: some would have none")
    num_workers = devices if placement == "colocated" else 0
    run = dataclasses.replace(config.run, placement=placement, num_workers=num_workers)
    return dataclasses.replace(config, run=run)


def _point(options: Options, placement: str, devices: int, num_gpus: int) -> _Point:
    if num_gpus and devices > num_gpus:
        return _Point(placement, devices, left_out=f"there are {num_gpus} GPUs")
    try:
        config = config_of(options, placement, devices)
        check_placement(config, min(devices, num_gpus))
    except ValueError as error:
        return _Point(placement, devices, left_out=one_line(error))
    return _Point(placement, devices, config)


def _records(options: Options, points: list[_Point], platform: str) -> list[ScalingRecord]:
    first = next((point for point in points if point.runs), None)
    recipe = options.config()
    records = []
    for point in points:
        measured: dict[str, Any] = {}
        if point.runs and first is not None:
            speed = statistics.median(point.speeds)
            of_first = statistics.median(first.speeds) / first.devices
            measured = {
                "device": point.runs[-1].report["device"]["kind"],
                "runs": len(point.runs),
                "env_steps_per_second": round(speed, 1),
                "slowest": round(min(point.speeds), 1),
                "fastest": round(max(point.speeds), 1),
                "efficiency": round(speed / point.devices / of_first, 4),
                "share_of_time": shares_of_time(point.runs[-1].rows),
                "versions": point.runs[-1].report["versions"],
            }
        config = point.config or recipe
        records.append(
            ScalingRecord(
                recipe=options.recipe,
                overrides=options.set,
                size=config.env.size,
                mode=options.mode,
                placement=point.placement,
                devices=point.devices,
                platform=platform,
                worlds=config.rollout.num_envs,
                left_out=point.left_out,
                **measured,
            )
        )
    return records


def _row(record: ScalingRecord) -> str:
    head = f"  {record.placement:<9} {record.devices:>2} devices {record.worlds:>7} worlds"
    if record.env_steps_per_second is None:
        return f"{head}  left out: {record.left_out}"
    return f"{head} {record.env_steps_per_second:>12,.0f} env steps/s, efficiency {record.efficiency:.0%}"
