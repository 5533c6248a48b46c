"""Trains in the split placement in this process, on as many devices as JAX has here, and leaves a run directory.

    JAX_NUM_CPU_DEVICES=2 python tests/runtime/split_program.py RUN domain_randomization

The one learner of this process uses all of its devices: what several learners of one device each have to reproduce.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from tests.runtime.runs import run_updates, tiny_config

NUM_UPDATES = 5


def split_config(curriculum: str = "domain_randomization", **run: Any) -> TrainConfig:
    """Config with a curriculum that has no curator, which has nothing to do with placements."""
    config = tiny_config(num_updates=NUM_UPDATES, placement="split", **run)
    # So that episodes end within an update, for curricula that observe.
    env = dataclasses.replace(config.env, max_steps=5)
    return dataclasses.replace(config, env=env, curriculum=CurriculumConfig(name=curriculum, buffer_size=12))


def main(path: Path, curriculum: str) -> None:
    config = split_config(curriculum)
    run_updates(config, path, SplitTrainer(config, LocalBackend(), plan_placement(config, num_gpus=0)), None)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
