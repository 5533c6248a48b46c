"""Typed calls of a core in another process: `handle.call(Core.method, *arguments)` returns a `Future` of the answer.

    driver   handle.call(LearnerWorker.probe, 8)  --"probe", 8-->  process   core.probe(8)

A call names a method of the core's class, so type checkers compare its arguments and its answer, and editors jump to
its definition. Only the name of the method travels: the process calls the method of that name of its own core, which
can be a subclass.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, TypeVarTuple, cast

from kinetix_dist.runtime.processes.placement import ProcessPlan

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Content = TypeVar("Content")
Core = TypeVar("Core")
P = ParamSpec("P")
Ts = TypeVarTuple("Ts")


class Future(ABC, Generic[T_co]):
    """An answer that may not have arrived yet."""

    @abstractmethod
    def fetch(self) -> T_co:
        """Wait for the answer and return it. Raises what `Backend.gather` raises."""

    @abstractmethod
    def fetch_in_thread(self) -> T_co:
        """Do the same in a thread other than the run's: the process is not watched, and a loss raises an error of the
        backend."""

    @abstractmethod
    def is_ready(self) -> bool: ...

    def as_argument(self) -> T_co:
        """Return this future, typed as its answer, as an argument of `Handle.call`.

        The called process gets the answer, without a copy in the driver.
        """
        return cast(T_co, self)


def resolve(value: T | Future[T]) -> T:
    """Return the value itself, fetched if it is a future."""
    return value.fetch() if isinstance(value, Future) else value


@dataclasses.dataclass(frozen=True)
class Call:
    """A call on its way to a core."""

    method: str
    arguments: tuple[Any, ...]
    named: Mapping[str, Any]

    def with_each(self, change: Callable[[Any], Any]) -> Call:
        """Return the call with every argument changed."""
        named = {name: change(value) for name, value in self.named.items()}
        return Call(self.method, tuple(change(value) for value in self.arguments), named)

    def on(self, core: Any) -> Any:
        """Call the core and return its answer."""
        return getattr(core, self.method)(*self.arguments, **self.named)


class Handle(ABC, Generic[Core]):
    """A core in a process. Each backend transports calls in its own way."""

    plan: ProcessPlan

    def call(self, method: Callable[Concatenate[Core, P], T], *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Call `method` of the core. A handle's calls run in order."""
        return self._call(Call(method.__name__, arguments, named))

    def call_with_header(
        self,
        method: Callable[Concatenate[Core, P], tuple[Mapping[str, Any], Content]],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> tuple[Future[dict[str, Any]], Future[Content]]:
        """Call a method that returns (header, content), and return a future of each.

        The driver can fetch the small header without the content. The backend adds "put" to the header: bytes of the
        content, and seconds spent on storing it.
        """
        return self._call_with_header(Call(method.__name__, arguments, named))

    def call_in_background(
        self, method: Callable[Concatenate[Core, P], T], *arguments: P.args, **named: P.kwargs
    ) -> Future[T]:
        """Call `method` while another call runs. Calls of this kind run in order.

        A future as an argument stays a future, which the method fetches. It must be ready.
        """
        return self._call_in_background(Call(method.__name__, arguments, named))

    @abstractmethod
    def _call(self, call: Call) -> Future[Any]: ...

    @abstractmethod
    def _call_with_header(self, call: Call) -> tuple[Future[dict[str, Any]], Future[Any]]: ...

    @abstractmethod
    def _call_in_background(self, call: Call) -> Future[Any]: ...


class Group(Generic[Core]):
    """Processes of one role: `build(plan.index, number of plans, *arguments)` makes the core of each plan."""

    def __init__(self, plans: Sequence[ProcessPlan], build: Callable[[int, int, *Ts], Core], *arguments: *Ts) -> None:
        self.plans = plans
        self.build: Callable[..., Core] = build
        self.arguments: tuple[Any, ...] = arguments
