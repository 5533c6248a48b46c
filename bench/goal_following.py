"""How well policies go below a goal, by kind of body (paper, "Zero-shot Locomotion of an Arbitrary Morphology").

    python -m bench.goal_following --checkpoint generalist --morphologies car thrusters random

Each level (kinetix_dist/level/goal_following.py) is played for 64 environment steps, to get there, and for 64 more, in
which the x of green is compared with that of the goal. Printed for the policy and for random actions: the correlation
of the two over levels, with a 95 % interval (Fisher's z), and the mean distance in x.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.checkpoint import CheckpointError, load_checkpoint
from kinetix_dist.config import from_dict_for_playing
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.intervals import Z_95
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.goal_following import MORPHOLOGIES, GoalFollowingLevels
from kinetix_dist.level.level import SIZES, Role
from kinetix_dist.telemetry.recording import Rollout

STEPS_TO_GET_THERE, STEPS_SEEN = 64, 64  # paper, the same section
LARGE = "snake"  # has no room in size M


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, prog="python -m bench.goal_following")
    parser.add_argument("--checkpoint", type=Path, required=True, help="a checkpoint or a pretrained policy")
    parser.add_argument("--morphologies", nargs="+", choices=tuple(MORPHOLOGIES), default=list(MORPHOLOGIES))
    parser.add_argument("--levels", type=int, default=512, help="of each morphology")
    parser.add_argument("--seed", type=int, default=0, help="of levels and actions")
    parser.add_argument("--json", type=output_file)
    args = parser.parse_args(arguments)
    return exit_code(parser, lambda: run(args))


def run(args: argparse.Namespace) -> int:
    if args.levels < 4:
        raise UserError(f"--levels is {args.levels}; an interval needs 4 or more")
    with user_errors(CheckpointError, ValueError, OSError):
        checkpoint = load_checkpoint(args.checkpoint)
        config = from_dict_for_playing(checkpoint.description["config"])
    rows = []
    for morphology in args.morphologies:
        size = "l" if morphology == LARGE else "m"
        steps = STEPS_TO_GET_THERE + STEPS_SEEN
        env = Environment(dataclasses.replace(config.env, size=size, max_steps=steps))
        key = jax.random.key(args.seed)
        levels = jax.device_get(GoalFollowingLevels(SIZES[size], morphology).generate(key, args.levels))
        with user_errors(ValueError, prefix=f"{args.checkpoint}: "):
            module, params = load_policy(checkpoint, config.policy, env, levels)
        players = {
            "policy": Player(NetworkPolicy(module, env.action_distribution), params),
            "random": Player(RandomPolicy(env.action_space)),
        }
        for name, player in players.items():
            rollouts = record_rollouts(env, player, levels, jax.random.fold_in(key, 1), seed=args.seed)
            rows.append({"morphology": morphology, "actions": name, **follows(rollouts)})
            row = rows[-1]
            print(
                f"{morphology:10} {name:7} correlation {row['correlation']:6.3f} "
                f"({row['low']:.3f} to {row['high']:.3f}), distance in x {row['distance_m']:.2f} m",
                flush=True,
            )
    if args.json:
        document = {"checkpoint": str(args.checkpoint), "levels": args.levels, "seed": args.seed, "rows": rows}
        args.json.write_text(json.dumps(document, indent=1) + "\n")
    return 0


def follows(rollouts: Sequence[Rollout]) -> dict[str, float]:
    """Correlation over levels of the goal's x and green's mean x while it is seen, its interval, and the distance."""
    goal, green, distance = [], [], []
    for rollout in rollouts:
        role = np.asarray(rollout.level.shape_role)
        x = rollout.position[1 + STEPS_TO_GET_THERE :, np.argmax(role == Role.GREEN), 0]
        goal.append(float(rollout.level.position[np.argmax(role == Role.BLUE), 0]))
        green.append(float(np.mean(x)))
        distance.append(float(np.mean(np.abs(x - goal[-1]))))
    correlation = float(np.corrcoef(goal, green)[0, 1])
    half = Z_95 / math.sqrt(len(rollouts) - 3)
    z = math.atanh(correlation)
    return {
        "correlation": correlation,
        "low": math.tanh(z - half),
        "high": math.tanh(z + half),
        "distance_m": float(np.mean(distance)),
    }


if __name__ == "__main__":
    sys.exit(main())
