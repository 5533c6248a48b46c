"""docs/editor.md has every tool with its key, every command with its keys, and every option."""

from __future__ import annotations

import dataclasses
import re

import pytest

from kinetix_dist.cli.edit import Args
from tests.helpers import REPOSITORY

TEXT = (REPOSITORY / "docs" / "editor.md").read_text()
EDITOR = REPOSITORY / "kinetix_dist" / "studio" / "static" / "editor"
TOOLS = re.findall(r'\{ key: "(\w)", label: "([^"]+)"', (EDITOR / "tools.js").read_text())
COMMANDS = re.findall(r'\{ keys: \[((?:"[^"]+"(?:, )?)+)\], label: "([^"]+)"', (EDITOR / "commands.js").read_text())


def test_tools_and_commands_are_found() -> None:
    assert len(TOOLS) == 10 and len(COMMANDS) > 20


@pytest.mark.parametrize(("key", "label"), TOOLS)
def test_every_tool_is_documented_with_its_key(key: str, label: str) -> None:
    assert f"| {label} | {key.upper()} |" in TEXT


@pytest.mark.parametrize(("keys", "label"), COMMANDS)
def test_every_command_is_documented_with_its_keys(keys: str, label: str) -> None:
    [row] = [line for line in TEXT.splitlines() if line.startswith("|") and label in line]
    for key in re.findall(r'"([^"]+)"', keys):
        assert key == "=" or f"`{key}`" in row, (key, row)  # = is + without shift


def test_every_option_is_documented_with_its_default() -> None:
    for field in dataclasses.fields(Args):
        if field.name != "level":
            negation = "no-" if field.default is True else ""  # of what is on by default
            assert f"| `--{negation}{field.name.replace('_', '-')}` |" in TEXT
    assert f"| `--port` | {Args().port} |" in TEXT and f"| `--host` | {Args().host} |" in TEXT
