"""Cores in Ray actors. Ray is the control plane only: it starts, calls and kills; gradients go through JAX."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import psutil
import ray
import ray.util
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from kinetix_dist.runtime.processes.actor import ProcessActor
from kinetix_dist.runtime.processes.backend import Backend, OtherCore, Sections
from kinetix_dist.runtime.processes.calls import Core, Future, Group, Handle, T, Ts
from kinetix_dist.runtime.processes.failures import Losses, RayFailedError, WorkerLostError
from kinetix_dist.runtime.processes.fork_server import ForkServer
from kinetix_dist.runtime.processes.measures import refuse_other_imports
from kinetix_dist.runtime.processes.placement import (
    Placement,
    PlacementError,
    ProcessPlan,
    Resources,
    count_gpus,
    free_resources,
    needed_by,
    nodes_in_words,
    total_resources,
)
from kinetix_dist.runtime.processes.ray_calls import RayFuture, RayHandle, actors_of, future_of_ray, handle_of_ray
from kinetix_dist.runtime.processes.ray_setup import (
    job_of_this_import_path,
    joining,
    own_servers,
    own_signals,
    print_nothing,
    secure_token,
    servers_in_their_own_groups,
    without_services,
)
from kinetix_dist.runtime.processes.supervise import Readings, Supervisor, wait_until_gone
from kinetix_dist.runtime.processes.watchdog import Watchdog, is_alive

FREE_TIMEOUT_S = 10.0  # for GPUs and CPU slots of a cluster that others still hold
CPUS_POLL_S = 0.2
GROUP_GRACE_S = 30.0  # a silent process is this backend's to notice; so much later JAX ends the others of its group
# Settings of the driver's shell that its processes get on every node: how collectives find and use the network.
PASSED_ON = ("NCCL_", "GLOO_")


class RayBackend(Backend):
    """Connects to the cluster in `RAY_ADDRESS`, or starts Ray on this machine, on loopback and without a dashboard."""

    works_in_background = True

    def __init__(
        self,
        *,
        heartbeat_seconds: float,
        on_event: Callable[..., None] = lambda kind, **details: None,
        modules: Sequence[str] = (),
        fork_server: ForkServer | None = None,
    ) -> None:
        """Connect to Ray, or start it.

        Args:
            heartbeat_seconds: longest silence of a process before it counts as lost
            on_event: called with the kind and details of each start of a process, such as its host and memory
            modules: names of the modules that processes import; the fork server imports them once (`fork_server.py`)
            fork_server: a running fork server with these modules; the backend stops it when it stops
        """
        self._on_event = on_event
        self.sections = Sections()
        self.losses = Losses()
        self._heartbeat_seconds = heartbeat_seconds
        self._supervisor = Supervisor(heartbeat_seconds, self.sections)
        self._watchdog: Watchdog | None = None
        self._fork_server = fork_server
        self._loopback = "1"  # "1" if processes listen only on loopback; the environment overrides it
        self._group: Any = None  # the GPUs of the run, one bundle each
        self._needed = Resources(0, 0)  # for all processes of the run
        self._readings = Readings()
        self._servers: dict[str, psutil.Process] = {}  # by name, of a Ray that was started here
        self.has_joined_a_cluster = False  # that others started, whose nodes may differ from this one
        if ray.is_initialized():
            self._owns_ray = False
            return
        self._owns_ray = True
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        # Ray would print failures of results that nobody reads.
        os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
        address = os.environ.get("RAY_ADDRESS")
        # log_to_driver: actors log to Ray's session directory; what fails is raised here.
        options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
        options["job_config"] = job_of_this_import_path()
        if address:
            self._loopback = "0"
            self.has_joined_a_cluster = True
            options |= {"address": address}
        else:
            if (path := secure_token()) is not None:
                on_event("token_secured", path=str(path))
            self._watchdog = Watchdog(os.getpid())
            if self._fork_server is None and ForkServer.can_run():
                self._fork_server = ForkServer(modules)
            # One CPU slot a process is bookkeeping only: roles are few, and all of them may run at once.
            options |= {
                "address": "local",
                "num_cpus": max(os.cpu_count() or 1, 64),
                "num_gpus": count_gpus(),
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",
                # Processes without the variables of ours, which no run would use.
                "_system_config": {"prestart_worker_first_driver": False},
            }
        with warnings.catch_warnings(), joining(address) if address else ForkServer.used_by_ray():
            # JAX warns of every fork. Ray's forks run another program at once, so they cannot deadlock.
            warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
            print_nothing()
            with contextlib.ExitStack() as changes:
                changes.enter_context(own_signals())
                if not address:
                    changes.enter_context(without_services())
                    changes.enter_context(servers_in_their_own_groups())
                ray.init(**options)
        self._servers = {} if address else own_servers()

    @property
    def is_on_this_machine(self) -> bool:
        """True if all processes are on this machine: a Ray that this process started has a single node."""
        return self._owns_ray and not self.has_joined_a_cluster

    @property
    def num_gpus(self) -> int:
        """GPUs of the whole cluster."""
        return total_resources().gpus

    def reserve(self, placement: Placement) -> None:
        """Reserve the GPUs of a run, so that the same processes share a GPU after each restart.

        Raises PlacementError if other runs hold them, or if the cluster has fewer CPU slots than the run has processes.
        """
        self.release()
        self._needed = needed_by(placement)
        self._check_cpus(self._needed.cpus)
        shared: dict[int, int] = {}
        for plan in placement.processes:
            if plan.gpu is not None:
                shared[plan.gpu] = shared.get(plan.gpu, 0) + 1
        if not shared:
            return
        bundles = [{"GPU": 1, "CPU": shared[gpu]} for gpu in sorted(shared)]
        group = ray.util.placement_group(bundles, strategy="PACK")
        if not group.wait(FREE_TIMEOUT_S):
            ray.util.remove_placement_group(group)
            raise PlacementError(
                f"this run needs {len(bundles)} of the cluster's {self.num_gpus} GPUs, and they were not free within "
                f"{FREE_TIMEOUT_S:g} s: {nodes_in_words()}; wait for the run that holds them, or lower run.num_workers "
                "(split: run.num_learners, run.num_rollout_actors)"
            )
        self._group = group

    def release(self) -> None:
        """Release the GPUs. Ray ends the processes on them."""
        if self._group is not None:
            ray.util.remove_placement_group(self._group)
            self._group = None

    @property
    def has_lost_resources(self) -> bool:
        self._check_ray()
        if self._group is not None:
            return ray.util.placement_group_table(self._group)["state"] != "CREATED"
        return not total_resources().holds(self._needed)

    def resources(self) -> Resources:
        """Free resources, and the resources of the run's processes."""
        held = self._needed if self._group is not None else Resources(self._supervisor.num_watched, 0)
        # For a moment Ray still counts newly taken resources as free.
        return (free_resources() + held).at_most(total_resources())

    def _check_cpus(self, needed: int) -> None:
        """Ray itself would wait for ever, without a word."""
        total, deadline = total_resources().cpus, time.monotonic() + FREE_TIMEOUT_S
        advice = "start Ray with more by --num-cpus (they are bookkeeping only), or start fewer processes"
        if total < needed:
            raise PlacementError(
                f"this run has {needed} processes, and the cluster {total} CPU slots: {nodes_in_words()}; {advice}"
            )
        while (free := free_resources().cpus) < needed:
            if time.monotonic() > deadline:
                raise PlacementError(
                    f"this run needs {needed} of the cluster's {total} CPU slots, and {free} were free within "
                    f"{FREE_TIMEOUT_S:g} s: {nodes_in_words()}; wait for the run that holds them, or {advice}"
                )
            time.sleep(CPUS_POLL_S)

    def spawn(
        self, plans: Sequence[ProcessPlan], build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> list[RayHandle[Core]]:
        started = self._created(Group(plans, build, *arguments))
        self._start(started)
        return started

    def spawn_both(
        self, first: Group[Core], second: Group[OtherCore]
    ) -> tuple[list[RayHandle[Core]], list[RayHandle[OtherCore]]]:
        started = self._created(first), self._created(second)
        self._start(*started)
        return started

    def _created(self, group: Group[Core]) -> list[RayHandle[Core]]:
        self._check_ray()
        return [self._create(plan, group) for plan in group.plans]

    def _create(self, plan: ProcessPlan, group: Group[Core]) -> RayHandle[Core]:
        actor_class: Any = ProcessActor  # ray.remote made another class of it, which type checkers do not see
        create = actor_class.options(**self._options(plan)).remote
        actor = create(plan, group.build, plan.index, len(group.plans), *group.arguments)
        self._supervisor.add(actor, plan.name)
        self._readings.add(actor)
        return RayHandle(plan, actor, self)

    def _start(self, *groups: Sequence[RayHandle[Any]]) -> None:
        """Start the cores of processes. Ends all of them if one fails."""
        try:
            self._start_cores(groups)
        except BaseException:
            self.kill(list(itertools.chain(*groups)))
            raise

    def _start_cores(self, groups: Sequence[Sequence[RayHandle[Any]]]) -> None:
        handles = list(itertools.chain(*groups))
        actors = [handle.actor for handle in handles]
        # Pings first: a process that dies in a later call could not be seen to be gone by its number.
        for handle, pid in zip(handles, self._all(actors, [actor.ping.remote() for actor in actors]), strict=True):
            handle.started_as(pid, is_here=self.is_on_this_machine)
        started = self._all(actors, [actor.prepare.remote() for actor in actors])
        for handle, where in zip(handles, started, strict=True):
            self._note_started(handle, where)
        # Those that join no group build first: they do so while the others get an address and wait for each other.
        calls: list[tuple[Any, Any]] = []
        for group in sorted(groups, key=_joins):
            members = [handle.actor for handle in group]
            if _joins(group):
                coordinator = self._all(members[:1], [members[0].free_address.remote()])[0]
                group_arguments = (coordinator, len(members), math.ceil(self._heartbeat_seconds + GROUP_GRACE_S))
                joined = [actor.join.remote(rank, *group_arguments) for rank, actor in enumerate(members)]
                calls += zip(joined, members, strict=True)
            calls += [(actor.build.remote(), actor) for actor in members]
        self._supervisor.gather(calls)

    def _all(self, actors: Sequence[Any], references: Sequence[Any]) -> list[Any]:
        return self._supervisor.gather(list(zip(references, actors, strict=True)))

    def spawn_in_background(
        self, plan: ProcessPlan, build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> RayHandle[Core]:
        (handle,) = self._created(Group([plan], build, *arguments))
        handle.starting = [handle.actor.prepare.remote(), handle.actor.build.remote()]
        return handle

    def check(self, handles: Sequence[Handle[Any]]) -> None:
        self._supervisor.check_alive(actors_of(handles))

    def check_limit(self, handles: Sequence[Handle[Any]]) -> None:
        self._supervisor.check_limit(actors_of(handles))

    def watch(self, handle: Handle[Any], future: Future[Any]) -> float:
        handle = handle_of_ray(handle)
        if not future.is_ready():
            self._note_start(handle)
            silence = self._supervisor.silence(handle.actor, ping_every_s=0.0)
            is_starting = handle.pid is None and silence < self._heartbeat_seconds
            return 0.0 if is_starting else silence
        self._note_start(handle)
        for reference in handle.starting:  # what failed while it started is the cause of all that came after
            self._supervisor.gather([(reference, handle.actor)])
        handle.starting = []
        self.gather([future])
        return 0.0

    def _note_start(self, handle: RayHandle[Any]) -> None:
        """Notes a process that has started in the background."""
        if handle.pid is None and ray.wait(handle.starting[:1], timeout=0)[0]:
            where = self._supervisor.gather([(handle.starting[0], handle.actor)])[0]
            handle.started_as(where["pid"], is_here=self.is_on_this_machine)
            self._note_started(handle, where)

    def _note_started(self, handle: RayHandle[Any], where: dict[str, Any]) -> None:
        refuse_other_imports(handle.plan.name, where)
        self.losses.started(handle.plan.name, where)
        self._on_event("process_started", process=handle.plan.name, **where)

    def facts(self, handles: Sequence[Handle[Any]]) -> list[dict[str, Any]]:
        actors = actors_of(handles)
        return self._all(actors, [actor.facts.remote() for actor in actors])

    def measures(self) -> dict[str, float]:
        return self._readings.metrics()

    def processes(self) -> list[dict[str, Any]]:
        return self._readings.processes()

    def _options(self, plan: ProcessPlan) -> dict[str, Any]:
        environment = {
            **{name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)},
            "KINETIX_DIST_LOOPBACK": os.environ.get("KINETIX_DIST_LOOPBACK", self._loopback),
            **plan.env_vars,
        }
        if self._fork_server is not None:
            if why := self._fork_server.why_no_answer:
                self._on_event("fork_server_lost", reason=why)
                self._fork_server.stop()
                self._fork_server = ForkServer(self._fork_server.modules)
            environment |= self._fork_server.environment
        options = {"num_cpus": 1, "num_gpus": plan.gpu_share, "runtime_env": {"env_vars": environment}}
        if plan.gpu is not None:
            options["scheduling_strategy"] = PlacementGroupSchedulingStrategy(
                self._group, placement_group_bundle_index=plan.gpu
            )
        return options

    def put(self, value: T) -> RayFuture[T]:
        return RayFuture(ray.put(value))

    def gather(self, futures: Sequence[Future[T]]) -> list[T]:
        self._check_ray()
        return self._supervisor.gather([(future.reference, future.actor) for future in map(future_of_ray, futures)])

    def first_ready(self, futures: Sequence[Future[Any]], *, watched: Sequence[Handle[Any]] = ()) -> list[Future[Any]]:
        references = [future_of_ray(future).reference for future in futures]
        actors = [future_of_ray(future).actor for future in futures]
        calls = list(zip(references, actors, strict=True))
        ready = set(self._supervisor.first_ready(calls, watched=actors_of(watched)))
        return [future for future, reference in zip(futures, references, strict=True) if reference in ready]

    def kill(self, handles: Sequence[Handle[Any]]) -> None:
        """SIGKILL, then polls until every process of this host is gone: a dying one can still hold GPU memory."""
        actors = actors_of(handles)
        self._supervisor.remove(actors)
        self._readings.remove(actors)
        if not self._lost_servers():  # without them the call would wait for a minute
            for actor in actors:
                ray.kill(actor, no_restart=True)
        if self.is_on_this_machine:
            processes = [process for handle in handles if (process := handle_of_ray(handle).process) is not None]
            _kill_all(processes)  # a Ray that is ending does nothing more, and may take long
            left = wait_until_gone(processes)
            if left:
                raise WorkerLostError(f"processes {left} could not be ended; end them by hand, then --resume")
        else:
            time.sleep(1.0)

    def _lost_servers(self) -> list[str]:
        return [server for server, process in self._servers.items() if not is_alive(process)]

    def _descendants_of_servers(self) -> list[psutil.Process]:
        found: list[psutil.Process] = []
        for server in self._servers.values():
            with contextlib.suppress(psutil.Error):
                found += server.children(recursive=True)
        return found

    def _check_ray(self) -> None:
        """Raise RayFailedError if Ray has ended: a minute later it would end this process without a message."""
        if lost := self._lost_servers():
            raise RayFailedError(f"Ray was ended on this machine ({', '.join(lost)}), by `ray stop` for instance")

    def stop(self) -> None:
        is_over = False
        try:
            is_over = self._leave_ray()
        finally:
            if self._fork_server is not None:
                self._fork_server.stop()
            if self._watchdog is not None and is_over:
                self._watchdog.stop()
            elif self._watchdog is not None:  # agents of a Ray without its servers stay for minutes
                self._watchdog.end_what_is_left()

    def _leave_ray(self) -> bool:
        """Disconnect from Ray. Returns False if this backend still has to end its processes."""
        if not self._owns_ray:
            self.release()
            return True
        if self._lost_servers():  # Ray would end this process at once, with status 1: Python's exit calls it
            return False
        family = self._descendants_of_servers()
        try:
            ray.shutdown()
        finally:
            _kill_all(family)  # agents of a raylet that another program ended stay for minutes
        return True


def _kill_all(processes: Iterable[psutil.Process]) -> None:
    for process in processes:
        with contextlib.suppress(psutil.Error):  # it has ended itself; another one that got its number is spared
            process.kill()


def _joins(group: Sequence[RayHandle[Any]]) -> bool:
    return len(group) > 1 and group[0].plan.joins_group
