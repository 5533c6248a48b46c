"""Signatures that a reader can hold in mind: at most seven parameters, records or typed keywords for more."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

MOST = 7
# Kernels of Warp take each array as a parameter of its own: Warp knows no records of arrays.
WARP_KERNELS = {"jax2d/warp/kernel.py": {"step_world", "step_worlds"}}
SOURCES = sorted([*REPOSITORY.glob("jax2d/**/*.py"), *REPOSITORY.glob("kinetix_dist/**/*.py")])


def long_functions(source: str) -> Iterator[str]:
    """Names of functions with more than `MOST` parameters, `self` and `cls` aside."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            if len([x for x in arguments if x.arg not in ("self", "cls")]) > MOST:
                yield node.name


def test_long_functions_are_found() -> None:
    many = ", ".join("abcdefgh")
    assert list(long_functions(f"def f({many}): ...\ndef g(self, {many[3:]}): ...")) == ["f"]


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: file.relative_to(REPOSITORY).as_posix())
def test_a_function_takes_at_most_seven_parameters(file: Path) -> None:
    name = file.relative_to(REPOSITORY).as_posix()
    found = set(long_functions(file.read_text())) - WARP_KERNELS.get(name, set())
    assert not found, f"{name}: {', '.join(sorted(found))}: give a record, or keywords by Unpack of a TypedDict"
