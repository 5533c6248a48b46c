"""A level, a policy that plays it, training on it, and a film of what was learned.

    python examples/level_to_training.py --to runs/over_the_wall      minutes on two CPU cores
    python examples/level_to_training.py --steps 2000                 seconds: shows the steps, learns nothing

The level is written as JSON here; `kinetix-dist edit FILE` draws it in a browser. docs/tutorial.md goes through the
same steps with the command.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import numpy as np

import kinetix_dist as kd
from kinetix_dist.cli.main import main as kinetix_dist

LEVEL = Path(__file__).parent / "levels" / "over_the_wall.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path("runs/over_the_wall"))
    parser.add_argument("--steps", type=int, default=300_000, help="environment steps of training")
    args = parser.parse_args()
    args.to.mkdir(parents=True, exist_ok=True)

    # 1. A level: here the one of the tutorial, with a lower wall.
    document = json.loads(LEVEL.read_text())
    [wall] = [shape for shape in document["shapes"] if shape["id"] == "wall"]
    wall |= {"height": 0.6, "position": [2.3, 0.55]}
    level = args.to / "low_wall.json"
    level.write_text(json.dumps(document | {"name": "low_wall"}, indent=2))
    assert kinetix_dist(["levels", "validate", str(level)]) == 0

    # 2. The bundled policy plays it, in 16 worlds at once.
    print(f"generalist solves {solve_rate('generalist', level):.0%} of its attempts")

    # 3. A small network is trained on it from scratch. `--from generalist` begins with the bundled policy.
    run = args.to / "run"
    options = ["--run", str(run), "--run.total_env_steps", str(args.steps), "--evaluation.attempts", "20"]
    options += ["--recording.num_rollouts", "0"]  # the film below takes their place
    assert kinetix_dist(["finetune", "--levels", str(level), *options]) == 0
    print(f"the trained policy solves {solve_rate(run, level):.0%} of its attempts")

    # 4. Watch it.
    [*_, checkpoint] = sorted((run / "checkpoints").glob("0*"))
    film = args.to / "trained.gif"
    options = ["--by", "trained", "--checkpoint", str(checkpoint)]
    assert kinetix_dist(["levels", "render", str(level), str(film), *options]) == 0


def solve_rate(name: str | Path, level: Path) -> float:
    """Share of 16 first episodes that touch the goal."""
    policy = kd.load_policy(name)
    env = kd.make("m", num_envs=16, levels=str(level))

    @jax.jit
    def play(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
            observation, state = carry
            action, _ = policy(observation, key)
            observation, state, _, done, info = env.step(key, state, action)
            return (observation, state), (done, info.solved)

        return jax.lax.scan(step, env.reset(key), jax.random.split(key, env.config.max_steps))[1]

    done, solved = (np.asarray(part) for part in play(jax.random.key(0)))  # [steps, worlds]
    is_first = np.cumsum(done, axis=0) - done == 0  # up to and including the end of the first episode
    return float((solved & is_first).any(axis=0).mean())


if __name__ == "__main__":
    main()
