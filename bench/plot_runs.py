"""Draws solve rates of one or several runs against environment steps, with their 95 % intervals.

python bench/plot_runs.py --set random_s --to curve.png a=runs/a/metrics/metrics.jsonl b=runs/b/metrics/metrics.jsonl

Runs whose labels begin with the same word have one colour: seeds of a setting, say.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.telemetry.sinks.jsonl import read_jsonl

LINES = ("-", "--", ":", "-.")


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("runs", nargs="+", help="LABEL=metrics.jsonl")
    parser.add_argument("--set", dest="level_set", required=True)
    parser.add_argument("--random", type=float, help="solve rate of random actions, drawn as a line")
    parser.add_argument("--title", default="")
    parser.add_argument("--range", type=float, nargs=2, default=(0.0, 100.0), help="of solve rates shown, %%")
    parser.add_argument("--to", type=output_file, required=True)
    args = parser.parse_args()
    return exit_code(parser, lambda: draw(args))


def draw(args: argparse.Namespace) -> int:
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    first_words = dict.fromkeys(run.partition("=")[0].partition(" ")[0] for run in args.runs)
    colours = {word: f"C{number}" for number, word in enumerate(first_words)}
    drawn: Counter[str] = Counter()
    for run in args.runs:
        label, _, path = run.partition("=")
        key = f"evaluation/{args.level_set}"
        with user_errors(OSError, prefix=f"{path}: "):
            rows = [row for row in read_jsonl(Path(path)) if f"{key}/solve_rate" in row]
        if not rows:
            raise UserError(f"{path} has no evaluations of {args.level_set}; train with --evaluation.every N")
        steps = [row["progress/env_steps"] for row in rows]
        word = label.partition(" ")[0]
        style = {"color": colours[word], "linestyle": LINES[drawn[word] % len(LINES)]}
        drawn[word] += 1
        rates = [100 * row[f"{key}/solve_rate"] for row in rows]
        axes.plot(steps, rates, marker="o", markersize=3, label=label, **style)
        low, high = ([100 * row[f"{key}/{end}"] for row in rows] for end in ("low", "high"))
        axes.fill_between(steps, low, high, alpha=0.6 / len(args.runs), color=colours[word], linewidth=0)
    if args.random is not None:
        axes.axhline(100 * args.random, linestyle="--", color="grey", label="random actions")
    axes.set(xlabel="environment steps", ylabel=f"solved, % ({args.level_set})", ylim=args.range, title=args.title)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(args.to, dpi=110)
    return 0


if __name__ == "__main__":
    sys.exit(main())
