"""`bench goals`: how well a policy goes below a goal, by kind of body (paper, "Zero-shot Locomotion").

Each level (kinetix_dist/level/goal_following.py) is played for 64 environment steps, to get there, and for 64 more, in
which the x of green is compared with that of the goal. One record for each kind of body, for the policy and for random
actions: the correlation of the two over levels, its 95 % interval (Fisher's z), the mean distance in x, and how often
each pair of places occurs.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from kinetix_dist import prng
from kinetix_dist.benchmarks.measuring import Record, Results
from kinetix_dist.checkpoint import CheckpointError, load_checkpoint
from kinetix_dist.config import from_dict_for_playing
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import user_errors
from kinetix_dist.evaluation.intervals import Z_95
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.goal_following import MORPHOLOGIES, GoalFollowingLevels, size_for
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Role
from kinetix_dist.telemetry.recording import Rollout

STEPS_TO_GET_THERE, STEPS_SEEN = 64, 64  # paper, the same section
BINS = 20  # of x, from wall to wall


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """How well a policy goes below a goal, by kind of body; and random actions."""

    checkpoint: Path = Path("generalist")
    """A checkpoint, or a bundled policy such as generalist."""
    morphologies: tuple[str, ...] = tuple(MORPHOLOGIES)
    """Kinds of bodies."""
    levels: int = 512
    """Levels of each kind."""
    seed: int = 0
    """Seed of levels and actions."""
    json: Path | None = None
    """File for the records."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.morphologies if name not in MORPHOLOGIES]:
            raise ValueError(f"--morphologies {unknown[0]} is unknown; choose from {', '.join(MORPHOLOGIES)}")
        if self.levels < 4:
            raise ValueError(f"--levels is {self.levels}; an interval needs 4 or more")


def measure(options: Options, results: Results) -> None:
    """Two records a kind of body: "actions" is "policy" or "random". Raises UserError for a checkpoint that is none."""
    with user_errors(CheckpointError, ValueError, OSError):
        checkpoint = load_checkpoint(options.checkpoint)
        config = from_dict_for_playing(checkpoint.config)
    for morphology in options.morphologies:
        size = size_for(morphology)
        steps = STEPS_TO_GET_THERE + STEPS_SEEN
        env = Environment(dataclasses.replace(config.env, size=size, max_steps=steps))
        key = prng.key(options.seed)
        levels = jax.device_get(GoalFollowingLevels(SIZES[size], morphology).generate(key, options.levels))
        with user_errors(ValueError, prefix=f"{options.checkpoint}: "):
            module, params = load_policy(checkpoint, config.policy, env, levels)
        players = {
            "policy": Player(NetworkPolicy(module, env.action_distribution), params),
            "random": Player(RandomPolicy(env.action_space)),
        }
        for name, player in players.items():
            rollouts = record_rollouts(env, player, levels, prng.fold_in(key, 1), seed=options.seed)
            found = follows(rollouts)
            results.add({"morphology": morphology, "actions": name, "size": size, "levels": len(rollouts)} | found)
            results.report(
                f"{morphology:10} {name:7} correlation {found['correlation']:6.3f} "
                f"({found['low']:.3f} to {found['high']:.3f}), distance in x {found['distance_m']:.2f} m"
            )


def follows(rollouts: Sequence[Rollout]) -> Record:
    """{correlation, low, high, distance_m, counts}: of the goal's x and green's mean x while it is seen, over levels.

    counts: environment steps by BINS places of the goal (rows) and of green, from x = 0 to the other wall.
    """
    goal, green, distance = [], [], []
    counts = np.zeros((BINS, BINS), int)
    edges = np.linspace(0.0, WORLD_SIZE_M, BINS + 1)
    for rollout in rollouts:
        role = np.asarray(rollout.level.shape_role)
        x = rollout.position[1 + STEPS_TO_GET_THERE :, np.argmax(role == Role.GREEN), 0]
        goal.append(float(rollout.level.position[np.argmax(role == Role.BLUE), 0]))
        green.append(float(np.mean(x)))
        distance.append(float(np.mean(np.abs(x - goal[-1]))))
        counts += np.histogram2d(np.full_like(x, goal[-1]), x, [edges, edges])[0].astype(int)
    correlation = float(np.corrcoef(goal, green)[0, 1])
    half = Z_95 / math.sqrt(len(rollouts) - 3)
    z = math.atanh(correlation)
    return {
        "correlation": correlation,
        "low": math.tanh(z - half),
        "high": math.tanh(z + half),
        "distance_m": float(np.mean(distance)),
        "counts": counts.tolist(),
    }
