"""Worker slots: the devices that one run at a time has to itself. One GPU each, or on CPUs as many cores each.

    python -m kinetix_dist.sweep.slots CORES PARENT COMMAND...      CORES: "0,1" or "all"; PARENT: pid of the sweep

becomes a `kinetix-dist` command on the cores of a slot, which gets SIGTERM when the sweep dies. It is a program of its
own, since all threads inherit these settings only when they are made before the first thread.
"""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

from kinetix_dist.child_python import command_of
from kinetix_dist.errors import UserError
from kinetix_dist.parent_death import end_with_parent

FREE_BELOW_MIB = 1024  # of memory in use: an idle GPU's driver holds some hundred at most
_QUERY = ["nvidia-smi", "--query-gpu=index,uuid,memory.used", "--format=csv,noheader,nounits"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slot:
    """Devices of one arm."""

    name: str
    gpu: str | None = None  # as CUDA_VISIBLE_DEVICES names it
    cores: tuple[int, ...] = ()  # numbers of CPU cores; (): all

    @property
    def environment(self) -> dict[str, str]:
        """Variables with which a process sees this slot alone."""
        if self.gpu is not None:
            return {"CUDA_VISIBLE_DEVICES": self.gpu}
        return {"CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}


def cpu_slots(requested: int, option: str = "--slots") -> list[Slot]:
    """Slots of CPU cores. requested: 0: one with all cores. Raises UserError for more than there are cores."""
    cores = sorted(os.sched_getaffinity(0))
    if requested > len(cores):
        raise UserError(f"{requested} slots are requested, but this process may use {len(cores)} cores; lower {option}")
    count = requested or 1
    size, more = divmod(len(cores), count)
    slots, first = [], 0
    for number in range(count):
        own = cores[first : first + size + (number < more)]
        first += len(own)
        slots.append(Slot(name=f"cpu {own[0]}-{own[-1]}" if len(own) > 1 else f"cpu {own[0]}", cores=tuple(own)))
    return slots


def gpu_slots(requested: int, option: str = "--slots") -> list[Slot]:
    """Slots of one GPU each. requested: 0: all that are visible and free. Raises UserError where fewer are."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    visible = None if named is None else [name.strip() for name in named.split(",") if name.strip() not in ("", "-1")]
    try:
        listing = subprocess.run(_QUERY, capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise UserError(f"nvidia-smi does not say which GPUs are free ({error}); ask `kinetix-dist doctor`") from error
    free, busy = free_gpus(listing, visible)
    if not free or requested > len(free):
        what = f"{requested} GPUs are requested" if requested else "a GPU is needed"
        held = f", {', '.join(busy)} in use or not there" if busy else ""
        less = f"lower {option}" if free else "wait for one"
        raise UserError(f"{what}, but {len(free)} of {len(free) + len(busy)} are free{held}; {less}")
    return [Slot(name=f"gpu {gpu}", gpu=gpu) for gpu in free[: requested or len(free)]]


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


def start_command(words: list[str], slot: Slot, log: Path) -> subprocess.Popen[bytes]:
    """Starts `kinetix-dist WORDS` in a slot; its output is added to a file. It gets SIGTERM if this process dies, and
    no Ctrl-C of this one's terminal."""
    cores = ",".join(map(str, slot.cores)) or "all"
    command = command_of("kinetix_dist.sweep.slots", cores, os.getpid(), *words)
    with log.open("ab") as file:
        file.write(f"$ kinetix-dist {' '.join(words)}\n".encode())
        file.flush()
        return subprocess.Popen(
            command,
            env={**os.environ, **slot.environment},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def become(cores: str, parent: int, command: list[str]) -> None:
    """Becomes a `kinetix-dist` command on some cores, which gets SIGTERM when its parent dies."""
    if cores != "all":
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    end_with_parent(parent, "the sweep")
    os.execv(sys.executable, command_of("kinetix_dist.cli.main", *command))


if __name__ == "__main__":
    become(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
