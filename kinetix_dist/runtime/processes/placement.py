"""Who runs where: processes, their devices and their environment variables. Pure: no process is started here.

colocated   N workers, one a GPU (on CPU one, or as many as asked for), each with worlds and a learner shard; lag 0
split       one learner process, and rollout actors on devices of their own; lag 1
both        one curator: on the GPU of the first worker with a share of its memory, on CPU in a process of its own
"""

from __future__ import annotations

import dataclasses
import os
import subprocess

from kinetix_dist.config import TrainConfig

CURATOR_GPU_SHARE = 0.25  # of a GPU's memory, when the curator scores on the GPU of a worker


class PlacementError(ValueError):
    """The roles do not fit on the devices there are."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessPlan:
    """One Ray actor."""

    role: str  # "worker", "learner", "rollout" or "curator"
    index: int  # among those of its role
    gpu_share: float  # 0: it computes on the CPU
    env_vars: dict[str, str]

    @property
    def name(self) -> str:
        return f"{self.role} {self.index}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placement:
    """All processes of a run."""

    processes: tuple[ProcessPlan, ...]

    def of(self, role: str) -> tuple[ProcessPlan, ...]:
        return tuple(process for process in self.processes if process.role == role)


def plan(config: TrainConfig, *, num_gpus: int) -> Placement:
    """The processes of a run on a machine with `num_gpus` GPUs; raises PlacementError where they do not fit."""
    use_gpu = resolve_device(config.run.device, num_gpus=num_gpus) == "gpu"
    processes: list[ProcessPlan] = []
    has_curator = config.curriculum.has_buffer
    if config.run.placement == "colocated":
        num_workers = config.run.num_workers or (num_gpus if use_gpu else 1)
        if use_gpu and num_workers > num_gpus:
            raise PlacementError(f"run.num_workers {num_workers} needs as many GPUs; there are {num_gpus}")
        if config.rollout.num_groups % num_workers:
            raise PlacementError(
                f"{num_workers} workers cannot share {config.rollout.num_groups} world groups evenly; "
                "change run.num_workers or rollout.num_groups"
            )
        share = 1.0 - CURATOR_GPU_SHARE if has_curator else 1.0
        processes += [_process("worker", index, share if use_gpu else 0.0) for index in range(num_workers)]
    else:
        num_rollout = config.run.num_rollout_actors
        if use_gpu and num_gpus < 1 + num_rollout:
            raise PlacementError(
                f"split placement with {num_rollout} rollout actors needs {1 + num_rollout} GPUs of {num_gpus}; "
                "use run.placement colocated"
            )
        share = 1.0 - CURATOR_GPU_SHARE if has_curator else 1.0
        processes.append(_process("learner", 0, 1.0 if use_gpu else 0.0))
        processes += [_process("rollout", index, share if use_gpu else 0.0) for index in range(num_rollout)]
    if has_curator:
        processes.append(_process("curator", 0, CURATOR_GPU_SHARE if use_gpu else 0.0))
    return Placement(processes=tuple(processes))


def resolve_device(device: str, *, num_gpus: int) -> str:
    """Which of "cpu" and "gpu"; raises PlacementError when a GPU is asked for and none is there."""
    if device == "gpu" and num_gpus == 0:
        raise PlacementError("run.device is gpu, but no GPU is visible here; use --run.device cpu, or ask `doctor` why")
    if device == "auto":
        return "gpu" if num_gpus else "cpu"
    return device


def count_gpus() -> int:
    """NVIDIA GPUs this process may use, without initialising CUDA; 0 where JAX is held to the CPU."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms and not {"cuda", "gpu"} & set(platforms.split(",")):
        return 0
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return len([device for device in visible.split(",") if device.strip() not in ("", "-1")])
    try:
        listing = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return 0
    return sum(line.startswith("GPU ") for line in listing.stdout.splitlines())


def _process(role: str, index: int, gpu_share: float) -> ProcessPlan:
    if not gpu_share:
        return ProcessPlan(role=role, index=index, gpu_share=0.0, env_vars={"JAX_PLATFORMS": "cpu"})
    memory = {"XLA_PYTHON_CLIENT_PREALLOCATE": "true"}
    if gpu_share < 1.0:  # two JAX processes on this GPU: each is told its part, less what CUDA itself takes
        memory["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.95 * gpu_share:.3f}"
    passed_on = {name: value for name, value in os.environ.items() if name.startswith(("NCCL_", "XLA_FLAGS"))}
    return ProcessPlan(role=role, index=index, gpu_share=gpu_share, env_vars={**passed_on, **memory})
