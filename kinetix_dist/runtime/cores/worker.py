"""Cores of processes that learn: a learner with evaluation, and in the colocated placement worlds with it."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from kinetix_dist.checkpoint import flatten_arrays, select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Proposal
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import local_values
from kinetix_dist.program_cache import compile_seconds
from kinetix_dist.runtime.cores import programs
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.curriculum_state import CurriculumState
from kinetix_dist.runtime.cores.evaluator import Evaluator
from kinetix_dist.runtime.cores.imitation import Imitated
from kinetix_dist.runtime.cores.learner_core import LearnerCore, check_imitated
from kinetix_dist.runtime.cores.ongoing_worlds import OngoingWorlds, begun, restored, stored
from kinetix_dist.runtime.cores.playing import Playing, check_memory
from kinetix_dist.runtime.cores.rollout_core import RolloutCore
from kinetix_dist.runtime.cores.rollout_sums import BY_SOURCE
from kinetix_dist.runtime.cores.run_names import CURRICULUM, LEARNER, WORLDS, one_level
from kinetix_dist.runtime.cores.split_core import Copies, Staging, Stored
from kinetix_dist.runtime.cores.update_metrics import training_metrics


class LearnerWorker:
    """Parameters, optimiser, evaluation; learns from batches that others played."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        for phase in config.schedule.phases:
            check_memory(phase.config, mesh.devices.size)
        self._config = config
        self._mesh = mesh
        self._playing = Playing(config, mesh, division=Division(config.num_blocks, mesh.devices.size))
        env, policy = self._playing.environment(config), self._playing.policy
        self._learner = LearnerCore(config, env, policy, mesh)
        self._evaluator = Evaluator(config, env, policy)
        self._playing.curriculum(config)  # a level set that cannot be loaded is found before the start
        self._states: dict[int, CurriculumState] = {}  # by `Phase.curriculum_since`: in use, and the next one
        self._staging = Staging(config, mesh, self._learner.division)

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """Starts from a checkpoint's arrays, or afresh."""
        is_new = not select_arrays(arrays or {}, LEARNER)
        if is_new and self._config.run.imitation_steps:
            check_imitated(self._config, self._playing.environment(self._config))  # before anything slow
        self._learner.start(arrays)
        self._states = {}
        self._begin_state(self._learner.num_updates, arrays)

    def weights(self) -> Any:
        """Parameters that act."""
        return local_values(self._learner.params)

    def released(self) -> Any:
        """Parameters for evaluation and scoring: see `LearnerState.released`."""
        return local_values(self._learner.released)

    def curriculum_state(self, batch: int) -> Any:
        """State of the curriculum as numpy, from which rollout actors propose levels of a batch."""
        return self._state_of(batch).values

    def probe(self, num_levels: int) -> Any:
        """Levels of the buffer in use as numpy, which the next refresh plays again; None where there is no buffer."""
        state = self._state_of(self._drawn_next)
        return state.curriculum.probe(state.values, num_levels)

    def refresh_input(self) -> Any:
        """Input of the next refresh as numpy, see `Curriculum.refresh_input`."""
        state = self._state_of(self._drawn_next)
        return jax.device_get(state.curriculum.refresh_input(state.values))

    def state_from(self, batch: int, arrays: Mapping[str, np.ndarray]) -> Any:
        """A state of the curriculum of a batch from arrays of a checkpoint; not the one in use."""
        return self._state_of(batch).restored(arrays)

    def adopt(self, *parts: Any) -> None:
        """Adopts parts of a refresh, in order, for the batches drawn from now on."""
        self._state_of(self._drawn_next).adopt(parts)

    def stage(self, update: int, part: int, num_parts: int, content: Stored) -> dict[str, tuple[int, float]]:
        """A part of a batch on its way to the devices, while another batch is learned from: see `Staging.add`."""
        return self._staging.add(update, part, num_parts, content)

    def learn(self, num_updates: int, *sums: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
        """Learns from the batch that was staged for this update; sums: of its parts, as `RolloutCore.play` gives them.

        (header, new weights). header: "metrics", "seconds" and "copies". Weights come from the first process alone.
        """
        began = time.monotonic()
        self._enter_phase_of(num_updates)
        state = self._state_of(num_updates)
        batch, seen = self._staging.take(num_updates)
        env_steps = self._config.schedule.env_steps(num_updates)
        metrics = self._learner.learn(*batch, env_steps=env_steps)
        if seen is not None:
            state.observe(*seen, env_steps=env_steps)
        metrics = self._metrics(num_updates, jax.tree.map(lambda *xs: sum(xs), *sums), local_values(metrics))
        header = {"metrics": metrics, "seconds": time.monotonic() - began}
        copies = Copies()
        weights = None
        if jax.process_index() == 0:
            with copies.timed("weights_to_host") as copied:
                weights = self.weights()
                copied.append(weights)
        return header | {"copies": copies.found}, weights

    def snapshot(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        state = self._states.get(self._since(self._learner.num_updates))
        values = None if state is None else state.values  # None: the next update begins another
        return flatten_arrays({LEARNER: local_values(self._learner.state), CURRICULUM: values})

    def imitate(self, steps: int) -> tuple[Imitated, dict[str, Any]]:
        """See `LearnerCore.imitate`."""
        return self._learner.imitate(steps)

    def evaluate(self, use_policy: bool) -> dict[str, dict[str, Any]]:
        return self._evaluator.evaluate(self.released() if use_policy else None)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._evaluator.record(self.released(), num_rollouts, num_updates)

    def facts(self) -> dict[str, Any]:
        """Facts of this process for the report."""
        device = self._mesh.devices.flat[0]
        devices = {"platform": device.platform, "kind": device.device_kind, "count": int(self._mesh.devices.size)}
        return {"device": devices, "compile_seconds": round(compile_seconds(), 1)}

    def _enter_phase_of(self, num_updates: int) -> TrainConfig:
        """Before update `num_updates`: makes what its phase changes, if that is another one. Returns its config."""
        config = self._phase_config(num_updates)
        self._learner.set_ppo(config.ppo)
        return config

    @property
    def _drawn_next(self) -> int:
        """Batch whose levels are drawn next, where all that was ordered is played."""
        return self._learner.num_updates + self._config.run.policy_lag

    def _since(self, batch: int) -> int:
        return self._config.schedule.at(batch).curriculum_since

    def _state_of(self, batch: int) -> CurriculumState:
        """State of the curriculum of a batch, which begins where there is none yet."""
        if self._since(batch) not in self._states:
            self._begin_state(batch, None)
        state, curriculum = self._states[self._since(batch)], self._playing.curriculum(self._phase_config(batch))
        if state.curriculum is not curriculum:
            state.set_curriculum(curriculum)
        return state

    def _begin_state(self, batch: int, arrays: Mapping[str, np.ndarray] | None) -> None:
        """The state of a batch, from arrays of a checkpoint or afresh; states of earlier updates are dropped."""
        state = CurriculumState(self._playing.curriculum(self._phase_config(batch)), self._mesh)
        state.start(arrays)
        in_use = self._since(self._learner.num_updates)
        self._states = {since: kept for since, kept in self._states.items() if since >= in_use}
        self._states[self._since(batch)] = state

    def _phase_config(self, update: int) -> TrainConfig:
        return self._config.schedule.at(update).config

    def _metrics(
        self, num_updates: int, sums: Mapping[str, Any], learner_metrics: Mapping[str, Any]
    ) -> dict[str, float]:
        state = self._state_of(num_updates)
        frame_skip = self._phase_config(num_updates).env.frame_skip
        metrics = training_metrics(sums, learner_metrics, frame_skip=frame_skip, sources=state.curriculum.sources)
        return metrics | state.metrics(num_updates)


class Worker(LearnerWorker):
    """Worlds on the devices of a learner shard: batches never leave them."""

    def __init__(self, config: TrainConfig, mesh: Mesh, ahead_of: int | None = None) -> None:
        """ahead_of: programs of that update are compiled in threads from now on, while the process does what comes
        before it, and those of the next refresh by workers too, after that update where it is not the first; where the
        process has cores enough. None: each when it is first used."""
        super().__init__(config, mesh)
        self._update_programs, self._refresh_programs = programs.Ahead(), programs.Ahead()
        self._evaluation_programs = programs.Ahead()
        self._after_update: Callable[[], None] | None = None  # begun in a thread after the next one
        self._worlds: OngoingWorlds | None = None  # that go on into the next update
        self._ahead_of = ahead_of if programs.has_cores() else None
        if self._ahead_of is not None:  # shapes are enough: it does not wait for a checkpoint
            config = self._enter_phase_of(self._ahead_of)
            rollout, state = self._playing.rollout(config), CurriculumState(self._playing.curriculum(config), mesh)
            self._update_programs.begin(lambda: self._compile_update(rollout, state.shapes))

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        super().start(arrays)
        if ongoing := select_arrays(arrays or {}, WORLDS):
            config = self._phase_config(self._learner.num_updates)
            some = Proposal(levels=one_level(config))
            like = jax.eval_shape(lambda: begun(self._playing.environment(config), self._playing.policy, some))
            self._worlds = restored(ongoing, like, self._mesh, self._learner.division)
        if self._ahead_of is None:
            return
        released, is_new = self.released(), self._ahead_of == 0
        is_evaluated = is_new and not self._config.run.only_updates  # it begins with evaluations, see `training_run.py`
        if is_evaluated and jax.process_index() == 0:
            self._evaluation_programs.begin(lambda: self._evaluator.compile_ahead(released))
        times = self._config.refresh_times
        version = times.next(self._ahead_of) if self._config.workers_curate else None
        if version is None:
            return
        num_batches = self._phase_config(times.adopted_at(version)).curriculum.num_batches
        if jax.process_index() < num_batches:  # it has a part of that refresh

            def compile_refresh() -> None:
                self._curator.compile_ahead(released, version)

            if is_new:
                self._refresh_programs.begin(compile_refresh)
            else:  # it makes an update first, and threads that trace take turns with those that launch programs
                self._after_update = compile_refresh

    def _compile_update(self, rollout: RolloutCore, state: Any) -> None:
        """state: shapes of that of the curriculum."""
        traced, batch = rollout.traced(self._learner.shapes.params, state)
        lowered = [program.lower() for program in traced]
        # What is compiled last decides, and threads that trace take turns: not before this.
        self._update_programs.begin(lambda: self._learner.compile(*batch))
        for program in lowered:
            program.compile()

    def evaluate(self, use_policy: bool) -> dict[str, dict[str, Any]]:
        if use_policy:
            self._evaluation_programs.wait()
        return super().evaluate(use_policy)

    @functools.cached_property
    def _curator(self) -> CuratorCore:
        """Curator of a run whose workers score levels."""
        return CuratorCore(self._config)

    def refresh(
        self, params: Any, policy_version: int, part: int, num_parts: int, probe: Any = None, given: Any = None
    ) -> tuple[dict[str, Any], Any]:
        """Refreshes as a curator does, see `CuratorCore.refresh`, on the devices of this process alone."""
        self._refresh_programs.wait()
        self._after_update = None  # compiled by what follows
        return self._curator.refresh(params, policy_version, part, num_parts, probe, given)

    def prepare_refresh(self, policy_version: int) -> None:
        """Compiles what that refresh needs beyond those before, also while an update goes on."""
        self._curator.prepare(policy_version)

    def ongoing_worlds(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint besides `snapshot`: worlds of this process; nothing where the next update resets them.
        One process after the other, they are those of all."""
        return {} if self._worlds is None else stored(self._worlds, self._mesh, self._learner.division)

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float], dict[str, np.ndarray]]:
        """(metrics, seconds of "rollout" and "learn", attempts by source as `RolloutCore.play` sums them)."""
        began = time.monotonic()
        self._update_programs.wait()
        rollout, state = self._playing.rollout(self._enter_phase_of(num_updates)), self._state_of(num_updates)
        batch, seen, sums, self._worlds = rollout.play(
            self._learner.params, state.on_devices, num_updates, self._worlds
        )
        sums = local_values(sums)  # waits for the rollout
        played = time.monotonic()
        env_steps = self._config.schedule.env_steps(num_updates)
        learner_metrics = local_values(self._learner.learn(*batch, env_steps=env_steps))
        if seen is not None:
            state.observe(*seen, env_steps=env_steps, division=rollout.division)
            jax.block_until_ready(state.on_devices)  # a curriculum may learn, too
        learned = time.monotonic()
        if self._after_update is not None:
            self._refresh_programs.begin(self._after_update)
            self._after_update = None
        metrics = self._metrics(num_updates, sums, learner_metrics)
        return metrics, {"rollout": played - began, "learn": learned - played}, sums[BY_SOURCE]
