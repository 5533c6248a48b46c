"""Trains in the split placement in this process, on as many devices as JAX has here, and leaves a run directory.

    XLA_FLAGS=--xla_force_host_platform_device_count=2 python tests/runtime/split_program.py RUN

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
from kinetix_dist.runtime.processes.placement import plan
from tests.runtime.runs import run_updates, tiny_config

NUM_UPDATES = 5


def split_config(**run: Any) -> TrainConfig:
    """Without a curator, which has nothing to do with placements."""
    config = tiny_config(num_updates=NUM_UPDATES, placement="split", **run)
    return dataclasses.replace(config, curriculum=CurriculumConfig(name="domain_randomization"))


def main(path: Path) -> None:
    config = split_config()
    run_updates(config, path, SplitTrainer(config, LocalBackend(), plan(config, num_gpus=0)), None)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
