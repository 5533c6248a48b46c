"""The checkpoint that a run goes on from: the newest good one, of the same numbers."""

from __future__ import annotations

from pathlib import Path

from kinetix_dist.checkpoint import Checkpoint, CheckpointError, newest_good
from kinetix_dist.config import ConfigError, TrainConfig, differences, from_dict, has_same_numbers
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.driver.roles import Reporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.json_lines import set_aside_file


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
    about = None if checkpoint is None else checkpoint.description
    if about is None or has_same_numbers(config, about["config"], about["config_hash"]):
        for bad in rejected:
            _set_aside(bad.path, reporter)
        return checkpoint
    try:
        theirs = from_dict(about["config"])
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {checkpoint.path} cannot be resumed: {error}") from error
    if fields := differences(config, theirs):
        raise CheckpointError(f"checkpoint {checkpoint.path} is of another config: {', '.join(fields)}")
    raise CheckpointError(
        f"checkpoint {checkpoint.path} was written by an older version, whose config had other fields: what it does "
        "may have changed, so that training cannot go on from it; start a new run (`kinetix-dist eval` still plays it)"
    )


def _set_aside(path: Path, reporter: Reporter) -> None:
    """A checkpoint that the run does not go on from: rows of metrics after the older one are removed, so it is not to
    come back by itself, should it be readable later."""
    try:
        set_aside_file(path, "rejected")
    except OSError as error:
        reporter.note(f"checkpoint {path.name} cannot be set aside: {one_line(error)}")
