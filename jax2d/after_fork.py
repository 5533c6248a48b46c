"""Processes that were forked after JAX had started: JAX waits for ever in them, since its threads stay in the parent.

`check()` raises in such a process. Whatever runs JAX for a caller who may not know that it does calls it first.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

REMEDY = (
    "JAX ran in the parent of this process before it forked, and would wait for ever here; start processes with the "
    'method "spawn": gymnasium.make_vec(..., vectorization_mode="async", vector_kwargs={"context": "spawn"}), '
    'multiprocessing.get_context("spawn"), or multiprocessing_context="spawn" of a DataLoader'
)
_THREADS = Path("/proc/self/task")  # a folder each, on Linux


class ForkedProcessError(RuntimeError):
    """JAX cannot run in this process, since it started in the parent before the fork."""


def is_forked() -> bool:
    """Return True if JAX had started in the parent before this process was forked from it."""
    return _is_forked


def check() -> None:
    """Raise ForkedProcessError if JAX had started in the parent before this process was forked from it."""
    if _is_forked:
        raise ForkedProcessError(REMEDY)


def _has_started() -> bool:
    """Return True if JAX has made its clients, and with them their threads, or was making them.

    `backends_are_initialized` of this module waits for the lock: a child that was forked while another thread held it
    has a copy that nobody releases.
    """
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and (len(bridge._backends) > 0 or bridge._backend_lock.locked())


def _has_lost_its_threads() -> bool:
    """Return True if JAX has started, but only the calling thread runs: a fork copies no other."""
    return _has_started() and _THREADS.is_dir() and len(list(_THREADS.iterdir())) == 1


def _mark() -> None:
    global _is_forked
    _is_forked = _is_forked or _has_started()


_is_forked = _has_lost_its_threads()  # a process may import this only after it was forked
os.register_at_fork(after_in_child=_mark)
