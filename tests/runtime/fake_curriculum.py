"""A curriculum of a user: levels of a set, those that fail most often drawn most often. Registered by import."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from kinetix_dist.curator.curricula import CURRICULA
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.telemetry.names import Metric, register_metric


class MostFailed(Curriculum):
    """Its state: episodes of each level, finished and solved."""

    observes = True
    takes_levels = True

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self.levels = tools.load_levels(tools.config.levels)

    def init(self) -> dict[str, jax.Array]:
        return dict.fromkeys(("finished", "solved"), jnp.zeros(len(self.levels.position), jnp.int32))

    def propose(self, state: dict, group_keys: jax.Array, groups: jax.Array) -> Proposal:
        weight, shape = jnp.log(1.0 + state["finished"] - state["solved"]), (self.tools.worlds_per_group,)
        index = jax.vmap(lambda key: jax.random.categorical(key, weight, shape=shape))(group_keys).reshape(-1)
        return Proposal(levels=jax.tree.map(lambda x: jnp.asarray(x)[index], self.levels), tags=index)

    def observe(self, state: dict, proposal: Proposal, outcome: LevelOutcome) -> dict:
        return {name: state[name].at[proposal.tags].add(getattr(outcome, f"num_{name}")) for name in state}

    def metrics(self, state: dict, num_updates: int) -> dict[str, float]:
        return {"curriculum/levels_tried": (state["finished"] > 0).mean()}


CURRICULA.register("most_failed", MostFailed)
register_metric(Metric("curriculum/levels_tried", "share", "levels of the set with an episode that finished"))
