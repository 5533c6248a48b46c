"""`bench curator`: seconds of a refresh of the level buffer and candidates a second, by level size.

    a short run of the recipe in placement `local` on one device, a process a size, with a refresh every 4 updates
    refresh = time that the update waited for the curator;  update = the updates that neither ask for nor adopt a buffer
    probe   = by how much a refresh is longer that plays levels of the outgoing buffer again (every second one here)

In `local` the curator scores in the process that learns, so the time of a refresh is its cost, as it is elsewhere with
`run.num_curators` 0; else it is hidden behind training as long as it fits into `adopt_after` updates, but for what it
takes of a GPU that it shares. `share_of_training_time` is the share of a run's time that refreshes take in `local`, as
often as the recipe asks for them and for probes. One record (`CuratorRecord`) a size.
"""

from __future__ import annotations

import dataclasses
import statistics
from typing import Any, Literal

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.benchmarks.training_options import NUM_WARM_UPDATES, TrainingOptions, shortened
from kinetix_dist.benchmarks.training_run import RunFailedError, environment_of, number_of_gpus, run_in_process
from kinetix_dist.config import TrainConfig
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig

REFRESH_EVERY = 4  # updates: one asks, the next adopts, two do neither
ADOPT_AFTER = 1
PROBE_EVERY = 2  # refreshes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(TrainingOptions):
    """Seconds of a refresh of the level buffer, candidates a second, and what they cost of training."""

    sizes: tuple[Literal["s", "m", "l"], ...] = ()
    """Level sizes. Default: that of the recipe."""
    refreshes: int = 3
    """Refreshes of which the median counts, after one that compiles, and as many that play a probe."""
    run_seconds: float = 1800.0
    """A run that takes longer is ended and counts as failed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.config().has_curator:
            raise ValueError(f"recipe {self.recipe!r} has no curator; choose one whose curriculum is sfl")
        if self.refreshes < 1:
            raise ValueError(f"--refreshes is {self.refreshes}; give 1 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CuratorRecord:
    """One size."""

    benchmark: str = "curator"
    recipe: str
    overrides: tuple[str, ...]
    size: str
    platform: str  # "cpu" or "gpu"
    device: str  # its model
    num_candidates: int
    scoring_steps: int
    scoring_batch: int
    refreshes: int  # measured
    refresh_seconds: float  # median, without a probe
    slowest: float  # s
    fastest: float  # s
    probe_seconds: float | None  # median more of one with a probe; None: the recipe has none
    probe_every: int | None  # refreshes, as the recipe says
    candidates_per_second: float
    env_steps_per_second: float  # of scoring
    update_seconds: float  # median, of an update without a refresh
    refresh_every: int  # updates, as the recipe says
    share_of_training_time: float  # of refreshes, in placement local
    versions: dict[str, str]


def measure(options: Options, results: Results) -> None:
    """One record a size."""
    recipe = options.config()
    environment = environment_of("local", 1, on_gpu=number_of_gpus(recipe.run.device) > 0)
    for size in options.sizes or (recipe.env.size,):
        config = config_of(recipe, size, options.refreshes)
        try:
            run = run_in_process(config, environment, timeout_seconds=options.run_seconds)
        except RunFailedError as error:
            results.fail(f"size {size.upper()}: {error}")
            continue
        refreshes, probed, updates = seconds_of(run.rows, config.rollout.steps_per_update, config.curriculum_log)
        record = _record(options, size, refreshes, probed, updates, run.report)
        results.add(dataclasses.asdict(record))
        results.report(
            f"  size {size.upper()} on {record.device}: {record.num_candidates:,} candidates in "
            f"{record.refresh_seconds:.3g} s, {record.candidates_per_second:,.0f} per second"
            f"{'' if record.probe_seconds is None else f', a probe {record.probe_seconds:.3g} s'}; an update takes "
            f"{record.update_seconds:.3g} s, so that a refresh every {record.refresh_every} updates is "
            f"{record.share_of_training_time:.1%} of the time"
        )


def config_of(recipe: TrainConfig, size: str, refreshes: int) -> TrainConfig:
    """The run that is measured: refreshes at updates 0 (compiles), 4, 8, ...; every second one has a probe, if any, the
    first of which compiles."""
    log = dataclasses.replace(recipe.curriculum_log, probe_every=PROBE_EVERY)
    config = dataclasses.replace(
        recipe,
        env=dataclasses.replace(recipe.env, size=size),
        curriculum=dataclasses.replace(recipe.curriculum, refresh_every=REFRESH_EVERY, adopt_after=ADOPT_AFTER),
        curriculum_log=log,
    )
    last = PROBE_EVERY * (refreshes + 1) if log.probe_levels else refreshes
    config = shortened(config, REFRESH_EVERY * last + 1)
    return dataclasses.replace(config, run=dataclasses.replace(config.run, placement="local"))


def seconds_of(
    rows: list[dict[str, Any]], env_steps_per_update: int, log: CurriculumLogConfig
) -> tuple[list[float], list[float], list[float]]:
    """(seconds of each refresh without a probe but the first, of each with one but the first, of each update that has
    nothing to do with either)."""
    refreshes, probed, updates = [], [], []
    for row in rows:
        update = row["update"] - 1  # rows name how many updates are done
        seconds = env_steps_per_update / row["progress/env_steps_per_second"]
        if update % REFRESH_EVERY == 0 and update > 0:
            (probed if log.has_probe(update // REFRESH_EVERY) else refreshes).append(seconds * row["time/curate"])
        elif update % REFRESH_EVERY > ADOPT_AFTER and update >= NUM_WARM_UPDATES:
            updates.append(seconds)
    return refreshes, probed[1:], updates


def _record(
    options: Options,
    size: str,
    refreshes: list[float],
    probed: list[float],
    updates: list[float],
    report: dict[str, Any],
) -> CuratorRecord:
    config = options.config()
    curriculum, log = config.curriculum, config.curriculum_log
    refresh_seconds, update_seconds = statistics.median(refreshes), statistics.median(updates)
    probe_seconds = statistics.median(probed) - refresh_seconds if probed else None
    curated = refresh_seconds + (probe_seconds or 0.0) / log.probe_every  # s a refresh, on average
    training_seconds = curriculum.refresh_every * update_seconds  # between two refreshes
    return CuratorRecord(
        recipe=options.recipe,
        overrides=options.set,
        size=size,
        platform=report["device"]["platform"],
        device=report["device"]["kind"],
        num_candidates=curriculum.num_candidates,
        scoring_steps=curriculum.scoring_steps,
        scoring_batch=curriculum.scoring_batch,
        refreshes=len(refreshes),
        refresh_seconds=round(refresh_seconds, 4),
        slowest=round(max(refreshes), 4),
        fastest=round(min(refreshes), 4),
        probe_seconds=None if probe_seconds is None else round(probe_seconds, 4),
        probe_every=log.probe_every if probed else None,
        candidates_per_second=round(curriculum.num_candidates / refresh_seconds, 1),
        env_steps_per_second=round(curriculum.num_candidates * curriculum.scoring_steps / refresh_seconds, 1),
        update_seconds=round(update_seconds, 4),
        refresh_every=curriculum.refresh_every,
        share_of_training_time=round(curated / (curated + training_seconds), 4),
        versions=report["versions"],
    )
