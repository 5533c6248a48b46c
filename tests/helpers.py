"""Paths that several tests use."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
# s: after which something that is waited for is taken to have failed. No test may depend on how fast a machine is, so
# this is far more than one that is busy with other things needs.
PATIENCE_S = 180.0


def python_path() -> str:
    """PYTHONPATH of a test's own processes: this checkout before whatever is there, which may hold its packages."""
    return os.pathsep.join([str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])])


def environment_of_cpus(number: int) -> dict[str, str]:
    """The environment of a test's own process in which JAX has so many devices, all of them this CPU."""
    devices = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(number)}
    return os.environ | {"PYTHONPATH": python_path()} | devices


@contextlib.contextmanager
def compile_cache(directory: Path) -> Iterator[None]:
    """Meanwhile JAX keeps compiled programs there."""
    import jax  # not for whoever needs paths alone

    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(directory))
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def public_levels_directory() -> Path | None:
    """The public Kinetix levels (s/, m/, l/ of JSON files) where they are: $KINETIX_LEVELS or beside the checkout."""
    candidates = [os.environ.get("KINETIX_LEVELS"), REPOSITORY.parent / "shared" / "kinetix_levels"]
    for candidate in candidates:
        if candidate and (Path(candidate) / "s").is_dir():
            return Path(candidate)
    return None


def free_port() -> int:
    """A port of loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
