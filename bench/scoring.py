"""What a refresh claims of the levels that it keeps, and what they are: p (1 - p) by many attempts of the same policy.

    python -m bench.scoring runs/quickstart --keep 32 --candidates 512 --measure 64 [--json FILE]

The policy of the newest checkpoint scores fresh candidates twice: as `sfl` does, with the run's `scoring_steps`, and as
`sfl_slices` does, by successive halving. `episodes` is the time of scoring in whole episodes, levels that solve
themselves left aside. Other levels in each: the two are compared by their standard errors.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import jax

from bench.learnability import mean_of, solved_of
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import SlicesConfig
from kinetix_dist.curator.halving import num_launches
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.load_policy import released_arrays
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.driver.weight_sync import nested
from kinetix_dist.trained_policy import Trained, newest_checkpoint_of

VERSION = 1  # of the policy; not 0, at which `sfl_slices` fills a whole buffer


def scored(trained: Trained, config: TrainConfig, measure: int) -> dict[str, Any]:
    """One scoring by `config.curriculum` and what its levels are."""
    curriculum_config = config.curriculum
    env = make_environment(config)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    curriculum = make_curriculum(config, env, policy, data_mesh())
    params = jax.device_put(nested(released_arrays(trained.checkpoint)))
    parts = [curriculum.refresh_part(params, VERSION, jax.random.key(0), 0, 1)]
    kept = curriculum.join(parts)
    solved = solved_of(trained, kept.levels, measure)
    num, batch = curriculum_config.num_candidates, curriculum_config.scoring_batch
    slices = curriculum_config.slices
    episodes = num * curriculum_config.scoring_steps / config.env.max_steps
    if curriculum_config.name == "sfl_slices":
        episodes = num * num_launches(slices.attempts, slices.kept(batch))
    mean, error = mean_of(solved, solved * 0 + measure) or (float("nan"), float("nan"))
    return {
        "curriculum": curriculum_config.name,
        "candidates": num,
        "kept": len(kept.score),
        "episodes": episodes,
        "claimed": round(float(kept.score.mean()), 4),
        "measured": round(mean, 4),
        "error": round(error, 4),
        "attempts": measure,
    }


def run(arguments: argparse.Namespace) -> int:
    if arguments.measure < 2:
        raise UserError(f"--measure is {arguments.measure}; give 2 or more attempts")
    if arguments.candidates < 2 or arguments.candidates % 2:
        raise UserError(f"--candidates is {arguments.candidates}; they are scored in two batches: give an even number")
    trained, _ = newest_checkpoint_of(arguments.run)
    batch = arguments.candidates // 2
    # Numbers that cannot be scored are refused by the configuration and by its curriculum.
    with user_errors(ValueError):
        configs = [
            dataclasses.replace(
                trained.config,
                curriculum=dataclasses.replace(
                    trained.config.curriculum,
                    name=name,
                    num_candidates=2 * batch,
                    scoring_batch=batch,
                    buffer_size=arguments.keep,
                    slices=SlicesConfig(slice_size=arguments.keep),
                ),
            )
            for name in ("sfl", "sfl_slices")
        ]
        for config in configs:
            _ = config.curriculum_class
    report_each((scored(trained, config, arguments.measure) for config in configs), arguments.json)
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--keep", type=int, default=32)
    parser.add_argument("--candidates", type=int, default=512)
    parser.add_argument("--measure", type=int, default=64)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
