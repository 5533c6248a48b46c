"""Running a training run: from a config and a directory to a trained policy, on one CPU or on a Ray cluster.

                      driver process                                    processes of the run (this one in local mode)
    train() ── training_run ── controller ──┬── colocated: run_update ──────────> worker x N: worlds, policy, learner
     config        │           one loop     ├── split:  play(batch u + 1) ──────> rollout x N ── batch, object store ─┐
     directory     │                        │           learn(batch u) <────────> learner x N <─────────────────────┘
                   │                        ├── refreshes: weights, key ────────> curator x N: parts of a buffer
                   │                        └── evaluations: weights ───────────> evaluator: solve rates, rollouts
                   │                                     every arrow: Backend ── Handle.call() ──> Future
                   └── run_directory <── checkpoints, run_data, reporting (threads): all that the run is, on disk

| subpackage | duty | may import |
|---|---|---|
| driver | the loop, placements, checkpoints, reports; begin with `controller.py` | cores, processes |
| processes | starts, places, watches and ends processes; local and Ray back ends | - |
| cores | computes inside a process; plain JAX, the same with and without Ray | - |

`controller.py` has a table of what each role consumes, produces and waits for. A refresh of the curriculum is read in
`driver/refreshes.py`, an evaluation in `driver/evaluations.py`.

Packages above call the names of `__all__`, and nothing below: each is imported when it is first used, so that a command
which only looks at a run directory imports neither JAX nor Ray.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
    from kinetix_dist.runtime.cores.evaluator import EVALUATION_STREAM
    from kinetix_dist.runtime.cores.learner_core import LearnerCore
    from kinetix_dist.runtime.cores.playing import check_memory, make_environment
    from kinetix_dist.runtime.cores.rollout_core import Batch, Players, RolloutCore
    from kinetix_dist.runtime.cores.run_names import PLAY, stream
    from kinetix_dist.runtime.cores.update_metrics import training_metrics
    from kinetix_dist.runtime.driver.checkpoints import finished_report, starting_point
    from kinetix_dist.runtime.driver.run_directory import (
        LOCK_NAME,
        RunDirectory,
        RunDirectoryError,
        lock_directory,
        newest_run,
        no_run_in,
    )
    from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED, StoppedError, StopRequested, StopSignals
    from kinetix_dist.runtime.driver.totals import is_over
    from kinetix_dist.runtime.driver.training_run import (
        RunFailedError,
        check_devices,
        hold_to_cpu,
        start_fork_server,
        train,
    )
    from kinetix_dist.runtime.processes.placement import (
        PlacementError,
        count_gpus,
        plan_placement,
        resolve_device,
    )
    from kinetix_dist.runtime.processes.provenance import versions

_MODULE_OF = {
    # A run from beginning to end
    "train": "driver.training_run",
    "RunFailedError": "driver.training_run",
    "hold_to_cpu": "driver.training_run",
    "check_devices": "driver.training_run",
    "start_fork_server": "driver.training_run",
    # Its directory
    "RunDirectory": "driver.run_directory",
    "RunDirectoryError": "driver.run_directory",
    "LOCK_NAME": "driver.run_directory",
    "lock_directory": "driver.run_directory",
    "newest_run": "driver.run_directory",
    "no_run_in": "driver.run_directory",
    # Where it starts and ends
    "starting_point": "driver.checkpoints",
    "finished_report": "driver.checkpoints",
    "is_over": "driver.totals",
    "EXIT_STOPPED": "driver.stopping",
    "StopSignals": "driver.stopping",
    "StopRequested": "driver.stopping",
    "StoppedError": "driver.stopping",
    # Devices and versions
    "plan_placement": "processes.placement",
    "PlacementError": "processes.placement",
    "count_gpus": "processes.placement",
    "resolve_device": "processes.placement",
    "versions": "processes.provenance",
    # Parts of a process, for what trains in another way (finetune)
    "make_environment": "cores.playing",
    "check_memory": "cores.playing",
    "make_curriculum": "cores.curriculum_state",
    "Batch": "cores.rollout_core",
    "Players": "cores.rollout_core",
    "RolloutCore": "cores.rollout_core",
    "LearnerCore": "cores.learner_core",
    "training_metrics": "cores.update_metrics",
    "EVALUATION_STREAM": "cores.evaluator",
    "PLAY": "cores.run_names",
    "stream": "cores.run_names",
}

__all__ = [
    "EVALUATION_STREAM",
    "EXIT_STOPPED",
    "LOCK_NAME",
    "PLAY",
    "Batch",
    "LearnerCore",
    "PlacementError",
    "Players",
    "RolloutCore",
    "RunDirectory",
    "RunDirectoryError",
    "RunFailedError",
    "StopRequested",
    "StopSignals",
    "StoppedError",
    "check_devices",
    "check_memory",
    "count_gpus",
    "finished_report",
    "hold_to_cpu",
    "is_over",
    "lock_directory",
    "make_curriculum",
    "make_environment",
    "newest_run",
    "no_run_in",
    "plan_placement",
    "resolve_device",
    "start_fork_server",
    "starting_point",
    "stream",
    "train",
    "training_metrics",
    "versions",
]


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
