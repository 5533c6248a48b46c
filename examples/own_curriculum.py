"""A curriculum of your own: the levels of a set, those that fail most often drawn most often.

    python examples/own_curriculum.py                       trains for seconds on the CPU
    PYTHONPATH=examples kinetix-dist train --recipe quickstart --run.plugins own_curriculum \\
        --curriculum.name most_failed --curriculum.levels designed_s

A curriculum proposes the levels of an update and sees what became of them. Its state is one pytree of arrays, which
checkpoints hold; its methods are pure, so that a run is repeated bit for bit.
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp

from kinetix_dist.cli.main import main
from kinetix_dist.curator.curricula import CURRICULA
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.telemetry.names import Metric, register_metric

State = dict[str, jax.Array]  # episodes of each level: "finished" and "solved", [levels]


class MostFailed(Curriculum):
    """Draws a level with weight 1 + its failed episodes."""

    observes = True
    takes_levels = True
    draws_levels = False  # none from the generator

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self.levels = tools.load_levels(tools.config.levels)

    def init(self) -> State:
        return dict.fromkeys(("finished", "solved"), jnp.zeros(len(self.levels.position), jnp.int32))

    def propose(self, state: State, group_keys: jax.Array, groups: jax.Array) -> Proposal:
        # Worlds come in groups, each with its key, so that levels do not depend on the number of devices.
        weight = jnp.log(1.0 + state["finished"] - state["solved"])
        shape = (self.tools.worlds_per_group,)
        index = jax.vmap(lambda key: jax.random.categorical(key, weight, shape=shape))(group_keys).reshape(-1)
        return Proposal(levels=jax.tree.map(lambda x: jnp.asarray(x)[index], self.levels), tags=index)

    def observe(self, state: State, proposal: Proposal, outcome: LevelOutcome) -> State:
        return {name: state[name].at[proposal.tags].add(getattr(outcome, f"num_{name}")) for name in state}

    def metrics(self, state: State, num_updates: int) -> dict[str, jax.Array]:
        return {"curriculum/levels_tried": (state["finished"] > 0).mean()}


if __name__ == "__main__":
    options = ["--run.plugins", "own_curriculum", "--curriculum.name", "most_failed"]
    raise SystemExit(main(["train", "--recipe", "tiny", *options, "--curriculum.levels", "designed_s", *sys.argv[1:]]))

# A run imports this file as a plugin, in each of its processes: the name is known from then on.
CURRICULA.register("most_failed", MostFailed)
register_metric(Metric("curriculum/levels_tried", "share", "levels of the set with an episode that finished"))
