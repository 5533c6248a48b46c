"""CUDA C++ to PTX by NVIDIA's compiler at run time (NVRTC), a library that comes with jax[cuda13] and jax[cuda12].

PTX is for compute capability 8.0, and says that it is of the version that brought what the kernels use: NVRTC writes
its own, which is often newer than a driver that is new enough takes. The driver compiles it for the device, and keeps
the result in its cache.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import re
from collections.abc import Callable, Mapping
from pathlib import Path

ARCHITECTURE = "compute_80"
PTX_VERSION = "7.1"  # of CUDA 11.1, November 2020
NAMES = ("libnvrtc.so.13", "libnvrtc.so.12")


class NvrtcError(RuntimeError):
    """There is no compiler, or it does not take a source."""


@functools.cache
def library() -> ctypes.CDLL:
    """Of the packages of NVIDIA, or of the system. Raises NvrtcError where there is none."""
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
    options = [
        f"--gpu-architecture={ARCHITECTURE}",
        "--std=c++17",
        *(f"-D{name}={value}" for name, value in macros.items()),
    ]
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
