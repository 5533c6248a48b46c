"""Lanes: what one arm at a time has to itself. On GPUs one GPU each, on CPUs as many cores each."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
from pathlib import Path

from kinetix_dist.child_python import command_of
from kinetix_dist.errors import UserError

FREE_BELOW_MIB = 1024  # of memory in use: an idle GPU's driver holds some hundred at most
_QUERY = ["nvidia-smi", "--query-gpu=index,uuid,memory.used", "--format=csv,noheader,nounits"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lane:
    """Devices of one arm."""

    name: str
    gpu: str | None = None  # as CUDA_VISIBLE_DEVICES names it
    cores: tuple[int, ...] = ()  # numbers of CPU cores; (): all

    @property
    def environment(self) -> dict[str, str]:
        """Variables with which a process sees this lane alone."""
        if self.gpu is not None:
            return {"CUDA_VISIBLE_DEVICES": self.gpu}
        return {"CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}


def cpu_lanes(asked: int) -> list[Lane]:
    """asked: how many; 0: one with all cores. Raises UserError for more than there are cores."""
    cores = sorted(os.sched_getaffinity(0))
    if asked > len(cores):
        raise UserError(f"{asked} lanes are asked for, but this process may use {len(cores)} CPU cores; lower --lanes")
    count = asked or 1
    size, more = divmod(len(cores), count)
    lanes, first = [], 0
    for number in range(count):
        own = cores[first : first + size + (number < more)]
        first += len(own)
        lanes.append(Lane(name=f"cpu {own[0]}-{own[-1]}" if len(own) > 1 else f"cpu {own[0]}", cores=tuple(own)))
    return lanes


def gpu_lanes(asked: int) -> list[Lane]:
    """asked: how many; 0: all GPUs that are visible and free. Raises UserError where fewer are."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    visible = None if named is None else [name.strip() for name in named.split(",") if name.strip() not in ("", "-1")]
    try:
        listing = subprocess.run(_QUERY, capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise UserError(f"nvidia-smi does not say which GPUs are free ({error}); ask `kinetix-dist doctor`") from error
    free, busy = free_gpus(listing, visible)
    if not free or asked > len(free):
        what = f"{asked} GPUs are asked for" if asked else "a GPU is needed"
        held = f", {', '.join(busy)} in use or not there" if busy else ""
        less = "lower --lanes" if free else "wait for one"
        raise UserError(f"{what}, but {len(free)} of {len(free) + len(busy)} are free{held}; {less}")
    return [Lane(name=f"gpu {gpu}", gpu=gpu) for gpu in free[: asked or len(free)]]


def free_gpus(listing: str, visible: list[str] | None) -> tuple[list[str], list[str]]:
    """(free GPUs, those in use) by the answer of nvidia-smi, as CUDA_VISIBLE_DEVICES has them; visible: None: all."""
    memory: dict[str, float] = {}
    for line in filter(str.strip, listing.splitlines()):
        index, uuid, used = (part.strip() for part in line.split(","))
        memory[index] = memory[uuid] = float(used)
    chosen = visible if visible is not None else [name for name in memory if name.isdigit()]
    # Parts of a GPU (MIG) are not in the list; a number that is not names none.
    used = {name: memory.get(name, math.inf if name.isdigit() else 0.0) for name in chosen}
    free = [name for name in chosen if used[name] < FREE_BELOW_MIB]
    return free, [name for name in chosen if name not in free]


def start_training(arguments: list[str], lane: Lane, log: Path) -> subprocess.Popen[bytes]:
    """`kinetix-dist train` in a lane; what it says is added to a file. It gets SIGTERM if this process dies, and no
    Ctrl-C of this one's terminal."""
    cores = ",".join(map(str, lane.cores)) or "all"
    command = command_of("kinetix_dist.sweep.lane_process", cores, os.getpid(), "train", *arguments)
    with log.open("ab") as file:
        file.write(f"$ kinetix-dist train {' '.join(arguments)}\n".encode())
        file.flush()
        return subprocess.Popen(
            command,
            env={**os.environ, **lane.environment},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
