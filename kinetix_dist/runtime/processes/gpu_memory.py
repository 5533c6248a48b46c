"""Memory of a GPU: the budget of each process on it, and how much is in use.

XLA takes its pool in advance, so the needs of others have to be left out of it.

    budget    of a process: the curator what its scoring needs, a worker (learner, rollout actor) the rest of its GPU
    reserve   of a budget, outside of XLA's pool: CUDA context, loaded programs, local memory of the engine's threads,
              NCCL where several processes form one JAX world
    pool      budget - reserve; XLA gets its share of the GPU before JAX starts

Budgets follow from the run's configuration (`MemoryNeeds`) and from the GPU that a process finds itself on (`Gpu`), so
processes that share a GPU come to the same table without asking each other. Measured on one H200, jax 0.11: a context
takes 528 to 560 MiB, loaded programs about 250 MiB more, XLA exactly its share, the engine's threads exactly
`local_memory_bytes` of their `thread_bytes`. What NCCL takes is an estimate.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

from jax2d.scene import Capacity
from kinetix_dist.config import TrainConfig
from kinetix_dist.evaluation.evaluate import MAX_WORLDS
from kinetix_dist.evaluation.evaluation_sets import largest_size_played

MIB = 1 << 20
GIB = 1 << 30

CONTEXT_BYTES = 640 * MIB  # a JAX process: 560 measured
PROGRAMS_BYTES = 512 * MIB  # loaded programs: 250 measured
NCCL_BYTES = 1536 * MIB  # channels and buffers of a rank: an estimate, a few hundred for two GPUs
UNUSED_SHARE = 0.02  # of a GPU, left free: rounding, fragments, what else runs on it
MIN_POOL_BYTES = 256 * MIB  # less is taken for a mistake

# Local memory that CUDA sets aside for a thread comes on top of what the context has already.
CONTEXT_THREAD_BYTES = 1024
# What the engine keeps for a world in the local memory of its thread, in numbers of 4 bytes: fitted to the compiled
# kernels of nine capacities around S, M and L (to 2 %; tests/runtime/test_gpu_memory.py), raised by a margin for later
# kernels.
THREAD_NUMBERS = 98
NUMBERS_OF = {"polygons": 49, "circles": 33, "joints": 87, "thrusters": 4, "contact_slots": 20}
THREAD_MARGIN = 1.15

# Scoring: what is alive at once for a level, in numbers of 4 bytes. M with the paper's network: 71 kB, and 4,096 levels
# were measured at 309 MiB with all else. Hence a margin of four.
SCORING_TENSORS = 8  # of tokens
SCORING_MARGIN = 4
CANDIDATE_BYTES = 16 * 1024  # a level twice, while the best are selected
MIN_CURATOR_POOL_BYTES = GIB


class GpuMemoryError(ValueError):
    """The processes of a run do not fit on a GPU, with the numbers and what to change."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gpu:
    """The GPU that a process finds itself on."""

    name: str
    total_bytes: int  # that CUDA gives to programs
    num_sms: int
    threads_per_sm: int  # resident at once


@dataclasses.dataclass(frozen=True, kw_only=True)
class MemoryNeeds:
    """Needs of one process on a GPU, known before there is one."""

    process: str  # "worker 0"
    thread_bytes: int  # local memory of a thread of its largest engine
    num_in_group: int = 1  # processes of its JAX world
    pool_bytes: int | None = None  # that XLA needs; None: whatever the others leave
    budget_bytes: int | None = None  # as configured, reserve included; replaces pool_bytes


