"""Keeps of a training checkpoint what playing needs: the parameters of the policy and the configuration.

    python bench/export_policy.py runs/sfl_s/checkpoints/00000343 pretrained/sfl_s

Optimizer, curriculum and random streams stay behind, so the result (3 MB at the paper's sizes) can be evaluated and
replayed but not resumed. Level sets given as paths are dropped from the configuration: they exist on one machine only.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from kinetix_dist.checkpoint import load_checkpoint, save_checkpoint
from kinetix_dist.checkpoint.manifest import write_manifest

PARAMS_PREFIX = "learner/params"
KEPT = ("config", "config_hash", "env_steps", "training_seconds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("to", type=Path)
    args = parser.parse_args()
    checkpoint = load_checkpoint(args.checkpoint)
    arrays = {name: array for name, array in checkpoint.arrays.items() if name.startswith(PARAMS_PREFIX)}
    description = {name: checkpoint.description[name] for name in KEPT}
    evaluation = description["config"]["evaluation"]
    evaluation["sets"] = [name for name in evaluation["sets"] if "/" not in name]
    draft = args.to.parent / f".{args.to.name}-draft"
    written = save_checkpoint(draft, checkpoint.description["num_updates"], arrays, description, keep=1)
    # Orbax notes the absolute path it wrote to, which means nothing elsewhere.
    for note in written.rglob("commit_success.txt"):
        note.write_text("Checkpoint commit was successful\n")
    write_manifest(written)
    shutil.rmtree(args.to, ignore_errors=True)
    written.rename(args.to)
    draft.rmdir()


if __name__ == "__main__":
    main()
