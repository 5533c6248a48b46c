"""A policy without its run: what plays it, and nothing that only the machine of the run has."""

from __future__ import annotations

from pathlib import Path

from bench import export_policy
from kinetix_dist.checkpoint import load_checkpoint, save_alone
from kinetix_dist.config import from_dict
from kinetix_dist.trained_policy import checkpoint_at


def test_level_sets_of_another_machine_are_left_out_and_what_is_left_can_be_played(tmp_path: Path) -> None:
    source = load_checkpoint(checkpoint_at(Path("generalist")).checkpoint.path)
    for sets, kept in ((["dev_random_m", "sets/own"], ("dev_random_m",)), (["s/hop_home"], ("random_l",))):
        source.description["config"]["evaluation"]["sets"] = sets
        run = tmp_path / kept[0]
        save_alone(run, source.description["num_updates"], source.arrays, source.description)
        assert export_policy.export(run, tmp_path / "policy") == 0
        exported = load_checkpoint(tmp_path / "policy")
        assert from_dict(exported.description["config"]).evaluation.sets == kept
        assert all("learner/params" in name for name in exported.arrays)
