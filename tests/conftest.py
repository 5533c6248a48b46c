"""Set-up shared by all tests: caches inside the checkout, the CPU unless GPU tests are asked for, level paths.

A test with the mark `also_gpu` runs on the CPU like any other and, where `-m gpu` is asked for (`make test-gpu`), on
the GPU: the body is the same, JAX's default device is another. `-m gpu --gpu-tests-on-cpu` tries them without a GPU.
"""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY, public_levels_directory

# Before jax or warp is imported: compiled programs are kept in the checkout and shared by the test processes.
_CACHE = REPOSITORY / ".cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
# Ray keeps for the life of a process whether it has a token: all clusters that a test process meets ask for one.
os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
os.environ.setdefault("RAY_AUTH_MODE", "token")

# Most of the time of the suite is XLA's. It compiles large programs for a CPU in half of the time without this way of
# fusing loops, to machine code that is as fast and rounds otherwise. Set XLA_FLAGS, to "" for instance, to test with
# what users run.
FAST_TO_COMPILE = "--xla_cpu_use_fusion_emitters=false"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--gpu-tests-on-cpu", action="store_true", help="with -m gpu: run the GPU tests on the CPU, to try them out"
    )


def _asks_for_gpu_tests(config: pytest.Config) -> bool:
    return "gpu" in (config.option.markexpr or "").replace("not gpu", "")


def pytest_configure(config: pytest.Config) -> None:
    if not _asks_for_gpu_tests(config) or config.option.gpu_tests_on_cpu:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        os.environ.setdefault("XLA_FLAGS", FAST_TO_COMPILE)
    else:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # test processes share the GPU


# The longest first: begun last, one of these would keep one of two processes busy for minutes after the other has
# nothing left to do.
LONGEST_FILES = (
    "test_gpu_run.py",
    "test_ray_run.py",
    "test_ray_processes.py",
    "test_reference.py",
    "test_local_run.py",
    "test_failures.py",
    "test_reference_alone.py",
    "test_follows_float64.py",
    "test_effects.py",
    "test_hard_scenes.py",
    "test_paired.py",
)


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    place = {name: number for number, name in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))
    if _asks_for_gpu_tests(config):
        for item in items:
            if item.get_closest_marker("also_gpu") and not item.get_closest_marker("slow"):
                item.add_marker("gpu")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and not item.config.option.gpu_tests_on_cpu:
        import jax

        if jax.default_backend() != "gpu":
            pytest.skip(f"needs an NVIDIA GPU; JAX runs on {jax.default_backend()} here")


@pytest.fixture(scope="module", autouse=True)
def programs_of_a_module_are_let_go() -> Iterator[None]:
    """Otherwise a process that runs most of the suite holds six gigabytes of compiled programs at its end."""
    yield
    if jax := sys.modules.get("jax"):
        jax.clear_caches()


@pytest.fixture(scope="session")
def public_levels() -> Path:
    """The folder of the public Kinetix levels, with s/, m/ and l/; skips where it is absent."""
    directory = public_levels_directory()
    if directory is None:
        pytest.skip("public Kinetix levels not found: put them at ../shared/kinetix_levels or set KINETIX_LEVELS")
    return directory
