"""Descriptions of checkpoints (checkpoint.json) that are of another form: each reader refuses them in one line."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.checkpoint import CheckpointError, load_checkpoint
from kinetix_dist.checkpoint.description import description_fault
from kinetix_dist.checkpoint.manifest import write_manifest
from kinetix_dist.checkpoint.store import find_checkpoint
from kinetix_dist.cli.main import main

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def edited(tmp_path: Path) -> Callable[[Change], Path]:
    """Copies the generalist with a description that was edited."""

    def edit(change: Change) -> Path:
        path = tmp_path / "stranger"
        shutil.copytree(find_checkpoint(Path("generalist")), path)
        file = path / "checkpoint.json"
        description = json.loads(file.read_text())
        change(description)
        file.write_text(json.dumps(description))
        write_manifest(path)
        return path

    return edit


def _set(path: str, value: Any) -> Change:
    def change(description: dict[str, Any]) -> None:
        *sections, name = path.split(".")
        for section in sections:
            description = description[section]
        description[name] = value

    return change


FAULTS: list[tuple[str, Any, str]] = [
    ("num_updates", True, "its num_updates is True instead of a whole number"),
    ("config", [], "its config is [] instead of an object"),
    ("config", None, "its config is None instead of an object"),
    ("config.run", [], "its config.run is [] instead of an object"),
    ("config.run", {}, "it has no config.run.name"),
    ("config.run.name", 5, "its config.run.name is 5 instead of a text"),
    ("config.run.start_from", {}, "its config.run.start_from is {} instead of a text"),
    ("config_hash", 5, "its config_hash is 5 instead of a text"),
    ("env_steps", "many", "its env_steps is 'many' instead of a whole number"),
    ("training_seconds", "x", "its training_seconds is 'x' instead of a number"),
    ("lineage", 5, "its lineage is 5 instead of a list"),
    ("lineage", "x", "its lineage is 'x' instead of a list"),
    ("lineage", ["x"], "its lineage is not a list of objects"),
    ("chunk_policy", None, "its chunk_policy is None instead of an object"),
    ("chunk_policy", {}, "it has no chunk_policy.flow"),
    ("chunk_policy", {"flow": {}, "env": 5}, "its chunk_policy.env is 5 instead of an object"),
]


@pytest.mark.parametrize(("path", "value", "fault"), FAULTS)
def test_a_part_of_another_type_is_named(path: str, value: Any, fault: str) -> None:
    description = copy.deepcopy(load_checkpoint(Path("generalist")).description)
    assert description_fault(description) is None
    _set(path, value)(description)
    assert description_fault(description) == fault


def test_a_description_without_optional_parts_is_taken() -> None:
    assert description_fault({"num_updates": 0}) is None
    assert description_fault({"num_updates": 0, "config": {"env": {}}}) is None
    assert description_fault([]) == "it is no object" and description_fault({}) == "it has no num_updates"


@pytest.mark.parametrize(
    ("command", "path", "value", "fault"),
    [
        ("finetune --from CK --levels s/hop_home --run OUT", "config.run", [], "config.run is [] instead of an object"),
        ("finetune --from CK --levels s/hop_home --run OUT", "config.run", {}, "it has no config.run.name"),
        ("finetune --from CK --levels s/hop_home --each --run OUT", "lineage", 5, "lineage is 5 instead of a list"),
        ("bench delay --policy CK --levels s/hop_home", "chunk_policy", None, "chunk_policy is None"),
        ("bench delay --policy CK --levels s/hop_home", "chunk_policy", {}, "it has no chunk_policy.flow"),
        (
            "bench delay --policy CK --levels s/hop_home",
            "chunk_policy",
            {"flow": {"width": 2**62}, "env": {}},
            f"FlowConfig.width is {2**62}; it must be from 2 to",
        ),
        ("eval --checkpoint CK --levels s/hop_home", "config.policy.num_layers", 2**62, "num_layers is"),
        ("eval --checkpoint CK --levels s/hop_home", "config.policy.hidden_size", 2**62, "hidden_size is"),
        ("eval --checkpoint CK --levels s/hop_home", "config.env.physics.substeps", 2**62, "substeps is"),
        ("eval --checkpoint CK --levels s/hop_home", "config.policy.network", "\x1b[2J" * 30_000, "network is"),
    ],
)
def test_a_command_refuses_it_in_one_line(
    command: str,
    path: str,
    value: Any,
    fault: str,
    edited: Callable[[Change], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = {"CK": str(edited(_set(path, value))), "OUT": str(tmp_path / "out")}
    assert main([words.get(word, word) for word in command.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert fault in line and line.isprintable() and len(line) < 2100
    assert not (tmp_path / "out").exists()


def test_a_checkpoint_without_a_config_says_so(edited: Callable[[Change], Path]) -> None:
    checkpoint = load_checkpoint(edited(lambda description: description.pop("config")))
    with pytest.raises(CheckpointError, match="has no config of its training"):
        _ = checkpoint.config
