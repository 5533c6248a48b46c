"""docs/level_format.md: its example is valid, and it names every field of the format and of the generator."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from typing import Any

from kinetix_dist.level.generator import GeneratorConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import level_from_json
from tests.helpers import REPOSITORY

PAGE = (REPOSITORY / "docs" / "level_format.md").read_text(encoding="utf-8")


def properties(schema: Any) -> Iterator[str]:
    """Names of all fields anywhere in a JSON schema."""
    if isinstance(schema, dict):
        yield from schema.get("properties", {})
        for inner in schema.values():
            yield from properties(inner)


def test_the_example_is_a_valid_level() -> None:
    block = re.search(r"```json\n(.*?)```", PAGE, re.DOTALL)
    assert block is not None
    level = level_from_json(json.loads(block.group(1)))
    assert level.scene.shapes.active.sum() == 4 + 4


def test_every_field_of_the_format_is_described() -> None:
    schema = json.loads((levels_root() / "schema.json").read_text(encoding="utf-8"))
    missing = [name for name in set(properties(schema)) if f"`{name}`" not in PAGE]
    assert not missing


def test_every_generator_parameter_is_described_with_its_default() -> None:
    for field in dataclasses.fields(GeneratorConfig):
        line = next((line for line in PAGE.splitlines() if line.startswith("|") and f"`{field.name}`" in line), None)
        assert line is not None, field.name
        if isinstance(field.default, float) and field.name != "limit_max":
            assert f"{field.default:g}" in line, field.name


def test_the_table_of_sizes_is_that_of_the_code() -> None:
    for name, size in SIZES.items():
        assert f"| {name} | {size.polygons} | {size.circles} | {size.joints} | {size.thrusters} |" in PAGE
