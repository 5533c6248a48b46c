"""What an SFL buffer claims of its levels, and what training then finds: one line a refresh of a run.

    python -m bench.learnability runs/quickstart [--json FILE]

`claimed` is the mean of p (1 - p) over the levels of the buffer, p of the few episodes that chose them; `training` the
unbiased estimate of the same from the episodes of training (levels played twice or more), with its standard error.
`played` is the solve rate in training; `chosen` and `again` are those of some of the levels when they were chosen, and
by the policy of the next refresh (`curriculum_log.probe_levels`).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from bench.program import exit_code, output_file, parser_of
from kinetix_dist.dashboard.refreshes import Refreshes
from kinetix_dist.errors import UserError

COLUMNS = "{:>8} {:>7} {:>8} {:>16} {:>15} {:>14} {:>27}"


def line_of(entry: dict[str, Any]) -> str:
    training, probe = entry.get("training"), entry.get("probe")
    found, played, chosen, again = "-", "-", "-", "-"
    if training is not None and training["learnability_error"] is not None:
        found = f"{training['learnability']:.3f} +- {training['learnability_error']:.3f}"
        played = f"{training['rate']:.1%} of {training['finished']}"
    if probe is not None:
        before, after = probe["before"], probe["after"]
        chosen = f"{before['rate']:.1%} of {before['finished']}"
        again = f"{after['rate']:.1%} ({after['low']:.0%} to {after['high']:.0%}) of {after['finished']}"
    claimed = f"{entry['buffer']['claimed']:.3f}"
    return COLUMNS.format(entry["number"], entry["num_levels"], claimed, found, played, chosen, again)


def run(arguments: argparse.Namespace) -> int:
    found = Refreshes(arguments.run).summaries()
    refreshes = [entry for entry in found["snapshots"] if entry["kind"] == "refresh"]
    if not refreshes:
        raise UserError(f"{arguments.run} has no snapshots of refreshes; it needs a run of curriculum sfl")
    print(COLUMNS.format("refresh", "levels", "claimed", "training", "played", "chosen", "again"))
    for entry in refreshes:
        print(line_of(entry))
    for problem in found["problems"]:
        print(problem, file=sys.stderr)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(refreshes, indent=2) + "\n")
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
