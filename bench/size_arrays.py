"""What levels of one size cost in arrays of another: one program of the largest arrays against one program a size.

    python -m bench.size_arrays --json runs/size_arrays.json                                      # CPU, small network
    python -m bench.size_arrays --device gpu --recipe pretrain_l --json runs/size_arrays.json     # what decides

For each size and each larger one that its levels are put into: median seconds of the rollout and of the gradient
steps of an update of the recipe, in one process. Levels are the designed ones of the size, spread evenly over the
worlds: what drawing levels costs is not in it. The last record is of the mixture of `pretrain_all`: seconds of an
update in arrays of the largest size, and in programs of one size each, which work one after another on their share of
the worlds. Shares are those of the seconds of a full update: fewer worlds cost more a world, so that is the least.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import statistics
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.errors import user_errors
from kinetix_dist.level.level import SIZES
from kinetix_dist.recipes import recipe

MIXTURE = recipe("pretrain_all").phases[-1].sizes or ()


def measure(options: argparse.Namespace) -> Generator[dict[str, Any]]:
    base = recipe(options.recipe)
    rollout = dataclasses.replace(base.rollout, num_envs=options.worlds or base.rollout.num_envs)
    minibatches = max(1, base.ppo.minibatches * rollout.num_envs // base.rollout.num_envs)
    ppo = dataclasses.replace(base.ppo, minibatches=minibatches)  # as many samples in each
    base = dataclasses.replace(base, rollout=rollout, ppo=ppo)
    about = {"benchmark": "size_arrays", "recipe": options.recipe, "device": options.device}
    about |= {"worlds": rollout.num_envs, "steps": rollout.num_steps, "epochs": ppo.epochs, "minibatches": minibatches}
    seconds_of: dict[tuple[str, str], float] = {}
    for levels, arrays in itertools.combinations_with_replacement(SIZES, 2):
        seconds = _seconds(_config(base, levels, arrays), options.updates)
        seconds_of[levels, arrays] = sum(seconds.values())
        of_own = seconds_of[levels, arrays] / seconds_of[levels, levels]
        parts = {f"{part}_seconds": round(value, 3) for part, value in seconds.items()}
        yield about | {"levels": levels, "arrays": arrays, **parts, "of_own_arrays": round(of_own, 2)}
    largest = list(SIZES)[-1]
    one, own = (
        sum(weight * seconds_of[size, arrays or size] for size, weight in MIXTURE) for arrays in (largest, None)
    )
    about |= {"mixture": dict(MIXTURE), "one_program_seconds": round(one, 3), "one_a_size_seconds": round(own, 3)}
    yield about | {"one_program_costs": round(one / own, 2)}


def _config(base: TrainConfig, levels: str, arrays: str) -> TrainConfig:
    curriculum = CurriculumConfig(name="fixed", levels=f"designed_{levels}")
    return dataclasses.replace(base, env=dataclasses.replace(base.env, size=arrays), curriculum=curriculum)


def _seconds(config: TrainConfig, num_updates: int) -> dict[str, float]:
    """Medians over updates after the first, which compiles."""
    from kinetix_dist.learner.sharding import data_mesh
    from kinetix_dist.runtime.cores.worker import Worker

    worker = Worker(config, data_mesh())
    worker.start(None)
    found = [worker.run_update(update)[1] for update in range(num_updates + 1)][1:]
    return {part: statistics.median(one[part] for one in found) for part in found[0]}


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--recipe", default="quickstart", help="network, worlds and PPO settings")
    parser.add_argument("--worlds", type=int, default=0, help="in place of the recipe's; 0: these")
    parser.add_argument("--updates", type=int, default=3, help="measured, after one that compiles")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--json", type=output_file, help="file for the records")
    args = parser.parse_args()
    return exit_code(parser, lambda: _run(args, args.json))


def _run(options: argparse.Namespace, file: Path | None) -> int:
    import jax

    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[options.device])
    with user_errors(ValueError, RuntimeError):
        report_each(measure(options), file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
