"""The curriculum of a process: built from a run's config, and its state kept between updates."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist.actors.unroll import score
from kinetix_dist.checkpoint import select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import local_values, replicate, replicated, shapes_of_replicated
from kinetix_dist.learner.state import at_env_steps, clock
from kinetix_dist.learner.update import advantages_of
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.messages import LevelOutcome, Trajectory
from kinetix_dist.runtime.cores.agents import PpoAgents
from kinetix_dist.runtime.cores.programs import MAX_KEPT, settings_of_programs
from kinetix_dist.runtime.cores.stored import CURRICULUM


def make_curriculum(config: TrainConfig, env: Environment, policy: Any, mesh: Mesh) -> Curriculum:
    """The curriculum of a run with what it is built from. mesh: on which what it trains of its own learns.

    It holds no state, and is the same for runs of equal settings. One that is given levels reads them each time.
    """
    arguments = settings_of_programs(config), env, policy, mesh, config.curriculum_class
    return _built(*arguments) if config.curriculum.levels else _kept(*arguments)


def _built(config: TrainConfig, env: Environment, policy: Any, mesh: Mesh, kind: type[Curriculum]) -> Curriculum:
    def play(params: Any, levels: Level, key: Array, num_steps: int) -> LevelOutcome:
        return score(policy, params, env, env.prepare(levels), key, num_steps)

    def advantages(trajectory: Trajectory, last_value: Array) -> Array:
        return advantages_of(trajectory, last_value, config.ppo)

    tools = CurriculumTools(
        config=config.curriculum,
        capacity=env.capacity,
        worlds_per_group=config.rollout.worlds_per_group,
        max_steps=config.env.max_steps,
        solves_itself=lambda levels: noop_solved(env, levels),
        play=play,
        load_levels=lambda name: load_level_set(name, config.env.size)[0],
        advantages=advantages,
        agents=PpoAgents(config, env, policy, mesh),
    )
    return kind(tools)


_kept = functools.lru_cache(maxsize=MAX_KEPT)(_built)


class CurriculumState:
    """The state of a curriculum, replicated over the devices of a mesh."""

    def __init__(self, curriculum: Curriculum, mesh: Mesh) -> None:
        self._mesh = mesh
        self.set_curriculum(curriculum)
        self.placed: Any = None  # on the devices
        self._values: Any = None  # the same as numpy

    def set_curriculum(self, curriculum: Curriculum) -> None:
        """Whose state this is from now on: one with states of the same layout."""
        self._curriculum = curriculum
        self._observe = _observe_program(curriculum, self._mesh)

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """From a checkpoint's arrays or afresh."""
        stored = select_arrays(arrays or {}, CURRICULUM)
        if stored:
            self._place(self.restored(stored))
        elif self._curriculum.refreshes:
            self._place(None)  # the first refresh comes before the first levels
        else:
            self._place(jax.device_get(jax.jit(self._curriculum.init)()))  # one program, not hundreds of small ones

    def restored(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """A state from arrays of a checkpoint, as numpy."""
        return unflatten_arrays(jax.eval_shape(self._curriculum.init), arrays)

    def adopt(self, parts: Sequence[Any]) -> None:
        """parts: of a refresh, in order."""
        self._place(jax.device_get(self._curriculum.adopt(self.values, self._curriculum.join(parts))))

    def observe(
        self, proposal: Proposal, outcome: LevelOutcome, *, env_steps: int, division: Division | None = None
    ) -> None:
        """proposal, outcome: replicated, each world once, or sharded over the mesh, in all places of `division`.
        env_steps: of the run before this update, by which agents of the curriculum anneal."""
        state = at_env_steps(self.placed, replicate(clock(env_steps), self._mesh))
        self.placed, self._values = self._observe(state, proposal, outcome, division), None

    @property
    def values(self) -> Any:
        """The state as numpy."""
        if self._values is None:
            self._values = local_values(self.placed)
        return self._values

    @property
    def shapes(self) -> Any:
        """Of `placed`, with its shardings; also before the start and a first refresh."""
        return shapes_of_replicated(jax.eval_shape(self._curriculum.init), self._mesh)

    def metrics(self, num_updates: int) -> dict[str, float]:
        metrics = self._curriculum.metrics(self.values, num_updates)
        return {name: float(np.asarray(value)) for name, value in metrics.items()}

    def _place(self, values: Any) -> None:
        self._values, self.placed = values, replicate(values, self._mesh)


@functools.lru_cache(maxsize=MAX_KEPT)
def _observe_program(curriculum: Curriculum, mesh: Mesh) -> Callable[..., Any]:
    """(state, proposal, outcome, division) -> the next state."""

    def observe(state: Any, proposal: Proposal, outcome: LevelOutcome, division: Division | None) -> Any:
        # Every device sees all worlds and works out the same: no result depends on how many devices there are.
        seen = jax.lax.with_sharding_constraint((proposal, outcome), replicated(mesh))
        if division is not None and not division.is_even:
            seen = jax.tree.map(lambda x: x[division.gathered(x.shape[0])], seen)
        after = curriculum.observe(state, *seen)
        if _layout(after) != _layout(state):
            raise ValueError(
                f"observe of curriculum {curriculum.tools.config.name!r} returned other parts, shapes or "
                f"types: {_layout(after)} instead of {_layout(state)}"
            )
        return after

    return jax.jit(observe, static_argnums=3, out_shardings=replicated(mesh))


def _layout(state: Any) -> Any:
    return jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", state)
