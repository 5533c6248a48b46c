"""Draws solve rates of one or several runs against environment steps, with their 95 % intervals.

python bench/plot_runs.py --set random_s --to curve.png a=runs/a/metrics/metrics.jsonl b=runs/b/metrics/metrics.jsonl
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("runs", nargs="+", help="LABEL=metrics.jsonl")
    parser.add_argument("--set", dest="level_set", required=True)
    parser.add_argument("--random", type=float, help="solve rate of random actions, drawn as a line")
    parser.add_argument("--title", default="")
    parser.add_argument("--to", type=output_file, required=True)
    args = parser.parse_args()
    return exit_code(parser, lambda: draw(args))


def draw(args: argparse.Namespace) -> int:
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for run in args.runs:
        label, _, path = run.partition("=")
        key = f"evaluation/{args.level_set}"
        with user_errors(OSError, prefix=f"{path}: "):
            rows = [row for row in read_jsonl(Path(path)) if f"{key}/solve_rate" in row]
        if not rows:
            raise UserError(f"{path} has no evaluations of {args.level_set}; train with --evaluation.every N")
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
