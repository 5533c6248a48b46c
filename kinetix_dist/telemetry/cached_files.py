"""Files in folders of JAX's compile cache: what a process needs before it can ask the cache for a program, and that
takes seconds to make."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path

import jax

from kinetix_dist.telemetry.json_lines import replace_file


def cached(kind: str, asked_for: str, make: Callable[[], bytes]) -> bytes:
    """What `make` gives, from the compile cache where it is on and another process has written it there.

    kind: name of the folder and ending of the file names. asked_for: all that the content depends on. A file begins
    with the checksum of that and of what follows: one that is damaged, or of something else, is written again.
    """
    folder = jax.config.jax_compilation_cache_dir if jax.config.jax_enable_compilation_cache else None
    if not folder:
        return make()
    key = hashlib.sha256(asked_for.encode()).hexdigest()
    path = Path(folder) / kind / f"{key}.{kind}"
    with contextlib.suppress(OSError):  # it is not there
        checksum, _, content = path.read_bytes().partition(b"\n")
        if _checksum(key, content) == checksum:
            return content
    content = make()
    # A full or read-only disk is no reason not to train, as for programs; nor is another process that writes the same.
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, _checksum(key, content) + b"\n" + content, is_shared=True)
    return content


def _checksum(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + content).hexdigest().encode()
