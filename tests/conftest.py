"""Set-up shared by all tests: caches inside the checkout, the CPU unless GPU tests are asked for, level paths.

A test with the mark `also_gpu` runs on the CPU like any other and, where `-m gpu` is asked for (`make test-gpu`), on
the GPU: the body is the same, JAX's default device is another. `-m gpu --gpu-tests-on-cpu` tries them without a GPU.
"""

from __future__ import annotations

import gc
import os
import secrets
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import psutil
import pytest

from tests.helpers import REPOSITORY, public_levels_directory

TESTS = Path(__file__).resolve().parent
ON_CPU = pytest.StashKey[bool]()  # whether these are tests for a CPU

_CACHE = REPOSITORY / ".cache"
# Where the environment says to write no bytecode, as in many containers, each of hundreds of processes would compile
# the sources of jax, ray and others again, for 3 s: tests write it into the checkout.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(_CACHE / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or `python -B` was asked for
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
# Before jax or warp is imported: compiled programs are kept in the checkout and shared by the test processes.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE / "jax"))
# Small ones too: each file of tests needs hundreds of them again, and reading one takes half as long as compiling it.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_prestart_worker_first_driver", "0")  # not a process a CPU slot, of which none is used
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
    gc.set_threshold(50_000, 10, 10)  # tracing makes millions of objects that stay: looking for garbage finds little
    config.stash[ON_CPU] = not _asks_for_gpu_tests(config) or config.option.gpu_tests_on_cpu
    if config.stash[ON_CPU]:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):  # later ones end the process: no such flag
            os.environ.setdefault("XLA_FLAGS", FAST_TO_COMPILE)
        os.environ[_WITHOUT_OPTIMISATIONS.upper()] = "True"
    else:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # test processes share the GPU


# The longest first: begun last, one of these would keep one process busy for minutes after the others have nothing
# left to do.
LONGEST_FILES = (
    "test_gpu_run.py",
    "test_split.py",
    "test_ray_run.py",
    "test_editor.py",
    "test_mechanisms.py",
    "test_pages.py",
    "test_local_run.py",
    "test_ray_processes.py",
    "test_reference.py",
    "test_follows_float64.py",
    "test_level_vae.py",
    "test_preset_reference.py",
    "test_canonical.py",
    "test_editor_limits.py",
    "test_examples.py",
    "test_networks_on_levels.py",
    "test_run_data.py",
    "test_server.py",
    "test_phases.py",
    "test_cuda_kernels.py",
    "test_generator_program.py",
    "test_small_studies.py",
)


# Each preset is an engine of its own to compile: `make test` has the default one.
OTHER_PRESETS = {"draft", "fine", "paper"}


def _is_of_another_preset(item: pytest.Item) -> bool:
    callspec = getattr(item, "callspec", None)
    return "engine" in item.path.parts and callspec is not None and bool(_names(callspec.params) & OTHER_PRESETS)


def _names(params: dict[str, object]) -> set[str]:
    return {value for value in params.values() if isinstance(value, str)}


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    place = {name: number for number, name in enumerate(LONGEST_FILES)}
    for item in items:
        if _is_of_another_preset(item):
            item.add_marker("long")
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


# Most tests compile large programs for little work: without most optimisations that takes half of the time. A file
# whose programs compute for long, as those of the reference that step by the hundred, sets OPTIMISED = True.
_WITHOUT_OPTIMISATIONS = "jax_disable_most_optimizations"  # of JAX; processes of tests find it in the environment


@pytest.fixture(scope="module", autouse=True)
def optimisation(request: pytest.FixtureRequest) -> Iterator[None]:
    """How the programs of a file are compiled, also by processes that it starts. Those of fixtures of the whole session
    begin before this does, and without it."""
    if not request.config.stash[ON_CPU]:
        yield
        return
    import jax
    import warp as wp

    # A kernel for a CPU gives the same bits, is built in four fifths of the time, and steps by a tenth more slowly.
    wp.config.optimization_level = 1
    is_bare = not getattr(request.module, "OPTIMISED", False)
    os.environ[_WITHOUT_OPTIMISATIONS.upper()] = str(is_bare)
    if jax.config.read(_WITHOUT_OPTIMISATIONS) != is_bare:
        jax.clear_caches()
        jax.config.update(_WITHOUT_OPTIMISATIONS, is_bare)
    yield
    os.environ[_WITHOUT_OPTIMISATIONS.upper()] = "True"


GROWTH_BYTES = 1 << 30  # of a test process, by which compiled programs are let go
_resident_bytes = [0]  # when they were let go last


@pytest.fixture(scope="module", autouse=True)
def programs_are_let_go() -> Iterator[None]:
    """Otherwise a process that runs most of the suite holds six gigabytes of compiled programs at its end. Those of few
    files are kept: the next file needs the small ones again."""
    yield
    jax = sys.modules.get("jax")
    if jax and psutil.Process().memory_info().rss - _resident_bytes[0] > GROWTH_BYTES:
        jax.clear_caches()
        gc.collect()
        _resident_bytes[0] = psutil.Process().memory_info().rss


@pytest.fixture(scope="session")
def public_levels() -> Path:
    """The folder of the public Kinetix levels, with s/, m/ and l/; skips where it is absent."""
    directory = public_levels_directory()
    if directory is None:
        pytest.skip("public Kinetix levels not found: put them at ../shared/kinetix_levels or set KINETIX_LEVELS")
    return directory
