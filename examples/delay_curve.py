"""From level files to a delay curve: specialists, their data, a policy of action chunks, solve rates over delay.

    python examples/delay_curve.py --to runs/delay                         half an hour on two CPU cores
    python examples/delay_curve.py --levels my_levels --to runs/mine       a level file of your own, or a directory
    python examples/delay_curve.py --small                                 minutes: shows the steps, learns nothing

Each step is a command; docs/delay.md explains them and the figures.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from kinetix_dist.cli.main import main as kinetix_dist
from kinetix_dist.level.sets import file_of_level

# A network for a CPU: without these, that of the paper for the encoder, and that of the public benchmark for chunks.
ENCODER = ("encoder-size", "32"), ("num-layers", "1")
CHUNKS = ("width", "64"), ("num-layers", "2"), ("batch", "128"), ("learning-rate", "1e-3"), ("warmup-steps", "100")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", type=Path, default=file_of_level("s/unicycle_balance"))
    parser.add_argument("--to", type=Path, default=Path("runs/delay"))
    parser.add_argument("--small", action="store_true", help="few steps of everything")
    args = parser.parse_args()
    levels, to = str(args.levels), args.to
    experts, data, flow = (str(to / name) for name in ("experts", "data", "flow"))
    steps, transitions, flow_steps, episodes = (512, 512, 20, 4) if args.small else (400_000, 65_536, 6_000, 200)
    horizon, delays, any_rate = 8, "0..4", ("--min-rate", "0")

    # 1. A specialist of each level: PPO on it alone, with continuous actions, until nine attempts of ten are solved.
    options = ["--env.action_space", "continuous", "--stop-at", "0.9", "--run.total_env_steps", str(steps)]
    if args.small:
        options += ["--rollout.num_steps", "16", "--evaluation.attempts", "4", "--evaluation.min_attempts", "4"]
    run("finetune", "--levels", levels, "--each", "--run", experts, *options)

    # 2. Their transitions, each level by its own.
    options = ["--transitions", str(transitions)]
    options += ["--worlds", "2", "--shard-transitions", "512", *any_rate] if args.small else []
    run("collect", "--policy", experts, "--levels", levels, "--out", data, *options)

    # 3. A policy of chunks of eight actions. Training simulates delays, so that training-time RTC can be played too.
    options = ["--horizon", str(horizon), "--max-delay", "4", "--steps", str(flow_steps), "--report-every"]
    options += [str(flow_steps // 4), *(word for name, value in CHUNKS for word in (f"--{name}", value))]
    options += [word for name, value in ENCODER for word in (f"--encoder.{name}", value)]
    run("clone-flow", "--data", data, "--run", flow, *options)

    # 4. Chunks and specialists under delays of 0 to 4 steps, with noise on actions: plans in open loop go wrong.
    options = ["--delays", delays, "--action-noise", "0.1", "--episodes", str(episodes)]
    options += ["--json", str(to / "delay.json"), "--picture", str(to / "delay.png")]
    run("bench", "delay", "--policy", flow, experts, "--levels", levels, *options, *(any_rate if args.small else []))

    records = json.loads((to / "delay.json").read_text())
    print(f"{len(records)} points of a delay curve in {to / 'delay.json'}, drawn in {to / 'delay.png'}")


def run(*arguments: str) -> None:
    print(f"\n$ kinetix-dist {' '.join(arguments)}", flush=True)
    assert kinetix_dist(list(arguments)) == 0


if __name__ == "__main__":
    main()
