"""Compiled and exported programs on disk, shared by all runs of a user: the second run of a recipe starts in seconds.

    enable_compile_cache("")                          JAX's persistent cache of compiled programs: XLA is not run again
    exported(function, ProgramKey(kind="levels", ...))  a program that is not traced again either
    cached_file("ptx", key, make)                     any other bytes that take long to make

JAX looks for a compiled program by the text that tracing and lowering make, which takes seconds of Python in every
process. An exported program is that text: a function that calls it is lowered in a tenth of a second. Its key is

- the sources of its closure: the modules that its own module reaches by imports within `kinetix_dist` and `jax2d`, and
  those in CUDA and C++. A change elsewhere, say in the dashboard, leaves the program valid.
- the settings of JAX by JAX's own list, `trace_context()`: the values by which JAX itself decides whether a function is
  traced again within a process, so that two programs of one context are equal by JAX's contract. JAX leaves
  `jax_default_prng_impl` out of it; `kinetix_dist.prng` pins that one.
- versions of the packages that make programs, the devices, the arguments, and what the caller says it depends on.
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
import functools
import hashlib
import importlib.metadata
import os
import pickle
import re
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.installation import ENGINE
from kinetix_dist.user_directories import cache_directory

if TYPE_CHECKING:
    import jax  # imported where it is used: commands that only name the directory run without it
    from jax.sharding import Mesh

OFF = "off"
MIN_COMPILE_SECONDS = 0.3  # programs that compile faster are not worth a file, unless the environment says otherwise
MIN_COMPILE_VARIABLE = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"  # JAX reads it itself
_VERSIONS_OF = ("jax", "jaxlib", "numpy", "warp-lang", "flax", "optax")

# --- Compiled programs: JAX's persistent cache


def enable_compile_cache(setting: str) -> Path | None:
    """Turns JAX's persistent cache on for this process; returns its directory, None when it is off or cannot be
    written.

    setting: a directory, "" for `$JAX_COMPILATION_CACHE_DIR` or else the user's cache directory, "off" for no cache.
    """
    import jax

    count_compile_seconds()
    if setting == OFF:
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    directory = directory_of(setting)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError:  # a read-only home is no reason not to train; commands say so (`cli/computing.py`)
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    if MIN_COMPILE_VARIABLE not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    _let_every_rank_write()
    return directory


def directory_of(setting: str) -> Path:
    """Directory of the cache by its setting, which is not "off"."""
    return Path(setting or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_directory()).expanduser()


def default_directory() -> Path:
    """Directory of the cache where neither a setting nor the environment names one."""
    return cache_directory() / "jax"


def _let_every_rank_write() -> None:
    """Lets ranks above 0 write the cache on CPUs. JAX lets process 0 of a group write alone, but names programs by the
    topology as a process sees it. That differs from rank to rank on CPUs: ranks above 0 would compile at every start.
    """
    import jax
    from jax._src import compiler, distributed  # there is no public way (jax 0.10)

    write = compiler._cache_write
    if write.__name__ == "write_as_process_0":  # enabled twice
        return

    def write_as_process_0(*arguments: Any, **options: Any) -> None:
        if jax.default_backend() != "cpu":
            return write(*arguments, **options)
        rank, distributed.global_state.process_id = distributed.global_state.process_id, 0
        try:
            return write(*arguments, **options)
        finally:
            distributed.global_state.process_id = rank

    compiler._cache_write = write_as_process_0


# Events of jax.monitoring. Tracing is left out: its events nest, so that their sum would count it several times.
_COMPILE_EVENTS = ("to_mlir_module_duration", "backend_compile_duration")
_compile_seconds: list[float] = []
_compile_lock = threading.Lock()


def count_compile_seconds() -> None:
    """Begins to count, once a process."""
    import jax

    if not _compile_seconds:
        _compile_seconds.append(0.0)
        jax.monitoring.register_event_duration_secs_listener(_add_compile_event)


def compile_seconds() -> float:
    """Seconds of lowering and compiling since counting began, summed over threads. A hit of the cache takes little."""
    return _compile_seconds[0] if _compile_seconds else 0.0


def _add_compile_event(event: str, duration_secs: float, **details: object) -> None:
    del details
    if event.startswith("/jax/core/compile/") and event.endswith(_COMPILE_EVENTS):
        with _compile_lock:
            _compile_seconds[0] += duration_secs


# --- Files in folders of that cache


def cached_file(kind: str, key: str, make: Callable[[], bytes]) -> bytes:
    """Bytes of `make`, from the compile cache where it is on and another process has written them there.

    kind: folder of the cache, and ending of the file's name. key: everything that the bytes depend on. A file begins
    with a checksum of key and content; one that does not fit is ignored with a warning and written again.
    """
    import jax

    settings = jax.config.values
    folder = settings["jax_compilation_cache_dir"] if settings["jax_enable_compilation_cache"] else None
    if not folder:
        return make()
    digest = hashlib.sha256(key.encode()).hexdigest()
    path = Path(folder) / kind / f"{digest}.{kind}"
    with contextlib.suppress(OSError):  # it is not there
        checksum, _, content = path.read_bytes().partition(b"\n")
        if _checksum(digest, content) == checksum:
            return content
        warnings.warn(f"{path} is damaged: it is ignored and written again", RuntimeWarning, stacklevel=2)
    content = make()
    # A full or read-only disk is no reason not to train; nor is another process that writes the same file.
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, _checksum(digest, content) + b"\n" + content, is_shared=True)
    return content


def _checksum(digest: str, content: bytes) -> bytes:
    return hashlib.sha256(digest.encode() + content).hexdigest().encode()


# --- Sources

_DIRECTORIES = {"kinetix_dist": Path(__file__).resolve().parent, "jax2d": ENGINE.resolve()}
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+((?:kinetix_dist|jax2d)[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|.*)"
    r"|import[ \t]+((?:kinetix_dist|jax2d)[\w.]*))",
    re.MULTILINE,
)
_NO_NAMES = re.compile(r"[()]|#.*")  # among what is imported from a module
_NATIVE_SUFFIXES = (".cu", ".cuh", ".h")  # of CUDA and C++ that kernels are compiled from
_IMPORTED_AT = time.time()  # s since the epoch; about when this process imported the modules whose files are hashed


class _Source(NamedTuple):
    """A file of a closure."""

    checksum: str
    imports: frozenset[str]  # modules, by their full names
    changed_at: float  # s since the epoch


class Closure(NamedTuple):
    """Modules that some modules reach by imports within this project, with a checksum of all sources."""

    modules: tuple[str, ...]
    checksum: str
    is_stale: bool  # a file was changed after this process had imported it: the checksum is of other code


@functools.cache
def closure_of(*modules: str) -> Closure:
    """The closure of modules of this project, given by their full names."""
    reached: dict[str, _Source] = {}
    waiting = set(modules)
    while waiting:
        name = waiting.pop()
        reached[name] = source = _source(name)
        waiting |= source.imports - reached.keys()
    reached = {package: _source(package) for name in reached for package in _packages_around(name)} | reached
    lines = [f"{name} {reached[name].checksum}" for name in sorted(reached)] + [_native_checksum()]
    return Closure(
        modules=tuple(sorted(reached)),
        checksum=hashlib.sha256("\n".join(lines).encode()).hexdigest(),
        is_stale=any(source.changed_at > _IMPORTED_AT for source in reached.values()),
    )


@functools.cache
def _native_checksum() -> str:
    files = [file for folder in _DIRECTORIES.values() for file in sorted(folder.rglob("*"))]
    return hashlib.sha256(b"".join(map(_content, filter(is_native, files)))).hexdigest()


def is_native(file: Path) -> bool:
    """True for a source of CUDA or C++."""
    return file.suffix in _NATIVE_SUFFIXES


@functools.cache
def _source(module: str) -> _Source:
    file = _file_of(module)
    assert file is not None, f"{module} is no module of this project"
    content = _content(file)
    status = file.stat()
    changed_at = max(status.st_mtime, status.st_ctime)  # the latter moves also where the former is restored
    return _Source(hashlib.sha256(content).hexdigest(), frozenset(_imports_of(content.decode())), changed_at)


def _imports_of(text: str) -> Iterable[str]:
    """Modules of this project that a source imports anywhere: at its top, in functions, for types. `from a import b`
    imports a.b where that is a module, and else a."""
    for package, names, module in _IMPORT.findall(text):
        inner = [f"{package}.{name.split()[0]}" for name in _NO_NAMES.sub("", names).split(",") if name.strip()]
        yield from (name if _file_of(name) else package for name in inner)
        if module:
            yield module


def _packages_around(module: str) -> Iterable[str]:
    """Packages inside which a module lies. They are run before it, but it does not use what they import."""
    names = module.split(".")
    return (".".join(names[:end]) for end in range(1, len(names)))


@functools.cache
def _file_of(module: str) -> Path | None:
    """File of a module by its full name; None where there is no such module."""
    package, *names = module.split(".")
    base = _DIRECTORIES[package].joinpath(*names)
    for file in (base / "__init__.py", base.with_name(f"{base.name}.py")):
        if file.is_file():
            return file
    return None


def _content(file: Path) -> bytes:
    return file.read_bytes()


def is_cacheable(*parts: object) -> bool:
    """True where the classes of all parts are of this project, so that a key sees it when their code changes."""
    return all(_module_of(part).partition(".")[0] in _DIRECTORIES for part in parts)


def cache_key(part: object) -> tuple[str, str, object]:
    """Key of an object: its class and its attributes; of a class, its name."""
    if isinstance(part, type):
        return part.__module__, part.__qualname__, None
    attributes = part if dataclasses.is_dataclass(part) else vars(part)
    return type(part).__module__, type(part).__qualname__, attributes


def _module_of(part: object) -> str:
    return (part if isinstance(part, type) else type(part)).__module__


# --- Exported programs

# A process loads a program with such a call only after this module, which says in an environment variable where the
# library is that starts the kernels. A process that traces a kernel has imported it.
_NEEDED_BY_CALLS = {"@mosaic_gpu": "jax.experimental.mosaic.gpu"}
_ADDRESS = re.compile(r"<([\w.]+) object at 0x[0-9a-f]+>")
Settings = tuple[tuple[str, Any], ...]


class _Stored(NamedTuple):
    """A program as a file has it."""

    program: bytes
    results: Any  # structure of the results, with numbers for arrays
    launches: list[Any]  # of kernels of the engine, `jax2d.warp.ffi.Launch`
    modules: list[str]  # that have to be imported before it is loaded


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProgramKey:
    """Everything that decides what a function computes besides its arguments, JAX and the devices."""

    kind: str  # folder of the cache
    module: str  # usually the caller's `__name__`; it reaches all code that is traced but the classes of `parts`
    parts: tuple[object, ...] = ()  # of classes of this project, see `is_cacheable`
    depends_on: object = None  # anything else; its repr is part of the key
    at_trace: Callable[[], object] = tuple  # gives anything else that is known when it is traced
    custom_calls: tuple[str, ...] = ()  # that the program may make besides the engine's and those that JAX keeps stable

    @property
    def closure(self) -> Closure:
        return closure_of(self.module, *map(_module_of, self.parts))


def exported(
    function: Callable[..., Any], key: ProgramKey, *, shardings: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """Returns a function that computes the same, traced only where no process has done that for equal arguments.

    function: of trees of arrays. shardings: gives those of the arguments, as a tree like them, where they matter.
    """
    import jax

    @functools.cache
    def program(structure: Any, shapes: tuple[jax.ShapeDtypeStruct, ...], settings: Settings) -> Callable[..., Any]:
        def of_leaves(*leaves: jax.Array) -> Any:
            return function(*jax.tree.unflatten(structure, leaves))

        if key.closure.is_stale:
            warnings.warn(
                f"a source of {key.kind} was changed after this process began: their program is not cached",
                RuntimeWarning,
                stacklevel=3,
            )
            return of_leaves
        # A thread begins without the mesh and the axes that this one may be tracing on. They are not part of a program.
        with ThreadPoolExecutor(1) as thread:
            context = contextvars.copy_context()
            arguments = key, of_leaves, str(structure), shapes, settings
            return _loaded(thread.submit(context.run, _stored, *arguments).result())

    def call(*inputs: Any) -> Any:
        leaves, structure = jax.tree.flatten(inputs)
        placed = [None] * len(leaves) if shardings is None else jax.tree.leaves(shardings(*inputs))
        shapes = tuple(
            jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)
            for x, sharding in zip(leaves, placed, strict=True)
        )
        return program(structure, shapes, current_settings())(*leaves)

    call.__name__ = call.__qualname__ = function.__name__  # in profiles and logs
    return call


def exported_on_mesh(
    function: Callable[..., Any], key: ProgramKey, mesh: Mesh, *, in_specs: Sequence[Any], out_specs: Any
) -> Any:
    """Returns `exported(function, key)` as `jax.jit` would give it. in_specs, out_specs: of arguments and results on
    `mesh`, trees of `PartitionSpec`, each of which may stand for a whole tree of arrays."""

    import jax
    from jax.sharding import NamedSharding

    def shardings(*inputs: Any) -> Any:
        specs = jax.tree.broadcast(tuple(in_specs), inputs)
        return jax.tree.map(lambda _, spec: NamedSharding(mesh, spec), inputs, specs)

    call = exported(function, key, shardings=shardings)
    return jax.jit(call, out_shardings=jax.tree.map(functools.partial(NamedSharding, mesh), out_specs))


def current_settings() -> Settings:
    """(name, value) of JAX's public settings as this thread has them, context managers included."""
    return tuple((state.__name__, state.value) for state in _public_states())


