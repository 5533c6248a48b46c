"""CUDA C++ to PTX by NVIDIA's compiler at run time (NVRTC), a library that comes with jax[cuda13] and jax[cuda12].

PTX is for compute capability 8.0, and says that it is of the version that brought what the kernels use: NVRTC writes
its own, which is often newer than a driver that is new enough takes. The driver compiles it for the device, and keeps
the result in its cache.

Every process needs the texts before it can ask JAX's compile cache for a program with these kernels, and the compiler
takes about a second a source: so they are stored in a folder of that cache.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from kinetix_dist.program_cache import cached_file

ARCHITECTURE = "compute_80"
PTX_VERSION = "7.1"  # of CUDA 11.1, November 2020
NAMES = ("libnvrtc.so.13", "libnvrtc.so.12")
OPTIONS = (f"--gpu-architecture={ARCHITECTURE}", "--std=c++17")
CACHE = "ptx"  # folder of texts in JAX's compile cache


class NvrtcError(RuntimeError):
    """No compiler was found, or it refused a source."""


@functools.cache
def library() -> ctypes.CDLL:
    """Library of the packages of NVIDIA, or of the system. Raises NvrtcError where there is none."""
    for name in (*_in_packages(), *NAMES):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise NvrtcError(f"{' or '.join(NAMES)} is not installed; it comes with the extra cuda13 or cuda12 of this package")


@functools.cache
def check_compiler() -> None:
    """Raises NvrtcError where there is none, or where it lacks what it needs: a library of built-in functions."""
    compile_ptx("", "nothing.cu", headers={}, macros={})


def cached_ptx(source: str, name: str, *, headers: Mapping[str, str], macros: Mapping[str, int]) -> str:
    """Result of `compile_ptx`, read from JAX's compile cache where it is on and has it."""
    given = source, name, sorted(headers.items()), sorted(macros.items())
    key = repr((*given, OPTIONS, PTX_VERSION, compiler_version()))
    make = functools.partial(compile_ptx, source, name, headers=headers, macros=macros)
    return cached_file(CACHE, key, lambda: make().encode()).decode()


def compile_ptx(source: str, name: str, *, headers: Mapping[str, str], macros: Mapping[str, int]) -> str:
    """PTX of a source with these headers, by the name that it includes them by. Raises NvrtcError."""
    program = ctypes.c_void_p()
    contents = (ctypes.c_char_p * len(headers))(*(text.encode() for text in headers.values()))
    names = (ctypes.c_char_p * len(headers))(*(header.encode() for header in headers))
    _check(
        library().nvrtcCreateProgram(
            ctypes.byref(program), source.encode(), name.encode(), len(headers), contents, names
        )
    )
    options = [*OPTIONS, *(f"-D{name}={value}" for name, value in macros.items())]
    try:
        status = library().nvrtcCompileProgram(
            program, len(options), (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        )
        if status:
            raise NvrtcError(
                f"{name}: {_text(program, library().nvrtcGetProgramLogSize, library().nvrtcGetProgramLog)}"
            )
        ptx = _text(program, library().nvrtcGetPTXSize, library().nvrtcGetPTX)
    finally:
        library().nvrtcDestroyProgram(ctypes.byref(program))
    return re.sub(r"(?m)^\.version .*$", f".version {PTX_VERSION}", ptx, count=1)


def compiler_version() -> tuple[int, ...]:
    """Cache key of the compiler: version, and bytes of the library where it is a file of a package."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    _check(library().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
    file = Path(library()._name)
    return major.value, minor.value, file.stat().st_size if file.is_file() else 0


def _in_packages() -> list[str]:
    spec = importlib.util.find_spec("nvidia")
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    return [str(file) for name in NAMES for folder in folders for file in sorted(Path(folder).glob(f"*/lib/{name}"))]


def _text(program: ctypes.c_void_p, size_of: Callable[..., int], get: Callable[..., int]) -> str:
    size = ctypes.c_size_t()
    _check(size_of(program, ctypes.byref(size)))
    text = ctypes.create_string_buffer(size.value)
    _check(get(program, text))
    return text.value.decode()


def _check(status: int) -> None:
    if status:
        raise NvrtcError(f"NVRTC says {status}")
