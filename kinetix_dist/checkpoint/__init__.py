"""Checkpoints: named arrays with a SHA-256 manifest; the newest good one is found and bad ones are named."""

from kinetix_dist.checkpoint.arrays import ArrayMismatchError, flatten_arrays, select_arrays, unflatten_arrays
from kinetix_dist.checkpoint.store import (
    Checkpoint,
    CheckpointError,
    Rejected,
    list_checkpoints,
    load_checkpoint,
    newest_good,
    remove_dead_drafts,
    save_alone,
    save_checkpoint,
)

__all__ = [
    "ArrayMismatchError",
    "Checkpoint",
    "CheckpointError",
    "Rejected",
    "flatten_arrays",
    "list_checkpoints",
    "load_checkpoint",
    "newest_good",
    "remove_dead_drafts",
    "save_alone",
    "save_checkpoint",
    "select_arrays",
    "unflatten_arrays",
]
