"""Whether training several specialists at once by `jax.vmap` pays: seconds an update, alone and of several together.

    python -m bench.runs_at_once --recipe quickstart --worlds 8 32 --runs 8 [--json FILE]

An update is that of `kinetix-dist finetune --each`: a rollout of `--worlds` worlds on one level and what is learned
from it. `--runs` of them, each with parameters, optimiser and level of its own, are one program by `jax.vmap`. `ratio`
is how many times as fast that is as one after another; below 1, one after another is faster. `cpu_ratio` is the same
of seconds of all cores, for machines that do other work meanwhile. Medians of turns, one and several by turns.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from bench.program import exit_code, output_file, parser_of, report_each
from jax2d.scene import Array
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import user_errors
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.learner.update import make_update
from kinetix_dist.level.level import Level
from kinetix_dist.models.policy import make_policy
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.learner_core import LearnerCore
from kinetix_dist.runtime.cores.playing import make_environment
from kinetix_dist.runtime.cores.rollout_core import RolloutCore


def config_of(name: str, level: str, worlds: int) -> TrainConfig:
    """A recipe on one level, with so many worlds."""
    base = recipe(name)
    return dataclasses.replace(
        base,
        curriculum=dataclasses.replace(base.curriculum, name="fixed", levels=level),
        rollout=dataclasses.replace(base.rollout, num_envs=worlds),
    )


def update_of(config: TrainConfig) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """A whole update as one function of (learner state, levels, number), and arguments for it."""
    mesh = data_mesh(jax.local_devices()[:1])
    env = make_environment(config)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    learner = LearnerCore(config, env, policy, mesh)
    curriculum = make_curriculum(config, env, policy, mesh)
    groups = range(config.rollout.num_groups)
    rollout = RolloutCore(config, env, policy, curriculum, mesh, groups=groups, division=learner.division)
    learn = make_update(policy, env.observation, env.action_distribution, config.ppo, mesh, division=learner.division)

    def update(state: LearnerState, levels: Level, number: Array) -> tuple[LearnerState, Any]:
        batch, _, sums = rollout.play(state.params, levels, number)
        return learn(state, *batch)[0], sums

    learner.start(None)
    return update, (learner.state, jax.tree.map(jnp.asarray, curriculum.init()), jnp.uint32(0))


@dataclasses.dataclass(frozen=True)
class Seconds:
    """Of one call: of the clock, and of all cores together, which other processes on them lengthen less."""

    wall: float
    cpu: float


def timed(program: Callable[..., Any], given: tuple[Any, ...]) -> Seconds:
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(program(*given))
    return Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def measured(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One record for each number of worlds."""
    num_runs = arguments.runs
    for worlds in arguments.worlds:
        with user_errors(ValueError, OSError):
            update, one = update_of(config_of(arguments.recipe, arguments.level, worlds))
        several = jax.tree.map(lambda x: jnp.stack([x] * num_runs), one)
        alone, together = jax.jit(update), jax.jit(jax.vmap(update))
        turns = [(timed(alone, one), timed(together, several)) for _ in range(arguments.repeats + 1)]
        turns = turns[1:]  # the first compiles
        of_one = Seconds(*(statistics.median(getattr(a, kind) for a, _ in turns) for kind in ("wall", "cpu")))
        of_several = Seconds(*(statistics.median(getattr(b, kind) for _, b in turns) for kind in ("wall", "cpu")))
        yield {
            "device": jax.devices()[0].device_kind,
            "recipe": arguments.recipe,
            "worlds": worlds,
            "runs": num_runs,
            "seconds_alone": dataclasses.asdict(of_one),
            "seconds_together": dataclasses.asdict(of_several),
            "ratio": round(of_one.wall * num_runs / of_several.wall, 3),
            "cpu_ratio": round(of_one.cpu * num_runs / of_several.cpu, 3),
        }


def run(arguments: argparse.Namespace) -> int:
    report_each(measured(arguments), arguments.json)
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--recipe", default="quickstart")
    parser.add_argument("--level", default="s/hop_home")
    parser.add_argument("--worlds", type=int, nargs="+", default=[8, 32, 256])
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
