"""Set-up shared by all tests: caches inside the checkout, the CPU unless a GPU test is asked for, level paths."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY, public_levels_directory

# Before jax or warp is imported: compiled programs are kept in the checkout and shared by the test processes.
_CACHE = REPOSITORY / ".cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")


def pytest_configure(config: pytest.Config) -> None:
    if "gpu" not in (config.option.markexpr or "").replace("not gpu", ""):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")


@pytest.fixture(scope="session")
def public_levels() -> Path:
    """The folder of the public Kinetix levels, with s/, m/ and l/; skips where it is absent."""
    directory = public_levels_directory()
    if directory is None:
        pytest.skip("public Kinetix levels not found: put them at ../shared/kinetix_levels or set KINETIX_LEVELS")
    return directory
