"""What an SFL buffer claims of its levels, and what training then finds: one line a refresh of a run.

    python -m bench.learnability runs/quickstart [--attempts 64] [--json FILE]

`claimed` is the mean of p (1 - p) over the levels of the buffer, p of the few episodes that chose them; `training` the
unbiased estimate of the same from training (levels played twice or more), with its standard error; `fresh` that of all
candidates, what levels offer that nobody chose. `played` is the solve rate in training; `chosen` and `again` are those
of some of the levels when they were chosen, and by the policy of the next refresh, where it played any
(`curriculum_log.probe_levels`, `probe_every`).

Training counts attempts, the first episode of each world in an update. A `*` marks counts of an earlier version, of all
episodes that ended: too high where solved episodes are the shorter ones. Scored levels finish several episodes each;
their rates are means over levels.

With --attempts, the levels of the buffer in the newest checkpoint are played as often by its policy: `measured` is
what their p (1 - p) is. So are those of each refresh by the very policy that chose them, where its checkpoint is still
there: what lies between the claim and that is chance, not learning. Of "sfl_slices" only levels in use count, and
`window` is the estimate from their last plays in training.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bench.program import exit_code, output_file, parser_of
from kinetix_dist import prng
from kinetix_dist.checkpoint import list_checkpoints, select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig, from_dict_as_recipe
from kinetix_dist.curator.slice_buffer import IN_USE, recent
from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.learnability import mean_and_error, plug_in_learnability, unbiased_learnability
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.evaluation.policies import NetworkPolicy, Player
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.level import Level
from kinetix_dist.runtime.cores.playing import make_environment
from kinetix_dist.runtime.cores.run_names import CURRICULUM
from kinetix_dist.studio.runs.refreshes import Refreshes, rate_over_levels
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, REFRESH, list_snapshots, read_snapshot
from kinetix_dist.trained_policy import Trained, checkpoint_at, newest_checkpoint_of

COLUMNS = "{:>8} {:>7} {:>8} {:>16} {:>16} {:>24} {:>8} {:>30}"


def line_of(entry: dict[str, Any]) -> str:
    training, probe = entry.get("training"), entry.get("probe")
    found, played, chosen, again = "-", "-", "-", "-"
    if training is not None:
        found = in_words([training["learnability"], training["learnability_error"]])
        played = f"{with_interval(training)} of {training['episodes']}"
    if probe is not None:
        before, after = probe["before"], probe["after"]
        chosen = f"{before['rate']:.1%}"
        again = f"{with_interval(after)} of {after['levels']} levels"
    claimed, candidates = f"{entry['buffer']['claimed']:.3f}", entry["candidates"]
    fresh = in_words([candidates["learnability"], candidates["learnability_error"]])
    return COLUMNS.format(entry["number"], entry["num_levels"], claimed, found, fresh, played, chosen, again)


def with_interval(rate: dict[str, Any]) -> str:
    return f"{rate['rate']:.1%} ({rate['low']:.0%} to {rate['high']:.0%})"


def solved_of(trained: Trained, levels: Level, attempts: int) -> np.ndarray:
    """[n] int64, how many of so many attempts at each level the policy of a checkpoint solves."""
    env = make_environment(config_of(trained))
    module, params = load_policy(trained.checkpoint, trained.config.policy, env, levels)
    player = Player(NetworkPolicy(module, env.action_distribution), jax.device_put(params))
    rates = evaluate(env, player, levels, attempts=attempts, key=prng.key(0))
    return np.array([rate.solved for rate in rates.levels])


def measured(run: Path, attempts: int) -> dict[str, Any]:
    """{update, levels, claimed, window, attempts, measured, measured_rate} of the newest checkpoint's buffer; window
    and measured are pairs of `mean_of`, window None where the curriculum has no such counts."""
    trained, _ = newest_checkpoint_of(run)
    config, arrays = config_of(trained), select_arrays(trained.checkpoint.arrays, CURRICULUM)
    if "num_solved" not in arrays:
        raise UserError(f"{trained.checkpoint.path} has no buffer of scored levels; give a run of sfl or sfl_slices")
    num_levels = len(arrays["num_solved"])
    solved = solved_of(trained, levels_of(config, select_arrays(arrays, "levels"), num_levels), attempts)
    counted = arrays.get("status", np.full(num_levels, IN_USE)) == IN_USE
    found: dict[str, Any] = {
        "update": int(trained.checkpoint.path.name),
        "levels": int(counted.sum()),
        "claimed": float(plug_in_learnability(arrays["num_solved"], arrays["num_finished"])[counted].mean()),
        "attempts": attempts,
        "window": None,
        "measured": mean_of(solved[counted], np.full(counted.sum(), attempts)),
        "measured_rate": list(mean_and_error(solved[counted] / attempts)),
    }
    if "window_plays" in arrays:
        window = config.curriculum.slices.window
        won, plays = (np.asarray(x) for x in recent(arrays["window_solved"], arrays["window_plays"], window))
        found["window"] = mean_of(won[counted], plays[counted])
    return found


def by_their_own_policy(run: Path, attempts: int) -> list[dict[str, Any]]:
    """[{refresh, levels, claimed, attempts, measured, chosen_rate, measured_rate}] of the refreshes whose policy has a
    checkpoint; measured_rate: [mean, standard error] over levels."""
    refreshes = {number: path for kind, number, path in list_snapshots(run / DIRECTORY) if kind == REFRESH}
    found = []
    for path in list_checkpoints(run / "checkpoints"):
        if (number := int(path.name)) not in refreshes:
            continue
        snapshot = read_snapshot(refreshes[number])
        if snapshot.levels is None:
            continue
        trained, arrays = checkpoint_at(path), snapshot.arrays
        num_levels = len(arrays["solved"])
        counts = (arrays[name].astype(np.int64) for name in ("solved", "finished"))
        chosen_solved, chosen_finished = counts
        solved = solved_of(trained, levels_of(config_of(trained), snapshot.levels, num_levels), attempts)
        found.append(
            {
                "refresh": number,
                "levels": num_levels,
                "claimed": float(plug_in_learnability(chosen_solved, chosen_finished).mean()),
                "attempts": attempts,
                "measured": mean_of(solved, np.full(num_levels, attempts)),
                "chosen_rate": rate_over_levels(chosen_solved, chosen_finished)["rate"],
                "measured_rate": list(mean_and_error(solved / attempts)),
            }
        )
    return found


def config_of(trained: Trained) -> TrainConfig:
    """Return all settings of the run that a checkpoint belongs to."""
    return from_dict_as_recipe(trained.checkpoint.config)


def levels_of(config: TrainConfig, arrays: Mapping[str, np.ndarray], num_levels: int) -> Level:
    """From arrays [n, ...] by path."""
    generator = config.curriculum.generator
    template = jax.eval_shape(lambda: generate_levels(prng.key(0), num_levels, config.env.capacity, generator))
    return unflatten_arrays(template, arrays)


def mean_of(solved: np.ndarray, plays: np.ndarray) -> list[float] | None:
    """[mean, standard error] of p (1 - p) over the levels that were played twice; None with fewer than two."""
    mean, error = mean_and_error(unbiased_learnability(solved.astype(np.int64), plays.astype(np.int64)))
    return None if mean is None or error is None else [mean, error]


def in_words(pair: Sequence[float | None] | None) -> str:
    return "-" if pair is None or None in pair else "{:.3f} +- {:.3f}".format(*pair)


def run(arguments: argparse.Namespace) -> int:
    if arguments.attempts < 0 or arguments.attempts == 1:
        raise UserError(f"--attempts is {arguments.attempts}; give 2 or more, or 0 for none")
    found = Refreshes(arguments.run).summaries()
    refreshes = [entry for entry in found["snapshots"] if entry["kind"] == "refresh"]
    if not refreshes:
        raise UserError(f"{arguments.run} has no snapshots of refreshes; it needs a run of sfl or sfl_slices")
    print(COLUMNS.format("refresh", "levels", "claimed", "training", "fresh", "played", "chosen", "again"))
    for entry in refreshes:
        print(line_of(entry))
    for problem in found["problems"]:
        print(problem, file=sys.stderr)
    played, chosen = None, []
    if arguments.attempts:
        chosen = by_their_own_policy(arguments.run, arguments.attempts)
        for entry in chosen:
            print(
                f"refresh {entry['refresh']} by the policy that chose it: {entry['levels']} levels, claimed "
                f"{entry['claimed']:.3f}, measured {in_words(entry['measured'])} by {entry['attempts']} attempts each; "
                f"solved {entry['chosen_rate']:.3f} when chosen, {in_words(entry['measured_rate'])} measured"
            )
        played = measured(arguments.run, arguments.attempts)
        window, measure = map(in_words, (played["window"], played["measured"]))
        print(
            f"buffer after update {played['update']}: {played['levels']} levels, claimed {played['claimed']:.3f}, "
            f"window {window}, measured {measure} by {played['attempts']} attempts each; solved "
            f"{in_words(played['measured_rate'])}"
        )
    if arguments.json is not None:
        content = refreshes if played is None else {"refreshes": refreshes, "chosen": chosen, "buffer": played}
        arguments.json.write_text(json.dumps(content, indent=2) + "\n")
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--attempts", type=int, default=0)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
