"""Programs that are traced once and then read from the compile cache, see `exported`.

JAX asks its compile cache for a program that is traced and lowered already, which takes seconds of Python in every
process. An exported program needs neither: what calls it is lowered in a tenth of a second.
"""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jaxlib
import numpy as np
from jax import export

import jax2d
import kinetix_dist
from jax2d.scene import Array
from kinetix_dist.telemetry.cached_files import cached

# Settings of JAX that change what a traced program computes, by their context managers, and those of whole processes.
_SETTINGS: dict[str, Callable[[Any], Any]] = {
    "jax_enable_x64": jax.enable_x64,
    "jax_threefry_partitionable": jax.threefry_partitionable,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_prng_impl": jax.default_prng_impl,
}
_OF_PROCESSES = (
    "eager_constant_folding",
    "jax_allow_f16_reductions",
    "jax_custom_vjp3",
    "jax_disable_jit",
    "jax_enable_custom_prng",
    "jax_error_checking_behavior_divide",
    "jax_error_checking_behavior_nan",
    "jax_error_checking_behavior_oob",
    "jax_explicit_x64_dtypes",
    "jax_high_dynamic_range_gumbel",
    "jax_legacy_prng_key",
    "jax_mosaic_allow_hlo",
    "jax_numpy_rank_promotion",
    "jax_pallas_enable_debug_checks",
    "jax_pallas_poison_buffers",
    "jax_pallas_use_mosaic_gpu",
    "jax_ragged_dot_use_ragged_dot_instruction",
    "jax_random_seed_offset",
    "jax_remat3",
    "jax_scan3",
    "jax_softmax_custom_jvp",
    "jax_threefry_gpu_kernel_lowering",
    "jax_use_direct_linearize",
    "jax_use_shardy_partitioner",
    "jax_use_simplified_jaxpr_constants",
)
# Modules without which a process cannot load a program with such a call: this one says in an environment variable where
# the library is that starts the kernels. Who traces a kernel has imported it.
_NEEDED_BY_CALLS = {"@mosaic_gpu": "jax.experimental.mosaic.gpu"}
_SOURCE_FILES = (".py", ".cu", ".cuh")
_PACKAGES = jax2d, kinetix_dist
Settings = tuple[tuple[str, Any], ...]


def current_settings() -> Settings:
    """(name, value) of what changes a traced program, as this thread has it; hashable."""
    return tuple((name, getattr(jax.config, name)) for name in _SETTINGS)


class Program(NamedTuple):
    """A function that another process may have traced."""

    exported: export.Exported
    results: Any  # structure of what it gives

    def __call__(self, *arguments: Array) -> Any:
        return jax.tree.unflatten(self.results, self.exported.call(*arguments))


class _Stored(NamedTuple):
    """A program as a file has it."""

    program: bytes
    results: Any  # what it gives, with numbers for arrays
    launches: list[Any]  # of kernels of the engine, `jax2d.warp.ffi.Launch`
    modules: list[str]  # that have to be imported before it is loaded


def exported(
    kind: str,
    made_from: object,
    function: Callable[..., Any],
    arguments: Sequence[jax.ShapeDtypeStruct],
    settings: Settings,
    *,
    custom_calls: Sequence[str] = (),
) -> Program:
    """`function` of `arguments`, from the compile cache where it is on and another process has written it there.

    kind: folder of the cache. made_from: all that the program depends on beside the arguments, the sources of this
    project, the versions of JAX, numpy and Warp, the backend and `settings` (`current_settings`); its repr is part of
    the key. function: of arrays; it is traced if there is no such file. arguments: with the shardings they come with,
    where these matter. custom_calls: targets that the program may call beside those that JAX keeps stable and the
    engine's.
    """

    def make() -> bytes:
        from jax2d.warp import ffi  # here: not for whoever draws no level

        structures = []

        def of_leaves(*leaves: Array) -> list[Array]:
            found, structure = jax.tree.flatten(function(*leaves))
            structures.append(structure)
            return found

        with contextlib.ExitStack() as stack:  # a thread begins with those of the process
            for name, value in settings:
                stack.enter_context(_SETTINGS[name](value))
            program = jax.jit(of_leaves)
            program.trace(*arguments)  # from now on kernels have names
            allowed = [export.DisabledSafetyCheck.custom_call(name) for name in (*custom_calls, *ffi.targets())]
            made = export.export(program, disabled_checks=allowed)(*arguments)
            structure = structures[-1]
            numbered = jax.tree.unflatten(structure, range(structure.num_leaves))
            text = made.mlir_module()
            modules = [module for call, module in _NEEDED_BY_CALLS.items() if call in text]
            return pickle.dumps(_Stored(bytes(made.serialize()), numbered, ffi.launches_of(text), modules))

    shapes = [(str(x.shape), str(x.dtype), str(x.sharding)) for x in arguments]
    of_process = [(name, getattr(jax.config, name, None)) for name in _OF_PROCESSES]  # None: not in this version
    asked_for = repr((*sources_and_versions(), jax.default_backend(), made_from, shapes, settings, of_process))
    # In a thread of its own: what is being traced here, and on which mesh, is not part of it.
    with ThreadPoolExecutor(1) as thread:
        content = thread.submit(contextvars.copy_context().run, cached, kind, asked_for, make).result()
    stored: _Stored = pickle.loads(content)  # by a process that may write programs there
    for module in stored.modules:
        import_module(module)
    for launch in stored.launches:
        launch.register()
    return Program(export.deserialize(bytearray(stored.program)), jax.tree.structure(stored.results))


def are_of_this_project(*parts: object) -> bool:
    """Whether the classes of all of them are, so that `exported` sees it when their code changes."""
    own = {package.__name__ for package in _PACKAGES}
    return all(type(part).__module__.partition(".")[0] in own for part in parts)


def told_apart(part: object) -> tuple[str, str, dict[str, Any]]:
    """An object for a key: its class and its attributes."""
    return type(part).__module__, type(part).__qualname__, vars(part)


def _sources() -> str:
    """A checksum of all modules and kernels of this project."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        folder = Path(package.__path__[0])
        for file in sorted(path for path in folder.rglob("*") if path.suffix in _SOURCE_FILES):
            content = file.read_bytes()
            digest.update(f"{file.relative_to(folder)} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def sources_and_versions() -> tuple[str, tuple[str, ...]]:
    """What all that is kept in the compile cache depends on."""
    return _SOURCES, (jax.__version__, jaxlib.__version__, np.__version__, version("warp-lang"))


# Of the modules as this process has them: a file may change while it runs.
_SOURCES = _sources()
