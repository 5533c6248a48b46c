"""Checkpoints of a run: saved in the background, resumed from, and started from.

| Saver | |
|---|---|
| consumes | arrays in host memory; copying off the devices is waited for, writing and verifying is not |
| produces | a published checkpoint; older ones are pruned once it is verified |
| bound | one save at a time: the next one waits for the one before, so that arrays are held twice at most |
| a failure | is an event and a note at the next update; older checkpoints are untouched, the next save tries again |

A session starts from the newest good checkpoint of its run (`newest_checkpoint`), or from the parameters of a policy
that exists (`starting_point`: `run.start_from`, `train --from`), or from the seed. Of a policy, parameters are taken,
and the state of the optimiser where that is requested; counters, curriculum and random streams are those of a new run.
Every checkpoint of the run describes its lineage. A run at its configured end has nothing to go on with
(`finished_report`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import (
    Checkpoint,
    CheckpointError,
    flatten_arrays,
    load_checkpoint,
    newest_good,
    save_checkpoint,
    select_arrays,
)
from kinetix_dist.config import (
    ConfigError,
    TrainConfig,
    differences,
    differing,
    from_dict,
    from_dict_for_playing,
    has_same_numbers,
    to_dict,
)
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import one_line
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX, load_policy
from kinetix_dist.models.policy import NETWORKS
from kinetix_dist.renamed_settings import translated
from kinetix_dist.runtime.cores.run_names import LEARNER, OPTIMIZER, PARAMS, START, one_level
from kinetix_dist.runtime.driver.roles import Reporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.totals import is_over, read_report
from kinetix_dist.telemetry.json_lines import set_aside_file
from kinetix_dist.text_files import read_json


class Saver:
    """Saves the checkpoints of one run. All methods are for the thread that drives the run."""

    def __init__(self, run: RunDirectory, reporter: Reporter, *, keep: int) -> None:
        self._run = run
        self._reporter = reporter
        self._keep = keep
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoint")
        # Update, and of its save the seconds and whether config.json had to be written again.
        self._in_flight: tuple[int, Future[tuple[float, bool]]] | None = None
        self.saved_at: int | None = None  # update of the newest checkpoint of this session, or resumed from
        self.seconds: float | None = None  # that writing and verifying the last one took
        self.error: str | None = None  # why the last save failed; None where it did not

    def save(self, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> None:
        """Begins a save; waits only for the one before it."""
        self.wait()
        self._in_flight = (num_updates, self._thread.submit(self._write, num_updates, arrays, description))

    def collect(self) -> None:
        """Says what became of a save that is over; does not wait."""
        if self._in_flight is not None and self._in_flight[1].done():
            self.wait()

    def wait(self) -> None:
        """Until nothing is being saved. `saved_at` says how that went."""
        if self._in_flight is None:
            return
        (num_updates, future), self._in_flight = self._in_flight, None
        error = future.exception()
        if error is None:
            self.seconds, was_gone = future.result()
            self.saved_at, self.error = num_updates, None
            if was_gone:
                self._run.event("file_failed", file=self._run.config_path.name, error="it was gone; written again")
                self._reporter.note(
                    f"{self._run.config_path} was gone and is written again: is this still the directory of the run? "
                    "Metrics may go on elsewhere"
                )
            self._run.event("checkpoint_saved", update=num_updates, seconds=round(self.seconds, 3))
            return
        # Whatever it is: Orbax has errors of many kinds for a disk that is full. Training goes on from memory.
        self.error = one_line(error)
        self._run.event("checkpoint_failed", update=num_updates, error=self.error)
        self._reporter.note(f"checkpoint at update {num_updates} failed, training goes on: {self.error}")

    def close(self) -> None:
        """Waits for a save in flight, also where the run ends by an error."""
        self.wait()
        self._thread.shutdown()

    def _write(
        self, num_updates: int, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]
    ) -> tuple[float, bool]:
        began = time.monotonic()
        was_gone = self._run.restore_config()
        save_checkpoint(self._run.checkpoints, num_updates, arrays, description, keep=self._keep)
        return time.monotonic() - began, was_gone


def newest_checkpoint(run: RunDirectory, config: TrainConfig, reporter: Reporter) -> Checkpoint | None:
    """None where none was written yet. Bad ones are passed over, with an event and a note, and set aside.

    Raises CheckpointError where all are bad, or where the newest good one is of another config, or of a version with
    other fields.
    """
    checkpoint, rejected = newest_good(run.checkpoints)
    for bad in rejected:
        run.event("checkpoint_rejected", checkpoint=bad.path.name, reason=bad.reason)
        reporter.note(f"checkpoint {bad.path.name} passed over: {bad.reason}")
    if checkpoint is None and rejected:
        # Going on at update 0 would overwrite what is left of the run: that is for a person to decide.
        raise CheckpointError(
            f"none of the {len(rejected)} checkpoints in {run.checkpoints} can be used (see above); nothing was "
            f"changed: put back a good copy of one, or start a new run with another --run"
        )
    if checkpoint is None or _has_same_numbers(config, checkpoint):
        for bad in rejected:
            _set_aside(bad.path, reporter)
        return checkpoint
    try:
        theirs = from_dict(checkpoint.config)
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {checkpoint.path} cannot be resumed: {error}") from error
    if fields := differences(config, theirs):
        raise CheckpointError(f"checkpoint {checkpoint.path} is of another config: {', '.join(fields)}")
    raise CheckpointError(
        f"checkpoint {checkpoint.path} was written by an older version, whose config had other fields: what it does "
        "may have changed, so that training cannot go on from it; start a new run (`kinetix-dist eval` still plays it)"
    )


def _has_same_numbers(config: TrainConfig, checkpoint: Checkpoint) -> bool:
    return has_same_numbers(config, checkpoint.config, checkpoint.description.get("config_hash", ""))


def _set_aside(path: Path, reporter: Reporter) -> None:
    """A checkpoint that the run does not go on from: rows of metrics after the older one are removed, so it is not to
    come back by itself, should it be readable later."""
    try:
        set_aside_file(path, "rejected")
    except OSError as error:
        reporter.note(f"checkpoint {path.name} cannot be set aside: {one_line(error)}")


MADE_AT_THE_END = ("evaluation", "recording")  # sections that change no number of training


def finished_report(path: Path, config: TrainConfig) -> dict[str, Any] | None:
    """Report of the run in `path` where `config` needs no more than it has done, and its last checkpoint is good.

    None where training goes on, where the config has other evaluations or recordings than those stored, or where the
    report or the last checkpoint is missing or damaged: resuming makes them again. Reads only.
    """
    report = read_report(path / "report.json")
    if report is None:
        return None
    stored, wanted = read_json(path / "config.json")["config"], to_dict(config)
    if not has_same_numbers(config, stored, report["config_hash"]):
        return None
    stored = translated(stored, for_playing=True)
    if any(stored.get(section) != wanted[section] for section in MADE_AT_THE_END):
        return None
    if not is_over(config.run, env_steps=report["env_steps"], training_seconds=report["training_seconds"]):
        return None
    checkpoint, _ = newest_good(path / "checkpoints")
    is_last = checkpoint is not None and checkpoint.description["num_updates"] == report["policy_updates"]
    return report if is_last else None


# Of `policy`: parameters have the same shapes whatever these are, or are added (models/added_layers.py).
_FUNCTION = ("network", "num_heads", "max_qk_norm", "num_layers")
LINEAGE = "lineage"  # in the description of a checkpoint: where it comes from, the oldest first
# Of a checkpoint's description, what its children inherit.
_INHERITED = ("config_hash", "num_updates", "env_steps", "training_seconds")


@dataclasses.dataclass(frozen=True)
class Start:
    """Parts of an earlier run that a new run takes."""

    arrays: dict[str, np.ndarray] | None = None  # for `Trainer.start` at update 0; None: all from the seed
    lineage: tuple[Mapping[str, Any], ...] = ()
    differs: tuple[str, ...] = ()  # fields of `policy` by which the same parameters compute something else, in words


def starting_point(config: TrainConfig) -> Start:
    """Raises CheckpointError, one line, where there is no such checkpoint, where it is of another network (but for
    layers that this run has more of) or of other settings of the engine, or where it holds no optimiser, or one of
    fewer layers, and that is requested."""
    if not config.run.start_from:
        return Start()
    path = Path(config.run.start_from)
    if (path / "checkpoints").is_dir():
        raise CheckpointError(f"run.start_from: {path} is a run; name one of the directories in {path}/checkpoints")
    checkpoint = load_checkpoint(path)
    if not config.run.start_other_engine:
        _check_engine(checkpoint, config.env)
    ours, theirs = config.policy, from_dict_for_playing(checkpoint.config).policy
    have_layers = NETWORKS[ours.network].has_attention and NETWORKS[theirs.network].has_attention
    is_deeper = have_layers and ours.num_layers > theirs.num_layers
    if have_layers and ours.num_layers < theirs.num_layers:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} has {theirs.num_layers} layers and policy.num_layers is "
            f"{ours.num_layers}; set it to {theirs.num_layers}, or to more: layers can be added and not left out"
        )
    optimizer = select_arrays(checkpoint.arrays, f"{LEARNER}/{OPTIMIZER}")
    if config.run.start_optimizer and not optimizer:
        raise CheckpointError(
            f"run.start_optimizer: {checkpoint.path} holds the parameters of a policy and no optimiser; name a "
            "checkpoint of a run, or leave it out"
        )
    if config.run.start_optimizer and is_deeper:
        raise CheckpointError(
            f"run.start_optimizer: policy.num_layers is {ours.num_layers} and the optimiser of {checkpoint.path} is of "
            f"{theirs.num_layers}; leave it out where layers are added"
        )
    env = Environment(config.env)  # for shapes
    # The learner adds layers that are missing: it has parameters as they are initialised.
    policy = dataclasses.replace(ours, num_layers=theirs.num_layers) if is_deeper else ours
    try:
        _, params = load_policy(checkpoint, policy, env, one_level(config))
    except ValueError as error:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} does not fit policy.*, env.observation and env.action_space of this "
            f"run: {error}"
        ) from error
    differs = differing(*({f"policy.{name}": getattr(policy, name) for name in _FUNCTION} for policy in (ours, theirs)))
    arrays = flatten_arrays({PARAMS: params})
    if config.run.start_optimizer:
        # Moments belong to the parameters that learned, not to their average.
        arrays = flatten_arrays({PARAMS: select_arrays(checkpoint.arrays, PARAMS_PREFIX), OPTIMIZER: optimizer})
    arrays = {f"{START}/{name}": array for name, array in arrays.items()}
    return Start(arrays, lineage_from(checkpoint), tuple(differs))


def lineage_from(checkpoint: Checkpoint) -> tuple[Mapping[str, Any], ...]:
    """Lineage of what starts from this checkpoint: its own ancestors, then itself."""
    description = checkpoint.description
    itself = {"checkpoint": str(checkpoint.path)}
    if "run" in checkpoint.config:
        itself["recipe"] = checkpoint.config["run"]["name"]
    itself |= {name: description[name] for name in _INHERITED if name in description}
    return (*description.get(LINEAGE, ()), itself)


def _check_engine(checkpoint: Checkpoint, env: EnvConfig) -> None:
    theirs = from_dict_for_playing(checkpoint.config).env
    ours = {"frame_skip": env.frame_skip} | dataclasses.asdict(env.physics)
    learned = {"frame_skip": theirs.frame_skip} | dataclasses.asdict(theirs.physics)
    if differs := [f"{name} {learned[name]} instead of {ours[name]}" for name in ours if ours[name] != learned[name]]:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} learned with other settings of the engine: {', '.join(differs)}; set "
            "env.frame_skip and env.physics.* to these, or --run.start_other_engine True to train with yours from here"
        )
