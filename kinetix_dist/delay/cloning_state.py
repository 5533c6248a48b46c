"""State of the training of a chunk policy on disk, from which it goes on after a kill, to the same bytes on a CPU.

RUN/clone_flow.json      what is learned, from what and how: another command is refused with what differs
RUN/state/00012500/      steps done, parameters, state of the optimiser; the newest two are kept
RUN/checkpoints/         policies to play, at each quarter of the steps (chunk_policy.py)
RUN/progress.jsonl       losses; lines behind the state are cut off when it goes on
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.checkpoint import (
    flatten_arrays,
    list_checkpoints,
    newest_good,
    remove_dead_drafts,
    save_checkpoint,
    select_arrays,
    unflatten_arrays,
)
from kinetix_dist.config import differing, to_dict
from kinetix_dist.delay.chunk_policy import FlowConfig
from kinetix_dist.delay.cloning import CloningConfig, Learned
from kinetix_dist.delay.demonstrations import Demonstrations
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.json_text import json_text
from kinetix_dist.telemetry.json_lines import mend_lines
from kinetix_dist.text_files import read_json_object

DESIGN_NAME, STATE, CHECKPOINTS, PROGRESS_NAME = "clone_flow.json", "state", "checkpoints", "progress.jsonl"
KEPT = 2  # states: a newest one that a disk has damaged has one before it
PARAMS, OPTIMIZER = "params", "optimizer"


def design_of(
    flow: FlowConfig, training: CloningConfig, demonstrations: Demonstrations, num_samples: int
) -> dict[str, Any]:
    """Everything that the parameters after a number of steps follow from, as plain values. num_samples: of these data
    after all that is left out."""
    settings = {name: value for name, value in to_dict(training).items() if name != "steps"}
    return {
        "flow": to_dict(flow),
        "env": to_dict(demonstrations.env_config),
        "training": settings,
        "samples": num_samples,
        "data": {str(number): _digest(dataset) for number, dataset in enumerate(demonstrations.datasets)},
    }


def _digest(dataset: Any) -> str:
    return hashlib.sha256("\n".join(shard.sha256 for shard in dataset.shards).encode()).hexdigest()[:16]


def claim(run: Path, design: Mapping[str, Any]) -> None:
    """Writes the design of a new run. Raises UserError where the directory is of another one."""
    file = run / DESIGN_NAME
    with user_errors(OSError, prefix=f"{run} cannot be written: "):
        if not file.exists():
            replace_file(file, (json_text(design, indent=1) + "\n").encode())
            return
    stored = read_json_object(file, advice="choose another --run")
    if differs := differing(json.loads(json_text(design)), stored):
        more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
        raise UserError(
            f"{run} holds another training: {differs[0]}{more}; choose another --run, or the options that it was made "
            "with"
        )


def save_state(run: Path, learned: Learned) -> None:
    """Raises as `save_checkpoint`."""
    params, state = jax.device_get((learned.params, learned.state))
    arrays = {f"{PARAMS}/{name}": array for name, array in flatten_arrays(params).items()}
    arrays |= {f"{OPTIMIZER}/{name}": array for name, array in flatten_arrays(state).items()}
    save_checkpoint(run / STATE, learned.steps, arrays, {"clone_flow": True}, keep=KEPT)


def newest_state(run: Path, fresh: Learned) -> tuple[Learned, list[str]]:
    """(the newest state that can be read, or the fresh one; a line for each that cannot). fresh: with the shapes."""
    for name in (STATE, CHECKPOINTS):
        remove_dead_drafts(run / name)
    found, rejected = newest_good(run / STATE)
    lines = [f"{bad.path} passed over: {bad.reason}" for bad in rejected]
    if found is None:
        return fresh, lines
    params, state = (
        jax.tree.map(jnp.asarray, unflatten_arrays(template, select_arrays(found.arrays, prefix)))
        for template, prefix in ((fresh.params, PARAMS), (fresh.state, OPTIMIZER))
    )
    return Learned(found.description["num_updates"], params, state), lines


def cut_progress(run: Path, steps: int) -> None:
    """Leaves the lines of progress up to so many steps."""
    mend_lines(
        run / PROGRESS_NAME, is_row=lambda row: isinstance(row.get("step"), int), keep=lambda row: row["step"] <= steps
    )


def newest_policy(run: Path) -> Path | None:
    """Newest checkpoint of a policy; None: there is none."""
    found = list_checkpoints(run / CHECKPOINTS)
    return found[-1] if found else None