@dataclasses.dataclass(frozen=True, kw_only=True)
class GpuShare:
    """All processes of a run on one GPU."""

    needs: tuple[MemoryNeeds, ...]
    limit_bytes: int | None = None  # of the GPU, for all of them; None: all of it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """Budget of one process on its GPU."""

    process: str
    gpu: Gpu
    total_bytes: int
    reserve_bytes: int

    @property
    def pool_bytes(self) -> int:
        return self.total_bytes - self.reserve_bytes

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables that XLA reads before JAX starts."""
        return {
            "XLA_PYTHON_CLIENT_PREALLOCATE": "true",
            "XLA_CLIENT_MEM_FRACTION": f"{self.pool_bytes / self.gpu.total_bytes:.6f}",
        }


def share_of_gpu(config: TrainConfig, processes: Sequence[tuple[str, int]], *, num_in_group: int) -> GpuShare:
    """The needs of the processes, (role, index) each, that a run places on one GPU."""
    phases = [phase.config for phase in config.schedule.phases]
    thread = max(thread_bytes(phase.env.capacity) for phase in phases)
    needs = []
    for role, index in processes:
        process = f"{role} {index}"
        if role == "curator":
            by_hand = config.run.curator_memory_gib
            needs.append(
                MemoryNeeds(
                    process=process,
                    thread_bytes=thread,
                    pool_bytes=max(curator_pool_bytes(phase) for phase in phases),
                    budget_bytes=round(by_hand * GIB) if by_hand else None,
                )
            )
        elif role == "evaluator":
            played = _with_largest_sets(config)
            needs.append(
                MemoryNeeds(
                    process=process,
                    thread_bytes=thread_bytes(played.env.capacity),
                    pool_bytes=playing_bytes(played, MAX_WORLDS),
                )
            )
        else:
            needs.append(MemoryNeeds(process=process, thread_bytes=thread, num_in_group=num_in_group))
    limit = config.run.gpu_memory_gib
    return GpuShare(needs=tuple(needs), limit_bytes=round(limit * GIB) if limit else None)


def _with_largest_sets(config: TrainConfig) -> TrainConfig:
    """The config with levels as large as the largest that are evaluated."""
    size = largest_size_played(config.evaluation.sets, config.env.size)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, size=size))


def budget_of(process: str, share: GpuShare, gpu: Gpu) -> Budget:
    """The budget of one of the processes of a GPU; raises GpuMemoryError where they do not fit."""
    limit = gpu.total_bytes if share.limit_bytes is None else min(share.limit_bytes, gpu.total_bytes)
    left = int(limit * (1 - UNUSED_SHARE))
    reserves = {needs.process: reserve_bytes(needs, gpu) for needs in share.needs}
    totals: dict[str, int] = {}
    for needs in share.needs:
        if needs.budget_bytes is not None:
            totals[needs.process] = needs.budget_bytes
        elif needs.pool_bytes is not None:
            totals[needs.process] = needs.pool_bytes + reserves[needs.process]
    others = [needs.process for needs in share.needs if needs.process not in totals]
    rest = left - sum(totals.values())
    totals |= {name: rest // len(others) for name in others}
    budgets = {
        name: Budget(process=name, gpu=gpu, total_bytes=total, reserve_bytes=reserves[name])
        for name, total in totals.items()
    }
    if sum(totals.values()) > left or min(budget.pool_bytes for budget in budgets.values()) < MIN_POOL_BYTES:
        parts = (
            f"{name} {gib(b.total_bytes)}, {gib(b.reserve_bytes)} of it outside of XLA" for name, b in budgets.items()
        )
        raise GpuMemoryError(
            f"the processes of this run do not fit into {gib(left)} of {gpu.name} ({'; '.join(parts)}); "
            "change run.curator_memory_gib or run.gpu_memory_gib, lower curriculum.scoring_batch, or use a larger GPU"
        )
    return budgets[process]


def reserve_bytes(needs: MemoryNeeds, gpu: Gpu) -> int:
    """Bytes that a process takes outside of XLA's pool."""
    nccl = NCCL_BYTES if needs.num_in_group > 1 else 0
    return CONTEXT_BYTES + PROGRAMS_BYTES + local_memory_bytes(needs.thread_bytes, gpu) + nccl


