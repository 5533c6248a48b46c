"""Runs that are at their configured end, with a report: there is nothing to go on with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kinetix_dist.checkpoint import newest_good
from kinetix_dist.config import TrainConfig, has_same_numbers, to_dict
from kinetix_dist.renamed_settings import translated
from kinetix_dist.runtime.driver.clock import is_over
from kinetix_dist.runtime.driver.session_totals import read_report
from kinetix_dist.text_files import read_json

MADE_AT_THE_END = ("evaluation", "recording")  # sections that change no number of training


def finished_report(path: Path, config: TrainConfig) -> dict[str, Any] | None:
    """Report of the run in `path` where `config` asks for no more than it has done, and its last checkpoint is good.

    None where training goes on, where other evaluations or recordings than those stored are asked for, or where the
    report or the last checkpoint is missing or damaged: resuming makes them again. Reads only.
    """
    report = read_report(path / "report.json")
    if report is None:
        return None
    stored, asked = read_json(path / "config.json")["config"], to_dict(config)
    if not has_same_numbers(config, stored, report["config_hash"]):
        return None
    stored = translated(stored, for_playing=True)
    if any(stored.get(section) != asked[section] for section in MADE_AT_THE_END):
        return None
    if not is_over(config.run, env_steps=report["env_steps"], training_seconds=report["training_seconds"]):
        return None
    checkpoint, _ = newest_good(path / "checkpoints")
    is_last = checkpoint is not None and checkpoint.description["num_updates"] == report["policy_updates"]
    return report if is_last else None
