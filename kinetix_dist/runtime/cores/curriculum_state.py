"""Curriculum of a process: built from the config of a run, its state, and the PPO agents that it trains."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors.unroll import score
from kinetix_dist.checkpoint import select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.config.refresh_times import RefreshTimes
from kinetix_dist.curator.agents import AgentPpo
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.env.action_spaces import ActionDistribution
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.env.observations import Moving, Observation
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import local_values, replicate, replicated, shapes_of_replicated
from kinetix_dist.learner.state import LearnerState, at_env_steps, clock
from kinetix_dist.learner.update import Update, advantages_of, make_update
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.messages import LevelOutcome, StaticInput, Trajectory
from kinetix_dist.models.policy import init_params
from kinetix_dist.runtime.cores.programs import MAX_CACHED, settings_of_programs
from kinetix_dist.runtime.cores.run_names import ANTAGONIST, CURRICULUM, TEACHER, one_level, stream


class PpoAgents:
    """PPO agents of one run, which learn besides the policy on the devices of a mesh (`curator/agents.py`)."""

    def __init__(self, config: TrainConfig, env: Environment, policy: nn.Module, mesh: Mesh) -> None:
        self._config = config
        self._env = env
        self._policy = policy
        self._mesh = mesh

    def student(self) -> PpoAgent:
        env = self._env
        obs = jax.eval_shape(lambda: some_observation(self._config, env))
        interface = AgentInterface(env.observation, env.action_distribution, obs)
        return self._agent(self._policy, interface, self._config.ppo, stream_number=ANTAGONIST)

    def teacher(self, policy: nn.Module, distribution: ActionDistribution, obs: Any, ppo: AgentPpo) -> PpoAgent:
        settings = dataclasses.replace(self._config.ppo, **dataclasses.asdict(ppo))
        interface = AgentInterface(_NoEnvironment(), distribution, obs)
        return self._agent(policy, interface, settings, stream_number=TEACHER)

    def static_input(self, levels: Level) -> StaticInput:
        env, is_masked = self._env, self._config.ppo.mask_unbound_heads
        bound = env.action_space.bound_heads(levels) if is_masked else None
        return StaticInput(obs=env.observation.static(levels), bound_heads=bound)

    def _agent(self, policy: nn.Module, interface: AgentInterface, ppo: PpoConfig, *, stream_number: int) -> PpoAgent:
        key = stream(self._config.run.seed, stream_number)
        return PpoAgent(policy, interface, ppo, self._mesh, num_blocks=self._config.num_blocks, key=key)


class AgentInterface(NamedTuple):
    """Input and output of an agent's policy."""

    observation: Observation
    distribution: ActionDistribution  # of its actions
    obs: Any  # shapes of what the policy takes, [1, ...]


