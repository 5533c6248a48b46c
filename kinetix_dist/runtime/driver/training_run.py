"""A run from beginning to end: evaluate, train, evaluate, record, report.

config -> placement -> backend (this process or Ray) -> trainer, curator -> controller -> report.json
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.config import RunConfig, TrainConfig, to_dict
from kinetix_dist.env.env_config import describe
from kinetix_dist.errors import one_line
from kinetix_dist.jax_checks import check_arithmetic, check_settings
from kinetix_dist.program_cache import enable_compile_cache
from kinetix_dist.runtime.cores.build import MODULES
from kinetix_dist.runtime.cores.imitation import DivergedError
from kinetix_dist.runtime.driver.checkpoints import LINEAGE
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.evaluations import Evaluations, Recorder
from kinetix_dist.runtime.driver.refreshes import CuratorClient, WorkerCurator
from kinetix_dist.runtime.driver.reporting import STARTED, RunReporter
from kinetix_dist.runtime.driver.roles import Curator, Trainer
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.stopping import (
    StopFailedError,
    StoppedError,
    StopRequested,
    StopSignals,
    raised_through_extensions,
)
from kinetix_dist.runtime.driver.totals import NotFiniteError
from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.failures import ProcessFailedError, RayFailedError, TooManyLossesError
from kinetix_dist.runtime.processes.fork_server import ForkServer
from kinetix_dist.runtime.processes.placement import (
    PlacementError,
    ProcessPlan,
    check_devices_here,
    count_gpus,
    plan_placement,
    resolve_device,
)
from kinetix_dist.runtime.processes.provenance import check_nodes, versions
from kinetix_dist.runtime.processes.ray_setup import use_token
from kinetix_dist.telemetry.sinks import RANDOM_POLICY
from kinetix_dist.telemetry.sinks.console import ConsoleSink, Progress
from kinetix_dist.telemetry.status import FAILED, FINISHED, STOPPED

if TYPE_CHECKING:
    pass


class RunFailedError(RuntimeError):
    """A run that ended because a process failed, or was lost too often: which, why and what to do, in one line."""


def train(
    config: TrainConfig,
    run: RunDirectory,
    *,
    resume: bool,
    console: Progress | None = None,
    stop: StopSignals | None = None,
    fork_server: ForkServer | None = None,
) -> dict[str, Any]:
    """Runs or resumes `run` to its configured end and returns the report, which is also written to report.json.

    fork_server: of `start_fork_server`, if that was called.

    The caller need not prepare JAX: `train` keeps it off the GPUs that the processes of the run share, then checks its
    settings and its arithmetic.

    Raises:
        PlacementError, PortTakenError, CheckpointError, UserError, ValueError: The run cannot start; nothing was
            computed.
        RunFailedError: A process failed.
        StoppedError: A stop was requested.
    """
    stop = stop or StopSignals()
    stop.hint = f"; go on with --run {run.path} --resume"
    total_env_steps = config.run.total_env_steps
    console = console or ConsoleSink(total_env_steps=total_env_steps or None)
    reporter = RunReporter(
        run,
        console,
        total_env_steps=total_env_steps,
        metrics_port=config.run.metrics_port,
        sinks=config.run.sinks,
    )
    about = {"pid": os.getpid(), "host": socket.gethostname(), "session": reporter.session}
    run.event(STARTED, **about, resume=resume, config_hash=config.hash)
    try:
        report = _train(config, run, reporter, stop, fork_server, resume=resume)
    except StoppedError as error:
        reporter.ended(STOPPED, one_line(error))
        raise
    except Exception as error:
        reporter.ended(FAILED, one_line(error))
        run.event("run_failed", error=one_line(error))
        raise
    else:
        reporter.ended(FINISHED)
        run.event("run_finished", update=report["policy_updates"])
        return report
    finally:
        with stop.deferred():
            reporter.close()


def _train(
    config: TrainConfig,
    run: RunDirectory,
    reporter: RunReporter,
    stop: StopSignals,
    fork_server: ForkServer | None,
    *,
    resume: bool,
) -> dict[str, Any]:
    started: list[Callable[[], None]] = []  # what ends it, first to last
    try:
        return _from_start_to_report(config, run, reporter, stop, fork_server, started, resume=resume)
    except (ProcessFailedError, TooManyLossesError) as error:
        raise _failed_run(run, error) from error
    except RayFailedError as error:
        if stop.requested is not None:  # Ray's servers got the signal too
            run.event("stopped", signal=stop.requested, update=None, saved=False)
            raise StoppedError(
                f"stopped by {stop.requested} in an update, which was lost ({error}){stop.hint}"
            ) from error
        raise RunFailedError(f"{error}; try again with --run {run.path} --resume") from error
    except DivergedError as error:
        raise RunFailedError(str(error)) from error
    except NotFiniteError as error:
        raise RunFailedError(f"{error}; checkpoints before them are in {run.checkpoints}") from error
    except StopFailedError as error:
        raise RunFailedError(f"{error} with --run {run.path} --resume") from error
    except StoppedError as error:
        raise StoppedError(f"{error}{stop.hint}") from None
    except StopRequested:
        run.event("stopped", signal=stop.requested, update=None, saved=False)
        raise StoppedError(f"stopped by {stop.requested} outside of updates{stop.hint}") from None
    finally:
        with stop.deferred():
            for end in started:
                end()


@raised_through_extensions()
def _from_start_to_report(
    config: TrainConfig,
    run: RunDirectory,
    reporter: RunReporter,
    stop: StopSignals,
    fork_server: ForkServer | None,
    started: list[Callable[[], None]],
    *,
    resume: bool,
) -> dict[str, Any]:
    """Return the report. Add functions to `started` that end the parts of the run, in their order."""
    began = time.monotonic()
    recorder = Recorder(run)
    stored = run.config = {"hash": config.hash, "config": to_dict(config)}
    if not resume:  # a run that is stopped or fails while it starts can be resumed
        _write_or_fail(run, run.config_path, stored, "then start the run again")
    try:
        roles = _start_roles(config, run, reporter, recorder, fork_server)
        stop.install()
        parts = (roles.curator, roles.evaluations, roles.trainer, roles.trainer.backend)
        started += [part.stop for part in parts if part is not None]
        controller = Controller(config, run, roles, reporter, on_rollouts=recorder, stop=stop, began=began)
        started.insert(0, controller.close)
        controller.restore(resume=resume)
    except (ValueError, CheckpointError, FileNotFoundError):  # refused, before anything was computed
        if not resume:
            run.config_path.unlink(missing_ok=True)
        raise
    if config.cut_episodes:
        reporter.note(config.cut_episodes)
    if resume:  # a refused resume leaves the stored one
        _write_or_fail(run, run.config_path, stored, f"then --run {run.path} --resume")
    evaluations = _from_first_to_last_update(controller, run, reporter)
    controller.clock.lap()
    report = _report(config, controller, evaluations, controller.facts())
    _write_or_fail(run, run.report_path, report, f"then --run {run.path} --resume")
    # Last, since drawing needs libraries that nothing else of a run does.
    if config.recording.num_rollouts and config.recording.make_pictures:
        if failure := recorder.make_pictures():
            reporter.note(failure)
    reporter.phase("done")
    return report


def _from_first_to_last_update(controller: Controller, run: RunDirectory, reporter: RunReporter) -> dict[str, Any]:
    """Evaluates, trains, evaluates, records; returns the evaluations. `run.only_updates`: trains."""
    if controller.config.run.only_updates:
        controller.train()
        return {}
    evaluations = _earlier_evaluations(run) if controller.num_updates else {}
    if controller.num_updates == 0:
        reporter.phase("evaluating")
        evaluations[RANDOM_POLICY] = controller.evaluate(RANDOM_POLICY)
        evaluations["before"] = controller.evaluate("before")
        _write_evaluations(run, reporter, evaluations)
    controller.train()
    reporter.phase("evaluating")
    evaluations["after"] = controller.evaluate("after")
    _write_evaluations(run, reporter, evaluations)
    if num_rollouts := controller.config.recording.num_rollouts:
        reporter.phase("recording")
        controller.record(num_rollouts)
    if not controller.save_now():
        raise RunFailedError(
            f"the last checkpoint, of update {controller.num_updates}, could not be saved: "
            f"{controller.save_error}; go on from the one before it with --run {run.path} --resume"
        )
    return evaluations


def _write_evaluations(run: RunDirectory, reporter: RunReporter, evaluations: dict[str, Any]) -> None:
    """Writes evaluations.json. The report has them too: a failure is an event, no reason to end a run."""
    try:
        run.write_json(run.evaluations_path, evaluations)
    except OSError as error:
        run.event("file_failed", file=run.evaluations_path.name, error=one_line(error))
        reporter.note(f"evaluations.json cannot be written, the run goes on: {one_line(error)}")


def _write_or_fail(run: RunDirectory, path: Path, content: Any, then: str) -> None:
    """Write a file of the run, or raise RunFailedError. `then` says how the run resumes once there is space."""
    try:
        run.write_json(path, content)
    except OSError as error:
        raise RunFailedError(f"{path} cannot be written: {one_line(error)}; free space there, {then}") from error


def hold_to_cpu(run: RunConfig) -> None:
    """Keep JAX in this process off the GPUs, unless a run in local mode uses one.

    Call it before anything is computed, even before a level or a checkpoint is read: JAX would take three quarters of
    the memory of a GPU that the processes of the run use. Raises PlacementError if it is too late.
    """
    import jax

    if run.placement == "local" and resolve_device(run.device, num_gpus=count_gpus()) == "gpu":
        return
    jax.config.update("jax_platforms", "cpu")
    if jax.default_backend() != "cpu":
        raise PlacementError(
            f"JAX runs on {jax.default_backend()} in this process already, which is to compute on the CPU; "
            "start training from a process that has not used JAX, or set JAX_PLATFORMS=cpu"
        )


def prepare_jax(config: TrainConfig) -> None:
    """Prepares JAX in the process of a run, in the only order that works: the check of arithmetic starts JAX on every
    device that it may use. Raises PlacementError, UserError."""
    hold_to_cpu(config.run)
    check_settings()
    check_arithmetic()
    enable_compile_cache(config.run.compile_cache)
    check_devices(config)


def check_devices(config: TrainConfig) -> None:
    """Raise PlacementError if this process trains and has more devices than a batch has parts. Call it after
    `hold_to_cpu`."""
    import jax

    if config.run.placement == "local":
        check_devices_here(config, len(jax.devices()))


def start_fork_server(config: TrainConfig) -> ForkServer | None:
    """Start the parent that a run forks its processes from, early: it imports on another core meanwhile.

    Return None if the run will not fork any.
    """
    if config.run.placement == "local" or "RAY_ADDRESS" in os.environ or not ForkServer.can_run():
        return None
    return ForkServer(MODULES)


def _failed_run(run: RunDirectory, error: ProcessFailedError | TooManyLossesError) -> RunFailedError:
    """One line for the console; the traceback of a process goes to a file that the line names."""
    where = ""
    if isinstance(error, ProcessFailedError):
        try:
            where = f"; traceback in {run.write_log(error.process.replace(' ', '_'), error.details)}"
        except OSError as fault:
            where = f"; its traceback could not be written ({one_line(fault)})"
    return RunFailedError(f"{error}{where}; checkpoints are untouched, go on with --run {run.path} --resume")


def _start_roles(
    config: TrainConfig,
    run: RunDirectory,
    reporter: RunReporter,
    recorder: Recorder,
    fork_server: ForkServer | None,
) -> Roles:
    prepare_jax(config)
    if config.run.placement == "local":
        from kinetix_dist.runtime.processes.local import LocalBackend

        worker = ProcessPlan(role="worker", index=0)
        local = LocalBackend()
        here = ColocatedTrainer(config, local, [worker])
        return Roles(trainer=here, curator=_curator(config, local, here, [ProcessPlan(role="curator", index=0)]))
    if "RAY_ADDRESS" in os.environ:
        use_token()
    from kinetix_dist.runtime.driver.resizing import Resizing
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    backend = RayBackend(
        heartbeat_seconds=config.run.heartbeat_seconds, on_event=run.event, modules=MODULES, fork_server=fork_server
    )
    try:
        if backend.has_joined_a_cluster:
            check_nodes(run.path)
        placement = plan_placement(config, num_gpus=backend.num_gpus)
        backend.reserve(placement)
    except ValueError:
        backend.stop()
        raise
    if config.run.placement == "split":
        from kinetix_dist.runtime.driver.split import SplitTrainer

        trainer: Trainer = SplitTrainer(config, backend, placement, on_event=run.event)
    else:
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    curator = _curator(config, backend, trainer, placement.of("curator"))
    evaluators = placement.of("evaluator")
    evaluations = None
    if evaluators:
        evaluations = Evaluations(config, trainer, evaluators[0], on_event=run.event, on_rollouts=recorder)
    background: dict[str, CuratorClient | Evaluations] = {}
    if isinstance(curator, CuratorClient):
        background["curator"] = curator
    if evaluations is not None:
        background["evaluator"] = evaluations
    resizing = Resizing(config, backend, placement, trainer, background, on_event=run.event, on_note=reporter.note)
    return Roles(trainer=trainer, curator=curator, evaluations=evaluations, resizing=resizing)


def _curator(config: TrainConfig, backend: Backend, trainer: Trainer, plans: Sequence[ProcessPlan]) -> Curator | None:
    if not config.has_curator:
        return None
    if config.workers_curate:
        assert isinstance(trainer, ColocatedTrainer), "TrainConfig refuses it for other placements"
        return WorkerCurator(trainer)
    return CuratorClient(config, backend, plans)


def _earlier_evaluations(run: RunDirectory) -> dict[str, Any]:
    found = run.read_json(run.evaluations_path, is_whole=_are_evaluations)
    return found if found is not None else {}


def _are_evaluations(content: Any) -> bool:
    """{"before": {level set: {"rate": ...}}}"""
    return isinstance(content, dict) and all(isinstance(sets, dict) for sets in content.values())


def _report(
    config: TrainConfig,
    controller: Controller,
    evaluations: dict[str, Any],
    facts: dict[str, Any],
) -> dict[str, Any]:
    seconds = {role: round(value, 3) for role, value in controller.clock.totals.items()}
    return {
        "recipe": config.run.name,
        "env_steps": controller.env_steps,
        "wall_seconds": round(controller.wall_seconds, 3),
        "training_seconds": round(controller.training_seconds_at_end, 3),
        "env_steps_per_second": round(controller.env_steps / max(controller.training_seconds_at_end, 1e-9), 1),
        "policy_updates": controller.num_updates,
        "solve_rate": {name: evaluations.get(name) for name in ("random_policy", "before", "after")},
        "seconds_by_role": seconds,
        "physics": {"settings": describe(config.env.physics), **controller.physics},
        **facts,
        "versions": versions(),
        **({LINEAGE: controller.lineage} if controller.lineage else {}),
        "config_hash": config.hash,
    }
