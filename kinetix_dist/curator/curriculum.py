"""Interface of a curriculum: it proposes the levels of an update, observes their outcomes, and owns its state.

    levels of update u   proposal = propose(state, keys of the world groups, numbers of the groups)     on every device
    who plays them       policy, params = players(policy, params, state)        that of the run, unless it says so
    where it was played  outcome.summary = summarise(trajectory, last values)               if it `observes`
    after update u       state = observe(state, proposal, outcome)                          if it `observes`
    now and then         given = refresh_input(state)                                       if it `refreshes_from_state`
                         refreshed = refresh(params, policy version, key, given)            if it `refreshes`
                         refreshed = join(refresh_part(..., part, num_parts) of each part)  if it `shares_refresh`
                         state = adopt(state, refreshed)

`refresh` runs in the background in a process of its own, the curator, or in those that train, between two updates: it
is requested every `refresh_every` updates and its result adopted at an update that is fixed beforehand. Several
curators work out a part each where the curriculum can join them. The state is one pytree of arrays, the same on all
devices; checkpoints hold it. All methods are pure, so that a lost process repeats what it did bit for bit.

How others are written: `plr.py` keeps a buffer of levels with scores as its state, proposes some of it and some fresh
levels, and scores what was played in `observe`. `accel.py` also proposes changed levels of it. In `paired.py` a second
student plays half of the worlds; it and a teacher, who builds the levels, learn in `observe`. A bandit over level sets
observes success and proposes accordingly. Each is one file and its registration.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jax2d.scene import Array, Capacity
from kinetix_dist.curator.agents import Agents
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.fresh_levels import fresh_levels
from kinetix_dist.level.level import Level
from kinetix_dist.level.mutators import mutate
from kinetix_dist.messages import LevelOutcome, Trajectory


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Proposal:
    """Levels to play, one a world, and what the curriculum needs of each when it observes."""

    levels: Level  # [W, ...]
    tags: Any = None  # any pytree, [W, ...] (or as many rows a group): where in the state a level comes from, say
    # [W] int32, for the counts of outcomes.jsonl: an index into `Curriculum.sources`, or their number + a slot of the
    # buffer (`num_slots`). None: all are of the first source.
    source: Array | None = None
    # [W] int32: of a world whose fresh level another world of its group plays too, the number of that one in the group;
    # -1: a level of its own. Of such pairs outcomes.jsonl has the learnability of fresh levels (`fresh_pairs.py`).
    # None: there are none.
    copy_of: Array | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumTools:
    """Parts that curricula are built from: levels of the run and ways to play them."""

    config: CurriculumConfig
    capacity: Capacity
    worlds_per_group: int
    max_steps: int  # environment steps in which every episode has ended
    solves_itself: Callable[[Level], Array]  # [W, ...] -> [W] bool, solved without any action
    play: Callable[[Any, Level, Array, int], LevelOutcome]  # (params, levels, key, steps): episodes of the policy
    load_levels: Callable[[str], Level]  # of a level set or a path, in the run's size
    advantages: Callable[[Trajectory, Array], Array]  # (trajectory, last values) -> [T, W], the learner's
    agents: Agents  # that learn next to the policy
    # Whether the refresh of a policy version is the first one of a state, in the run or in a phase.
    is_first_refresh: Callable[[int], bool] = lambda policy_version: policy_version == 0
    devices: Sequence[Any] = dataclasses.field(default_factory=jax.local_devices)  # for `refresh`, of this process

    def draw_fresh(self, group_keys: Array, levels_per_group: int) -> Level:
        """[groups * levels_per_group] random levels, group by group; with `filter_noop` without those that solve
        themselves."""
        return fresh_levels(
            group_keys,
            levels_per_group,
            capacity=self.capacity,
            generator=self.config.generator,
            solves_itself=self.solves_itself if self.config.filter_noop else None,
            sizes=self.config.sizes,
        )

    def edit(self, keys: Array, levels: Level) -> Level:
        """[W, ...] levels, each after `accel.num_changes` random mutators. Consumes the keys [W]."""
        config = self.config

        def one(key: Array, level: Level) -> Level:
            return mutate(key, level, self.capacity, config.generator, config.accel.num_changes)[0]

        return jax.vmap(one)(keys, levels)


class Curriculum(abc.ABC):
    """Proposes, observes and refreshes levels. Built in each process that does so, once for equal settings."""

    observes: bool = False  # sees outcomes after each update
    refreshes: bool = False  # has a curator
    refreshes_from_state: bool = False  # a refresh is given more than the policy: it has `refresh_input`
    shares_refresh: bool = False  # several curators can work it out: it has `refresh_part` and `join`
    takes_levels: bool = False  # needs `curriculum.levels`
    draws_levels: bool = True  # from the generator, of the sizes of `curriculum.sizes`
    needs_whole_episodes: bool = False  # an episode ends in every world of an update: `num_steps` >= `max_steps`
    scores_by_steps: bool = False  # a refresh plays `curriculum.scoring_steps` steps of each candidate
    sources: tuple[str, ...] = ("all",)  # where levels come from that are counted together in outcomes.jsonl
    sections: tuple[str, ...] = ()  # of `CurriculumConfig` that are its own: the hash of other runs leaves them out

    def __init__(self, tools: CurriculumTools) -> None:
        self.tools = tools

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        """Raises ValueError for a configuration that it cannot run with."""
        del config, worlds_per_group

    @classmethod
    def num_trained(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        """Worlds of a group that the policy learns from, the first ones; the others are played and observed only."""
        del config
        return worlds_per_group

    @classmethod
    def num_episodes(cls, config: CurriculumConfig) -> int:
        """Episodes that have to end in every world of an update, at least: `num_steps` is as many times `max_steps`."""
        del config
        return int(cls.needs_whole_episodes)

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        """Levels that a group draws from the generator in an update."""
        del config
        return worlds_per_group if cls.draws_levels else 0

    @property
    def num_slots(self) -> int:
        """Levels whose episodes are counted one by one, for outcomes.jsonl: those of a buffer."""
        return 0

    def init(self) -> Any:
        """The first state, also the shapes and types of later ones; None: it has none.

        `propose` is never called with this state where a curriculum refreshes: its first refresh comes before.
        """
        return None

    @abc.abstractmethod
    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        """`worlds_per_group` levels for each group, in the order of the groups. Works inside jit and shard_map.

        group_keys [g]: a typed key for each group of this update; groups [g]: their numbers. The levels of a group
        must depend on the state, on its key and on its number only, so that they do not depend on how groups are
        spread over devices.
        """

    def players(self, policy: Any, params: Any, state: Any) -> tuple[Any, Any]:
        """Policy, with its parameters, that plays the worlds of an update; by default that of the run.

        The policy has `apply(params, obs)` -> (outputs, values) for the worlds of one device, group by group; the run
        learns from the first `num_trained` of each group, where its own policy has to act. Inside jit and shard_map.
        """
        del state
        return policy, params

    def summarise(self, trajectory: Trajectory, last_value: Array) -> Any:
        """Summary of the trajectory for `observe` (`outcome.summary`): a pytree [W, ...], by default nothing.
        Leaves may have fewer rows, as many for each group.

        trajectory [T, W, ...], last_value [W]: of the worlds of one device, on which it works, inside jit and
        shard_map. A world's part must depend on that world only. The trajectory itself goes to the learner alone.
        """
        del trajectory, last_value
        return None

    def observe(self, state: Any, proposal: Proposal, outcome: LevelOutcome) -> Any:
        """The next state. proposal, outcome: of all worlds of an update, [W, ...], in the order of the groups."""
        raise NotImplementedError

    def refresh_input(self, state: Any) -> Any:
        """Input of a refresh that is requested now: a pytree of arrays, as numpy, with the shapes of that of
        `init()`; None where state is None. Checkpoints hold it while the refresh is in flight."""
        raise NotImplementedError

    def refresh(self, params: Any, policy_version: int, key: Array, given: Any = None) -> Any:
        """Work of the curator with the policy's parameters: a pytree for `adopt`. Not inside jit.

        given: `refresh_input` at the request; None without one."""
        raise NotImplementedError

    def refresh_part(
        self, params: Any, policy_version: int, key: Array, part: int, num_parts: int, given: Any = None
    ) -> Any:
        """Work of curator `part` of `num_parts`: a pytree for `join`. Not inside jit."""
        del part, num_parts
        return self.refresh(params, policy_version, key, given)

    def join(self, parts: Sequence[Any]) -> Any:
        """Input of `adopt`, as numpy, from all parts in order. It must not depend on their number."""
        (refreshed,) = parts
        return refreshed

    def adopt(self, state: Any, refreshed: Any) -> Any:
        """The next state; by default the refreshed one replaces it. state: None at the first time."""
        del state
        return refreshed

    def metrics(self, state: Any, num_updates: int) -> dict[str, Any]:
        """Numbers to report after `num_updates` updates, by name: "curriculum/NAME", described in `telemetry.names`
        or by `register_metric`."""
        del state, num_updates
        return {}

    # Records for dashboards, see docs/run_data.md. None of it changes a number of training.

    @classmethod
    def refresh_log(cls, config: CurriculumConfig, parts: Sequence[Any]) -> dict[str, np.ndarray] | None:
        """Arrays of a refresh_*.npz from the parts of a refresh, levels below "levels/"; None: nothing is written."""
        del config, parts
        return None

    @classmethod
    def buffer_log(cls, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """Arrays of a buffer_*.npz from the arrays of a state by path; None: nothing is written."""
        del state
        return None

    def probe(self, state: Any, num_levels: int) -> Any:
        """Levels of the state, as numpy, that the next refresh plays again: for `play_probe`; None: there are none."""
        del state, num_levels
        return None

    def play_probe(self, params: Any, probe: Any, key: Array) -> dict[str, np.ndarray]:
        """Outcomes of the probe's levels, by the names below "probe/" in a refresh_*.npz. Not inside jit."""
        raise NotImplementedError

    def compile_refresh(self, params: Any) -> None:
        """Compiles what `refresh` or `refresh_part` will run with such parameters, ahead of it, as far as it pays."""
        del params

    def compile_probe(self, params: Any, num_levels: int) -> None:
        """Compiles what `play_probe` will run with such parameters and so many levels, ahead of it."""
        del params, num_levels