class PpoAgent:
    """See `Agent`. num_blocks: of worlds, see `TrainConfig.num_blocks`; key: typed, consumed."""

    def __init__(
        self,
        policy: nn.Module,
        interface: AgentInterface,
        ppo: PpoConfig,
        mesh: Mesh,
        *,
        num_blocks: int,
        key: Array,
    ) -> None:
        self._policy = policy
        self._observation, self._distribution, self._obs = interface
        self._ppo = ppo
        self._mesh = mesh
        self._num_blocks = num_blocks
        self._keys = prng.split(key)

    def init(self) -> LearnerState:
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._obs)
        return self._ppo.initial_state(init_params(self._policy, zeros, self._keys[0]), self._keys[1])

    def learn(
        self, state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[LearnerState, dict[str, Array]]:
        if self._division.is_even:
            return self._update(state, static, trajectory, last_value)
        slots = self._division.spread(last_value.shape[0])
        static, trajectory = (
            jax.tree.map(lambda x: x[slots], static),
            jax.tree.map(lambda x: x[:, slots], trajectory),
        )
        return self._update(state, static, trajectory, last_value[slots])

    # Made by those alone who learn: rollout actors may have more devices than there are blocks.

    @functools.cached_property
    def _division(self) -> Division:
        return Division(self._num_blocks, self._mesh.devices.size)

    @functools.cached_property
    def _update(self) -> Update:
        return make_update(
            self._policy, self._observation, self._distribution, self._ppo, self._mesh, division=self._division
        )


class _NoEnvironment(Observation):
    """All that a teacher sees changes from step to step, and no physics moves it."""

    gives = "construction"

    def static(self, levels: Level) -> None:
        raise NotImplementedError("a teacher sees no finished levels")

    def dynamic(self, moving: Moving) -> None:
        raise NotImplementedError("a teacher sees no physics")

    def join(self, static: None, dynamic: Any) -> Any:
        return dynamic


def some_observation(config: TrainConfig, env: Environment) -> Any:
    """Observation that a policy takes, of any level of the run: [1, ...], for shapes."""
    prepared = env.prepare(one_level(config))
    return env.observe(prepared, prepared.initial_obs)


def make_curriculum(
    config: TrainConfig, env: Environment, policy: Any, mesh: Mesh, *, times: RefreshTimes | None = None
) -> Curriculum:
    """The curriculum of a run, or of a phase, with what it is built from. mesh: on which what it trains of its own
    learns; times: of refreshes of the run whose phase this is, None: it is a run.

    It holds no state, and is the same for runs of equal settings. One that is given levels reads them each time.
    """
    arguments = settings_of_programs(config), env, policy, mesh, config.curriculum_class, times or config.refresh_times
    return _built(*arguments) if config.curriculum.levels else _cached(*arguments)


def _built(
    config: TrainConfig, env: Environment, policy: Any, mesh: Mesh, kind: type[Curriculum], times: RefreshTimes
) -> Curriculum:
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
        is_first_refresh=times.is_first,
    )
    return kind(tools)


_cached = functools.lru_cache(maxsize=MAX_CACHED)(_built)


class CurriculumState:
    """The state of a curriculum, replicated over the devices of a mesh."""

    def __init__(self, curriculum: Curriculum, mesh: Mesh) -> None:
        self._mesh = mesh
        self.set_curriculum(curriculum)
        self.on_devices: Any = None  # on the devices
        self._values: Any = None  # the same as numpy

    def set_curriculum(self, curriculum: Curriculum) -> None:
        """Whose state this is from now on: one with states of the same layout."""
        self.curriculum = curriculum
        self._observe = _observe_program(curriculum, self._mesh)

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """Starts from a checkpoint's arrays, or afresh."""
        stored = select_arrays(arrays or {}, CURRICULUM)
        if stored:
            self._set(self.restored(stored))
        elif self.curriculum.refreshes:
            self._set(None)  # the first refresh comes before the first levels
        else:
            self._set(jax.device_get(jax.jit(self.curriculum.init)()))  # one program, not hundreds of small ones

    def restored(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """A state from arrays of a checkpoint, as numpy."""
        return unflatten_arrays(jax.eval_shape(self.curriculum.init), arrays)

    def adopt(self, parts: Sequence[Any]) -> None:
        """parts: of a refresh, in order."""
        self._set(jax.device_get(self.curriculum.adopt(self.values, self.curriculum.join(parts))))

    def observe(
        self, proposal: Proposal, outcome: LevelOutcome, *, env_steps: int, division: Division | None = None
    ) -> None:
        """proposal, outcome: replicated, each world once, or sharded over the mesh, in all slots of `division`.
        env_steps: of the run before this update, by which agents of the curriculum anneal."""
        state = at_env_steps(self.on_devices, replicate(clock(env_steps), self._mesh))
        self.on_devices, self._values = self._observe(state, proposal, outcome, division), None

    @property
    def values(self) -> Any:
        """The state as numpy."""
        if self._values is None:
            self._values = local_values(self.on_devices)
        return self._values

    @property
    def shapes(self) -> Any:
        """Shapes of `on_devices`, with its shardings; also before the start and a first refresh."""
        return shapes_of_replicated(jax.eval_shape(self.curriculum.init), self._mesh)

    def metrics(self, num_updates: int) -> dict[str, float]:
        metrics = self.curriculum.metrics(self.values, num_updates)
        return {name: float(np.asarray(value)) for name, value in metrics.items()}

    def _set(self, values: Any) -> None:
        self._values, self.on_devices = values, replicate(values, self._mesh)


@functools.lru_cache(maxsize=MAX_CACHED)
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
