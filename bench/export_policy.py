"""Keeps of a training checkpoint what playing needs: the parameters of the policy and the configuration.

    python bench/export_policy.py runs/sfl_s/checkpoints/00000343 pretrained/generalist

Optimizer, curriculum and random streams stay behind, so the result (3 MB at the paper's sizes) can be evaluated and
replayed but not resumed. Level sets given as paths are dropped from the configuration (where all are, random levels of
its size take their place), and paths of ancestors are cut to RUN/checkpoints/NUMBER: they exist on one machine only.
config_hash stays that of the run.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from bench.program import exit_code, parser_of
from kinetix_dist.checkpoint import CheckpointError, load_checkpoint, save_alone
from kinetix_dist.errors import user_errors
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX, released_arrays

NUM_PARTS = 3  # of a path to a checkpoint: run, "checkpoints", number
KEPT = ("config", "config_hash", "env_steps", "training_seconds", "lineage")


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("to", type=Path)
    args = parser.parse_args()
    return exit_code(parser, lambda: export(args.checkpoint, args.to))


def export(source: Path, to: Path) -> int:
    with user_errors(CheckpointError):
        checkpoint = load_checkpoint(source)
    arrays = {f"{PARAMS_PREFIX}/{name}": array for name, array in released_arrays(checkpoint).items()}
    description = {name: checkpoint.description[name] for name in KEPT if name in checkpoint.description}
    evaluation = description["config"]["evaluation"]
    random = f"random_{description['config']['env']['size']}"
    evaluation["sets"] = [name for name in evaluation["sets"] if "/" not in name] or [random]
    run = description["config"]["run"]
    run["start_from"] = _without_machine(run.get("start_from", ""))
    description["lineage"] = [
        ancestor | {"checkpoint": _without_machine(ancestor["checkpoint"])}
        for ancestor in description.get("lineage", [])
    ]
    shutil.rmtree(to, ignore_errors=True)
    save_alone(to, checkpoint.description["num_updates"], arrays, description)
    return 0


def _without_machine(path: str) -> str:
    parts = Path(path).parts
    return "/".join([part for part in parts if part != Path(path).anchor][-NUM_PARTS:])


if __name__ == "__main__":
    sys.exit(main())
