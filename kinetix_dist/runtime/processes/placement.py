"""Who runs where: processes, their devices and their environment variables. Pure: no process is started here.

colocated   N workers, one a GPU (on CPU one, or as many as asked for), each with worlds and a learner shard; lag 0
split       one learner process, and rollout actors on devices of their own; lag 1
both        one curator, and an evaluator where evaluations or recordings are asked for during training, on the GPU of
            the first worker (or rollout actor), whose memory they share
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Iterable, Sequence

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.processes.gpu_memory import GpuShare, share_of_gpu


class PlacementError(ValueError):
    """The roles do not fit on the devices there are."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessPlan:
    """One Ray actor."""

    role: str  # "worker", "learner", "rollout", "curator" or "evaluator"
    index: int  # among those of its role
    gpu: int | None = None  # which of the run's GPUs, counted from 0; None: it computes on the CPU
    gpu_share: float = 0.0  # of that GPU, as Ray counts
    memory: GpuShare | None = None  # all processes on that GPU, and what each needs of it
    env_vars: dict[str, str] = dataclasses.field(default_factory=dict)

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
    on_gpus = resolve_device(config.run.device, num_gpus=num_gpus) == "gpu"
    if config.run.placement == "colocated":
        num_workers = config.run.num_workers or (num_gpus if on_gpus else 1)
        if on_gpus and num_workers > num_gpus:
            raise PlacementError(f"run.num_workers {num_workers} needs as many GPUs; there are {num_gpus}")
        if num_workers > config.num_blocks:
            raise PlacementError(
                f"{num_workers} workers cannot share {config.num_blocks} blocks of worlds: some would have none; lower "
                f"run.num_workers, or raise rollout.num_groups {config.rollout.num_groups} and ppo.virtual_shards "
                f"{config.ppo.virtual_shards}"
            )
        gpus = [[("worker", index)] for index in range(num_workers)]
        beside_curator, num_in_group = 0, num_workers
    else:
        num_rollout = config.run.num_rollout_actors
        if on_gpus and num_gpus < 1 + num_rollout:
            raise PlacementError(
                f"split placement with {num_rollout} rollout actors needs {1 + num_rollout} GPUs of {num_gpus}; "
                "use run.placement colocated"
            )
        gpus = [[("learner", 0)], *([("rollout", index)] for index in range(num_rollout))]
        beside_curator, num_in_group = 1, 1
    if config.has_curator:
        gpus[beside_curator].append(("curator", 0))
    if config.evaluates_beside:
        gpus[beside_curator].append(("evaluator", 0))
    if not on_gpus:
        return Placement(processes=_in_order(_on_cpu(role, index) for gpu in gpus for role, index in gpu))
    return Placement(
        processes=_in_order(
            process for gpu, roles in enumerate(gpus) for process in _on_gpu(config, gpu, roles, num_in_group)
        )
    )


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


def _on_cpu(role: str, index: int) -> ProcessPlan:
    return ProcessPlan(role=role, index=index, env_vars={"JAX_PLATFORMS": "cpu"})


def _on_gpu(config: TrainConfig, gpu: int, roles: Sequence[tuple[str, int]], num_in_group: int) -> list[ProcessPlan]:
    """The processes of one GPU; each knows of the others, since all of them share its memory."""
    passed_on = {name: value for name, value in os.environ.items() if name.startswith("XLA_FLAGS")}
    memory = share_of_gpu(config, roles, num_in_group=num_in_group)
    share = 1.0 / len(roles)  # for Ray's books; how much memory each gets is gpu_memory's
    return [
        ProcessPlan(role=role, index=index, gpu=gpu, gpu_share=share, memory=memory, env_vars=passed_on)
        for role, index in roles
    ]


def _in_order(processes: Iterable[ProcessPlan]) -> tuple[ProcessPlan, ...]:
    """Curator and evaluator last: they are started when they are first needed."""
    return tuple(sorted(processes, key=lambda process: process.role in ("curator", "evaluator")))
