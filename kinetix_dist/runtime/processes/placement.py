"""Placement of roles: processes, their devices and environment variables. Pure: no process is started here.

colocated   N workers, one a GPU (on CPU one, or as many as requested), each with worlds and a learner shard; lag 0
split       N learners that form one JAX world, and rollout actors on devices of their own; lag 1
both        curators, at most one a GPU, and an evaluator where evaluations or recordings are due during training, on
            the GPUs of the first workers (or rollout actors; where these play on CPUs: learners), whose memory they
            share

`Resources` are those of a Ray cluster, which a placement needs: CPU slots and GPUs.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Iterable, Mapping, Sequence

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.processes.gpu_memory import GpuShare, share_of_gpu

# Roles whose processes form one JAX world where there are several: gradients go from one to the other.
ROLES_OF_GROUPS = ("worker", "learner")


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

    @property
    def joins_group(self) -> bool:
        """Says whether it forms one JAX world with the others of its role."""
        return self.role in ROLES_OF_GROUPS


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placement:
    """All processes of a run."""

    processes: tuple[ProcessPlan, ...]

    def of(self, role: str) -> tuple[ProcessPlan, ...]:
        return tuple(process for process in self.processes if process.role == role)


def plan_placement(config: TrainConfig, *, num_gpus: int) -> Placement:
    """The processes of a run on a machine with `num_gpus` GPUs; raises PlacementError where they do not fit."""
    on_gpus = resolve_device(config.run.device, num_gpus=num_gpus) == "gpu"
    is_split = config.run.placement == "split"
    devices = _of_split(config) if is_split else _of_colocated(config, num_gpus if on_gpus else 1)
    num_on_cpu = config.run.num_cpu_rollout_actors if is_split and on_gpus else 0
    devices, on_cpu = devices[: len(devices) - num_on_cpu], devices[len(devices) - num_on_cpu :]
    if on_gpus and len(devices) > num_gpus:
        raise PlacementError(_too_few_gpus(config, len(devices), num_gpus))
    # Next to those that play, which have least to do of all on a GPU; where none of these has one, next to learners.
    first = config.run.num_learners if is_split else 0
    hosts = devices[first:] or devices
    if config.has_curator:
        for index in range(min(config.run.num_curators, len(hosts)) if on_gpus else config.run.num_curators):
            hosts[index % len(hosts)].append(("curator", index))
    if config.evaluates_in_background:
        hosts[0].append(("evaluator", 0))
    if not on_gpus:
        devices, on_cpu = [], devices
    return Placement(
        processes=_in_order(
            [
                *(process for gpu, roles in enumerate(devices) for process in _on_gpu(config, gpu, roles, devices)),
                *(_on_cpu(role, index) for roles in on_cpu for role, index in roles),
            ]
        )
    )


_Roles = list[tuple[str, int]]  # (role, index) of the processes on one device


def _of_colocated(config: TrainConfig, num_devices: int) -> list[_Roles]:
    num_workers = config.run.num_workers or num_devices
    _check_blocks(config, num_workers, "worker")
    return [[("worker", index)] for index in range(num_workers)]


def _of_split(config: TrainConfig) -> list[_Roles]:
    run = config.run
    _check_blocks(config, run.num_learners, "learner")
    learners = [[("learner", index)] for index in range(run.num_learners)]
    return learners + [[("rollout", index)] for index in range(run.num_rollout_actors)]


def check_devices_here(config: TrainConfig, num_devices: int) -> None:
    """Raises PlacementError where local mode has more devices than parts of a batch to give them."""
    if num_devices > config.num_blocks:
        raise PlacementError(
            f"{num_devices} devices cannot share {config.num_blocks} blocks of worlds: some would have none; show "
            "fewer to this process (CUDA_VISIBLE_DEVICES, or --xla_force_host_platform_device_count of XLA_FLAGS), or "
            f"raise rollout.num_groups {config.rollout.num_groups} and ppo.virtual_shards {config.ppo.virtual_shards}"
        )


def _check_blocks(config: TrainConfig, number: int, role: str) -> None:
    if number > config.num_blocks:
        raise PlacementError(
            f"{number} {role}s cannot share {config.num_blocks} blocks of worlds: some would have none; lower "
            f"run.num_{role}s, or raise rollout.num_groups {config.rollout.num_groups} and ppo.virtual_shards "
            f"{config.ppo.virtual_shards}"
        )


def _too_few_gpus(config: TrainConfig, needed: int, there: int) -> str:
    run = config.run
    if run.placement == "colocated":
        return f"run.num_workers {run.num_workers} needs as many GPUs; there are {there}"
    return (
        f"split placement with {counted(run.num_learners, 'learner')} and "
        f"{counted(run.num_rollout_actors, 'rollout')}, {run.num_cpu_rollout_actors} of them on CPUs, needs {needed} "
        f"GPUs of {there}; lower run.num_learners or run.num_rollout_actors, raise run.num_cpu_rollout_actors, or use "
        "run.placement colocated"
    )


def counted(number: int, role: str) -> str:
    """ "1 learner", "2 rollout actors" """
    name = "rollout actor" if role == "rollout" else role
    return f"{number} {name}{'' if number == 1 else 's'}"


def resolve_device(device: str, *, num_gpus: int) -> str:
    """Resolves "auto" to "cpu" or "gpu"; raises PlacementError when a GPU is requested and none is there."""
    if device == "gpu" and num_gpus == 0:
        raise PlacementError("run.device is gpu, but no GPU is visible here; use --run.device cpu, or see `doctor`")
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


def _on_gpu(config: TrainConfig, gpu: int, roles: _Roles, devices: Sequence[_Roles]) -> list[ProcessPlan]:
    """The processes of one GPU; each knows of the others, since all of them share its memory."""
    num_in_group = sum(role == roles[0][0] for others in devices for role, _ in others)
    num_in_group = num_in_group if roles[0][0] in ROLES_OF_GROUPS else 1
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


@dataclasses.dataclass(frozen=True)
class Resources:
    """Resources for processes: one CPU slot each, and GPUs."""

    cpus: int
    gpus: int

    def __add__(self, other: Resources) -> Resources:
        return Resources(self.cpus + other.cpus, self.gpus + other.gpus)

    def at_most(self, other: Resources) -> Resources:
        return Resources(min(self.cpus, other.cpus), min(self.gpus, other.gpus))

    def holds(self, needed: Resources) -> bool:
        return self.cpus >= needed.cpus and self.gpus >= needed.gpus


def needed_by(placement: Placement) -> Resources:
    gpus = {process.gpu for process in placement.processes if process.gpu is not None}
    return Resources(len(placement.processes), len(gpus))


def total_resources() -> Resources:
    """Resources of all nodes that live."""
    import ray

    return _resources(ray.cluster_resources())


def free_resources() -> Resources:
    """Resources that no process holds."""
    import ray

    return _resources(ray.available_resources())


def nodes_in_words() -> str:
    """ "node-1 (8 CPU slots, 4 GPUs), node-2 (8 CPU slots, 4 GPUs), 1 lost" """
    import ray

    nodes = ray.nodes()
    living = [f"{node['NodeManagerHostname']} ({_in_words(node['Resources'])})" for node in nodes if node["Alive"]]
    num_lost = len(nodes) - len(living)
    return ", ".join([*living, *([f"{num_lost} lost"] if num_lost else [])])


def _in_words(resources: Mapping[str, float]) -> str:
    slots = _resources(resources)
    return f"{slots.cpus} CPU slots, {slots.gpus} GPUs"


def _resources(resources: Mapping[str, float]) -> Resources:
    return Resources(int(resources.get("CPU", 0)), int(resources.get("GPU", 0)))
