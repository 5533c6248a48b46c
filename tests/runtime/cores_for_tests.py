"""Cores that Ray processes of tests hold: each does one thing, and does it for real."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Any, Protocol


class Facts:
    """Returns the environment of its process."""

    def environment(self, name: str) -> str | None:
        return os.environ.get(name)

    def devices(self) -> str | None:
        return os.environ.get("CUDA_VISIBLE_DEVICES")


class Greedy:
    """Asks JAX for more memory than there is."""

    def call(self) -> Any:
        import jax.numpy as jnp

        return jnp.zeros(1 << 50, jnp.int8).sum()


def build_facts(index: int, num_processes: int) -> Facts:
    del index, num_processes
    return Facts()


def build_greedy(index: int, num_processes: int) -> Greedy:
    del index, num_processes
    return Greedy()


def build_from_missing_levels(index: int, num_processes: int, path: str) -> Any:
    """Fails as a process does on whose host a level set is not there."""
    del index, num_processes
    from kinetix_dist.level.sets import load_level_set

    return load_level_set(path, "s")


def build_together(index: int, num_processes: int, meeting: str, count: int) -> Facts:
    """Is done when `count` processes are at it: those that are started one after another never are."""
    del index, num_processes
    here = Path(meeting) / str(os.getpid())
    here.touch()
    deadline = time.monotonic() + 60.0
    while len(list(here.parent.iterdir())) < count:
        if time.monotonic() > deadline:
            raise TimeoutError(f"{count} processes were not built at the same time")
        time.sleep(0.05)
    return Facts()


class HangingStamp(dict[str, Any]):
    """Whoever reads it waits for a minute, and says so by a file."""

    def __init__(self, meeting: str) -> None:
        self._meeting = meeting

    def keys(self) -> Any:
        Path(self._meeting).touch()
        time.sleep(60.0)
        return super().keys()

    def __iter__(self) -> Any:
        return iter(self.keys())


class Stored(Protocol):
    """An array in the object store."""

    def fetch(self) -> Any: ...


class Compiler:
    """Compiles a program over all devices of its group, with compiled programs on disk; can do nothing."""

    def __init__(self, directory: str) -> None:
        import jax

        from kinetix_dist.program_cache import enable_compile_cache

        self._num_hits = 0
        self._handed: Any = None
        enable_compile_cache(directory)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.monitoring.register_event_listener(self._count)

    def num_hits(self) -> int:
        """Programs that were in the cache already; the call goes to all processes of the group."""
        import jax
        import jax.numpy as jnp

        from kinetix_dist.learner.sharding import data_mesh, replicated

        program = jax.jit(lambda: jnp.arange(64.0).sum() * jnp.ones(4), out_shardings=replicated(data_mesh()))
        program().block_until_ready()
        return self._num_hits

    def sleep(self, seconds: float, *others: object) -> None:
        time.sleep(seconds)

    def give(self, size: int) -> tuple[dict[str, int], Any]:
        """(header, content)"""
        import numpy as np

        return {"size": size}, np.ones(size, np.uint8)

    def give_what_cannot_be_stored(self) -> tuple[dict[str, int], Any]:
        return {}, threading.Lock()

    def give_and_hang(self, size: int, meeting: str) -> tuple[dict[str, Any], Any]:
        """Hangs once the content is stored; the file `meeting` is there then."""
        import numpy as np

        return HangingStamp(meeting), np.ones(size, np.uint8)

    def compute_until_handed(self, seconds: float) -> int:
        """Computes like a learner; bytes that `hand` fetched meanwhile. Raises TimeoutError where it did not."""
        deadline = time.monotonic() + seconds
        while self._handed is None:
            if time.monotonic() > deadline:
                raise TimeoutError("nothing was handed over while this call ran")
            time.sleep(0.01)
        return self._handed.nbytes

    def hand(self, content: Stored) -> None:
        """content: fetched here."""
        self._handed = content.fetch()

    def _count(self, event: str, **details: object) -> None:
        del details
        self._num_hits += event == "/jax/compilation_cache/cache_hits"


def build_compiler(index: int, num_processes: int, directory: str) -> Compiler:
    del index, num_processes
    return Compiler(directory)