def local_memory_bytes(thread_bytes: int, gpu: Gpu) -> int:
    """Bytes that CUDA sets aside for all resident threads, once a process, for its most demanding kernel."""
    return max(0, thread_bytes - CONTEXT_THREAD_BYTES) * gpu.num_sms * gpu.threads_per_sm


def thread_bytes(capacity: Capacity) -> int:
    """Upper estimate of the local memory of a thread of the full engine of this capacity, bytes.

    4 x 1.15 x (98 + 49 polygons + 33 circles + 87 joints + 4 thrusters + 20 contact slots)
    """
    numbers = THREAD_NUMBERS + sum(number * getattr(capacity, name) for name, number in NUMBERS_OF.items())
    return round(4 * THREAD_MARGIN * numbers)


def curator_pool_bytes(config: TrainConfig) -> int:
    """Bytes of XLA's pool for scoring a batch of levels, and the candidates of a refresh."""
    curriculum = config.curriculum
    return playing_bytes(config, curriculum.scoring_batch, extra=CANDIDATE_BYTES * curriculum.num_candidates)


def playing_bytes(config: TrainConfig, num_worlds: int, *, extra: int = 0) -> int:
    """Bytes of XLA's pool for playing so many worlds at once without learning, with a margin of four, plus `extra`."""
    capacity, policy = config.env.capacity, config.policy
    rows = capacity.shapes + 1 + 2 * capacity.joints + capacity.thrusters
    numbers = SCORING_TENSORS * rows * policy.encoder_size + 2 * policy.num_heads * capacity.shapes**2
    return max(MIN_CURATOR_POOL_BYTES, SCORING_MARGIN * 4 * numbers * num_worlds + extra)


def this_gpu() -> Gpu:
    """The first GPU that CUDA shows to this process. Takes no memory of it.

    Asked of the driver itself: nvidia-smi names no SMs, and lists GPUs as they are built in rather than what this
    process may use of them. Raises GpuMemoryError where there is no driver or no GPU.
    """
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise GpuMemoryError(f"the NVIDIA driver cannot be loaded ({error}); use --run.device cpu") from None
    device, total = ctypes.c_int(), ctypes.c_size_t()
    name = ctypes.create_string_buffer(256)
    values = {attribute: ctypes.c_int() for attribute in (_MULTIPROCESSOR_COUNT, _MAX_THREADS_PER_MULTIPROCESSOR)}
    status = (
        cuda.cuInit(0)
        or cuda.cuDeviceGet(ctypes.byref(device), 0)
        or cuda.cuDeviceGetName(name, len(name), device)
        or cuda.cuDeviceTotalMem_v2(ctypes.byref(total), device)
    )
    for attribute, value in values.items():
        status = status or cuda.cuDeviceGetAttribute(ctypes.byref(value), attribute, device)
    if status:
        raise GpuMemoryError(f"the NVIDIA driver answers with CUDA error {status} to this process; see `doctor`")
    return Gpu(
        name=name.value.decode(),
        total_bytes=total.value,
        num_sms=values[_MULTIPROCESSOR_COUNT].value,
        threads_per_sm=values[_MAX_THREADS_PER_MULTIPROCESSOR].value,
    )


# Of the CUDA driver's CUdevice_attribute.
_MULTIPROCESSOR_COUNT = 16
_MAX_THREADS_PER_MULTIPROCESSOR = 39


def gib(num_bytes: int) -> str:
    return f"{num_bytes / GIB:.1f} GiB"


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
    """Share of this process's GPU that all programs together use; None on a CPU, or where the driver does not say."""
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
    """XLA's pool on this process's GPU; None on a CPU, or where JAX does not say."""
    import jax

    statistics = (jax.local_devices()[0].memory_stats() if jax.default_backend() == "gpu" else None) or {}
    used, peak, limit = (statistics.get(name) for name in ("bytes_in_use", "peak_bytes_in_use", "bytes_limit"))
    return Pool(used, peak, limit) if limit and used is not None and peak is not None else None