@functools.cache
def _public_states() -> tuple[Any, ...]:
    import jax
    from jax._src import config  # no public way lists them (jax 0.10)

    return tuple(state for state in config.config_states.values() if getattr(jax, state.__name__, None) is state)


def _stored(
    key: ProgramKey,
    function: Callable[..., Any],
    structure: str,
    shapes: Sequence[jax.ShapeDtypeStruct],
    settings: Settings,
) -> _Stored:
    """The program as stored, read or traced. Runs in a thread of its own with the settings of the caller's thread."""
    from jax._src import config  # no public way tells what JAX traces by (jax 0.10)

    with contextlib.ExitStack() as stack:
        for state, (_, value) in zip(_public_states(), settings, strict=True):
            if state.value != value:
                stack.enter_context(state(value))
        made_by = key.closure.checksum, _versions(), _devices(), _ADDRESS.sub(r"\1", repr(config.trace_context()))
        made_of = *map(cache_key, key.parts), key.depends_on, key.at_trace()
        arguments = structure, [(x.shape, x.dtype.name, str(x.sharding)) for x in shapes]
        text = repr((made_by, made_of, arguments))
        content = cached_file(key.kind, text, lambda: _traced(function, shapes, key.custom_calls))
    return pickle.loads(content)  # by a process that may write programs there


