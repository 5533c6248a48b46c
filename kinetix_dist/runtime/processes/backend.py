"""How the controller talks to cores, wherever they are: `Handle.call` gives a `Ticket` for the answer.

Two backends: `local.LocalBackend` (the same process, no ray) and `ray_backend.RayBackend`. Everything above this line
of the runtime is written once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from kinetix_dist.runtime.processes.losses import Losses
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.runtime.processes.sections import Sections


class Ticket(Protocol):
    """An answer that may not be there yet. As an argument of a call it stands for the answer and is not copied."""

    def fetch(self) -> Any:
        """The answer; waits for it. Raises as `Backend.gather` does."""

    def fetch_in_thread(self) -> Any:
        """The same for other threads than that of the run: nobody watches the process meanwhile, and what is lost
        raises an error of the backend's own."""

    def is_ready(self) -> bool: ...


class Handle(Protocol):
    """A core in some process."""

    plan: ProcessPlan

    def call(self, method: str, *arguments: Any) -> Ticket:
        """Asks for `core.method(*arguments)`; calls of one handle are done in order."""

    def call_stamped(self, method: str, *arguments: Any) -> tuple[Ticket, Ticket]:
        """The same for a method that returns (stamp, content): the small stamp can be fetched without the content.

        The stamp, a dictionary, also gets "put": bytes of the content and seconds that storing it took.
        """

    def call_beside(self, method: str, *arguments: Any) -> Ticket:
        """The same while another call runs; calls of this kind are done in order.

        A ticket as an argument stays one: the method fetches it. Its answer has to be there already.
        """


@dataclasses.dataclass(frozen=True)
class Group:
    """Processes of one role: a core `build(plan.index, number of plans, *arguments)` for each plan."""

    plans: Sequence[ProcessPlan]
    build: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


class Backend(Protocol):
    """Starts processes and ends them."""

    sections: Sections  # which section of the run waits for processes, and how long it may
    losses: Losses  # of processes so far
    works_beside: bool  # what is asked of a process is done while others work, and the driver goes on

    def spawn(self, plans: Sequence[ProcessPlan], build: Callable[..., Any], *arguments: Any) -> list[Handle]:
        """One core a plan, as `Group` says; several that join a group form one JAX world, by rank."""

    def spawn_groups(self, groups: Sequence[Group]) -> list[list[Handle]]:
        """The same for several groups at the same time: no process waits for one that it does not join."""

    def spawn_beside(self, plan: ProcessPlan, build: Callable[..., Any], *arguments: Any) -> Handle:
        """The same for one process, without waiting for it: what is asked of it is done once it has started."""

    def watch(self, handle: Handle, ticket: Ticket) -> float:
        """s for which the process of a handle has not answered a ping; 0 where it is well, or the answer is there.

        Raises as `gather` does where the answer is a loss or a failure. Does not wait.
        """

    @property
    def has_lost_room(self) -> bool:
        """Whether nodes were lost without which the processes of the run have no room; it comes back with them."""
        ...

    def put(self, value: Any) -> Ticket:
        """A value that many calls are given, stored once."""

    def gather(self, tickets: Sequence[Ticket]) -> list[Any]:
        """All answers. Raises WorkerLostError as soon as a process is lost, ProcessFailedError as soon as one fails."""

    def first_of(self, tickets: Sequence[Ticket], *, beside: Sequence[Handle] = ()) -> list[Ticket]:
        """Those that are answered or lost: waits until it is one at least. Raises WorkerLostError where a process is
        silent for too long or the limit of the section is exceeded, and where one of `beside` is lost."""

    def check(self, handles: Sequence[Handle]) -> None:
        """Raises WorkerLostError where one of them is lost. Does not wait; a death is noticed within five seconds."""

    def check_limit(self, handles: Sequence[Handle]) -> None:
        """Raises WorkerLostError where these, who are waited for, exceed the limit of the section."""

    def facts(self, handles: Sequence[Handle]) -> list[dict[str, Any]]:
        """For the report, of each process: "process", "pid", "host", "device", on a GPU "gpu" and "memory_mib"."""

    def measures(self) -> dict[str, float]:
        """Metrics of all processes: idle shares, memory, what was compiled and moved. Does not wait."""

    def processes(self) -> list[dict[str, Any]]:
        """Of each process what processes.jsonl says, as old as `measures`."""

    def kill(self, handles: Sequence[Handle]) -> None:
        """Ends processes and returns when they are gone."""

    def stop(self) -> None: ...
