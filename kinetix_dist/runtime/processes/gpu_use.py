"""How much of a GPU's memory is in use, asked of NVIDIA's management library and of JAX."""

from __future__ import annotations

import ctypes
import functools
from typing import NamedTuple


class _Memory(ctypes.Structure):
    """nvmlMemory_t, bytes."""

    _fields_ = [("total", ctypes.c_ulonglong), ("free", ctypes.c_ulonglong), ("used", ctypes.c_ulonglong)]


_PCI_ID_LENGTH = 32  # more than NVML_DEVICE_PCI_BUS_ID_BUFFER_SIZE asks for


@functools.cache
def _device() -> tuple[ctypes.CDLL, ctypes.c_void_p] | None:
    """NVML and its handle of the first GPU that CUDA shows to this process; None where there is none.

    By PCI address, since NVML counts GPUs as they are built in, whatever CUDA_VISIBLE_DEVICES says.
    """
    try:
        cuda, nvml = ctypes.CDLL("libcuda.so.1"), ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return None
    gpu, handle, address = ctypes.c_int(), ctypes.c_void_p(), ctypes.create_string_buffer(_PCI_ID_LENGTH)
    status = (
        cuda.cuInit(0)
        or cuda.cuDeviceGet(ctypes.byref(gpu), 0)
        or cuda.cuDeviceGetPCIBusId(address, len(address), gpu)
        or nvml.nvmlInit_v2()
        or nvml.nvmlDeviceGetHandleByPciBusId_v2(address, ctypes.byref(handle))
    )
    return None if status else (nvml, handle)


def gpu_used_share() -> float | None:
    """Of this process's GPU, what all programs together use; None on a CPU, or where the driver does not say."""
    import jax

    if jax.default_backend() != "gpu" or (found := _device()) is None:
        return None
    nvml, handle = found
    memory = _Memory()
    if nvml.nvmlDeviceGetMemoryInfo(handle, ctypes.byref(memory)):
        return None
    return memory.used / memory.total


class Pool(NamedTuple):
    """XLA's pool of GPU memory, bytes."""

    used: int
    peak: int  # the most that was in use so far
    limit: int

    @property
    def peak_share(self) -> float:
        return self.peak / self.limit


def pool_use() -> Pool | None:
    """Of this process's GPU; None on a CPU, or where JAX does not say."""
    import jax

    statistics = (jax.local_devices()[0].memory_stats() if jax.default_backend() == "gpu" else None) or {}
    used, peak, limit = (statistics.get(name) for name in ("bytes_in_use", "peak_bytes_in_use", "bytes_limit"))
    return Pool(used, peak, limit) if limit and used is not None and peak is not None else None
