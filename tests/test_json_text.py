"""JSON text without NaN and Infinity, and that all of the package writes it."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.json_text import json_text
from tests.helpers import REPOSITORY

SOURCES = sorted(REPOSITORY.glob("kinetix_dist/**/*.py"))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_null(number: float) -> None:
    content = {"loss": number, "curve": [1.5, number, (number, 2)], "deep": {"er": {"rate": number}}, "text": "nan"}
    expected = {"loss": None, "curve": [1.5, None, [None, 2]], "deep": {"er": {"rate": None}}, "text": "nan"}
    assert json.loads(json_text(content), parse_constant=_refuse) == expected


def test_other_content_is_as_json_writes_it() -> None:
    content = {"b": [1, 2.5, None, True], "a": {"c": "é"}}
    assert json_text(content) == json.dumps(content)
    assert json_text(content, indent=2, sort_keys=True) == json.dumps(content, indent=2, sort_keys=True)
    assert json_text(content, separators=(",", ":")) == json.dumps(content, separators=(",", ":"))


def test_a_circle_is_an_error() -> None:
    circle: list[Any] = []
    circle.append(circle)
    with pytest.raises((ValueError, RecursionError)):
        json_text(circle)


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: file.relative_to(REPOSITORY).as_posix())
def test_the_package_writes_no_json_that_is_none(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("json.dump", "json.dumps", "dump", "dumps"):
            refuses = [word.arg == "allow_nan" and ast.unparse(word.value) == "False" for word in node.keywords]
            assert any(refuses), f"line {node.lineno}: use json_text, or allow_nan=False"


def _refuse(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")
