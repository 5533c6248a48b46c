"""Builders of cores, called inside their processes: `build(index, number of processes, config)`.

build_worker    worlds and a learner shard      colocated placement, and all of local mode
build_learner   a learner shard                 split placement
build_rollout   a part of the worlds            split placement
build_curator   scoring of levels               both
build_evaluator evaluations and recordings      both, where they are due during training
"""

from __future__ import annotations

import gc

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.program_cache import enable_compile_cache
from kinetix_dist.registry import import_plugins
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.evaluator import EvaluatorCore
from kinetix_dist.runtime.cores.split_core import RolloutWorker
from kinetix_dist.runtime.cores.worker import LearnerWorker, Worker

# Tracing makes millions of objects that stay: looking for garbage among them at Python's own intervals takes 6 % of the
# CPU seconds from the start of a process to its first update, with all programs in the cache.
GC_THRESHOLD = (50_000, 10, 10)
MODULES = (__name__, "jax2d.warp.ffi")  # all that a process imports, the engine too: for a server that forks processes


def build_worker(index: int, num_processes: int, config: TrainConfig, ahead_of: int | None) -> Worker:
    """ahead_of: see `Worker`."""
    del index, num_processes
    _prepare_process(config)
    return Worker(config, data_mesh(), ahead_of)


def build_learner(index: int, num_processes: int, config: TrainConfig) -> LearnerWorker:
    del index, num_processes
    _prepare_process(config)
    return LearnerWorker(config, data_mesh())


def build_rollout(index: int, num_processes: int, config: TrainConfig, num_parts: int) -> RolloutWorker:
    """num_parts: rollout actors of the run; one that replaces a lost one is started alone."""
    del num_processes
    _prepare_process(config)
    return RolloutWorker(config, data_mesh(), index=index, num_parts=num_parts)


def build_curator(index: int, num_processes: int, config: TrainConfig) -> CuratorCore:
    del index, num_processes
    _prepare_process(config)
    return CuratorCore(config)


def build_evaluator(index: int, num_processes: int, config: TrainConfig) -> EvaluatorCore:
    del index, num_processes
    _prepare_process(config)
    return EvaluatorCore(config)


def _prepare_process(config: TrainConfig) -> None:
    """Prepares a process, before anything is built."""
    gc.set_threshold(*GC_THRESHOLD)
    import_plugins(config.run.plugins)
    enable_compile_cache(config.run.compile_cache)
