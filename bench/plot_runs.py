"""Draws solve rates of one or several runs against environment steps, with their 95 % intervals.

python bench/plot_runs.py --set random_s --to curve.png a=runs/a/metrics/metrics.jsonl b=runs/b/metrics/metrics.jsonl
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from kinetix_dist.telemetry.sinks.jsonl import read_jsonl


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="LABEL=metrics.jsonl")
    parser.add_argument("--set", dest="level_set", required=True)
    parser.add_argument("--random", type=float, help="solve rate of random actions, drawn as a line")
    parser.add_argument("--title", default="")
    parser.add_argument("--to", type=Path, required=True)
    args = parser.parse_args()
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for run in args.runs:
        label, _, path = run.partition("=")
        rows = read_jsonl(Path(path))
        key = f"evaluation/{args.level_set}"
        rows = [row for row in rows if f"{key}/solve_rate" in row]
        if not rows:
            parser.error(f"{path} has no evaluations of {args.level_set}; train with --evaluation.every N")
        steps = [row["progress/env_steps"] for row in rows]
        axes.plot(steps, [100 * row[f"{key}/solve_rate"] for row in rows], marker="o", markersize=3, label=label)
        low, high = ([100 * row[f"{key}/{end}"] for row in rows] for end in ("low", "high"))
        axes.fill_between(steps, low, high, alpha=0.2)
    if args.random is not None:
        axes.axhline(100 * args.random, linestyle="--", color="grey", label="random actions")
    axes.set(xlabel="environment steps", ylabel=f"solved, % ({args.level_set})", ylim=(0, 100), title=args.title)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(args.to, dpi=110)


if __name__ == "__main__":
    main()
