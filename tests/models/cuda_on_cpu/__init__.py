"""Kernels of kinetix_dist/models/kernels/cuda on the CPU, by a C++ compiler: see cuda_on_cpu.h.

`call` stands in for `cuda_kernel.call`. It checks what a kernel must do and a GPU would not tell of: every result is
full of NaN before, and every one of its numbers has to be written. Where NaN is what a test is about, ALLOWS_NAN.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist.models.kernels.cuda_kernel import FOLDER, THREADS, CudaKernel

HERE = Path(__file__).parent
BUILT = HERE.parents[2] / ".cache" / "cuda_on_cpu"
ONE_AT_A_TIME = threading.Lock()  # what stands for a block is global, and XLA calls from several threads
ALLOWS_NAN = False
COMPILER = shutil.which("g++") or shutil.which("clang++")


def call(kernel: CudaKernel, out: Sequence[jax.ShapeDtypeStruct], blocks: int, *operands: jax.Array) -> list[jax.Array]:
    def run(*arrays: jax.Array) -> list[np.ndarray]:
        given = [np.ascontiguousarray(array) for array in arrays]
        results = [np.full(each.shape, np.nan, each.dtype) for each in out]
        library = _library(kernel.file, kernel.macros)
        shared_bytes = ctypes.c_int.in_dll(library, f"{kernel.name}_shared_bytes").value
        pointers = [array.ctypes.data for array in (*given, *results)]
        launch = getattr(library, f"launch_{kernel.name}")
        with ONE_AT_A_TIME:
            launch(blocks, THREADS, shared_bytes, (ctypes.c_void_p * len(pointers))(*pointers))
        for number, result in enumerate(results):
            is_written = ALLOWS_NAN or not np.isnan(result.astype(np.float32)).any()
            assert is_written, f"{kernel.name} does not write all of result {number}"
        return results

    return jax.pure_callback(run, list(out), *(jnp.asarray(operand) for operand in operands))


@functools.cache
def _library(file: str, macros: tuple[tuple[str, int], ...]) -> ctypes.CDLL:
    sources = [*sorted(FOLDER.iterdir()), *sorted(HERE.glob("*.[ch]*"))]
    digest = hashlib.sha256(repr((file, macros, COMPILER)).encode())
    for source in sources:
        digest.update(source.read_bytes())
    built = BUILT / f"{digest.hexdigest()[:24]}.so"
    if not built.exists():
        part = file.removesuffix(".cu").upper()
        options = [f'-DSOURCE="{file}"', f"-DOF_{part}", *(f"-D{name}={value}" for name, value in macros)]
        BUILT.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=BUILT) as folder:
            result = Path(folder) / "kernel.so"
            checks = ["-fsanitize=alignment", "-fsanitize-undefined-trap-on-error"]
            assert COMPILER is not None
            command = [COMPILER, "-std=c++20", "-O1", *checks, "-shared", "-fPIC", f"-I{HERE}", f"-I{FOLDER}", *options]
            subprocess.run([*command, str(HERE / "launch.cpp"), "-o", str(result)], check=True)
            os.replace(result, built)
    return ctypes.CDLL(str(built))