def _traced(function: Callable[..., Any], shapes: Sequence[jax.ShapeDtypeStruct], custom_calls: Sequence[str]) -> bytes:
    import jax
    from jax import export

    from jax2d.warp import ffi  # here: a process that exports nothing does without

    structures = []

    def of_leaves(*leaves: jax.Array) -> list[jax.Array]:
        found, structure = jax.tree.flatten(function(*leaves))
        structures.append(structure)
        return found

    program = jax.jit(of_leaves)
    program.trace(*shapes)  # from now on kernels have names
    allowed = [export.DisabledSafetyCheck.custom_call(name) for name in (*custom_calls, *ffi.targets())]
    made = export.export(program, disabled_checks=allowed)(*shapes)
    structure = structures[-1]
    numbered = jax.tree.unflatten(structure, range(structure.num_leaves))
    text = made.mlir_module()
    modules = [module for call, module in _NEEDED_BY_CALLS.items() if call in text]
    return pickle.dumps(_Stored(bytes(made.serialize()), numbered, ffi.launches_of(text), modules))


def _loaded(stored: _Stored) -> Callable[..., Any]:
    import jax
    from jax import export

    for module in stored.modules:
        import_module(module)
    for launch in stored.launches:
        launch.register()
    program, results = export.deserialize(bytearray(stored.program)), jax.tree.structure(stored.results)
    return lambda *leaves: jax.tree.unflatten(results, program.call(*leaves))


@functools.cache
def _versions() -> tuple[str, ...]:
    return tuple(map(importlib.metadata.version, _VERSIONS_OF))


def _devices() -> tuple[str, str]:
    import jax

    return jax.default_backend(), jax.local_devices()[0].device_kind
