"""Texts of kernels are compiled once for all processes that share a compile cache. The compiler here is a fake."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from kinetix_dist.models.kernels import nvrtc
from tests.helpers import compile_cache

SOURCE: dict[str, Any] = {
    "source": "kernel",
    "name": "kernel.cu",
    "headers": {"tile.cuh": "tile"},
    "macros": {"TOKENS": 7},
}


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Requests to the compiler, in order."""
    requested: list[str] = []

    def compile_ptx(source: str, name: str, *, headers: dict[str, str], macros: dict[str, int]) -> str:
        requested.append(name)
        return f"{name} {source} {headers} {macros}\nof two lines\n"

    monkeypatch.setattr(nvrtc, "compile_ptx", compile_ptx)
    monkeypatch.setattr(nvrtc, "compiler_version", lambda: (13, 1, 100))
    return requested


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    with compile_cache(tmp_path):
        yield tmp_path


def test_the_second_process_finds_what_the_first_one_compiled(compiled: list[str], cache: Path) -> None:
    first = nvrtc.cached_ptx(**SOURCE)
    assert nvrtc.cached_ptx(**SOURCE) == first == nvrtc.compile_ptx(**SOURCE)
    assert len(compiled) == 2  # the first one, and the one of the line above
    assert [path.suffix for path in (cache / nvrtc.CACHE).iterdir()] == [".ptx"]  # no draft is left


@pytest.mark.parametrize(
    "other",
    [
        {"source": "another"},
        {"name": "another.cu"},
        {"headers": {"tile.cuh": "another"}},
        {"macros": {"TOKENS": 8}},
        {"macros": {"TOKENS": 7, "ROWS": 1}},
    ],
)
def test_other_input_is_another_text(other: dict, compiled: list[str], cache: Path) -> None:
    assert nvrtc.cached_ptx(**SOURCE) != nvrtc.cached_ptx(**SOURCE | other)
    assert len(compiled) == 2


def test_another_compiler_compiles_again(compiled: list[str], cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nvrtc.cached_ptx(**SOURCE)
    monkeypatch.setattr(nvrtc, "compiler_version", lambda: (13, 1, 101))
    nvrtc.cached_ptx(**SOURCE)
    assert len(compiled) == 2


@pytest.mark.parametrize("damage", [b"", b"\xff\xfe", b"not the checksum\nptx", None])
def test_a_damaged_file_is_written_again(damage: bytes | None, compiled: list[str], cache: Path) -> None:
    ptx = nvrtc.cached_ptx(**SOURCE)
    (file,) = (cache / nvrtc.CACHE).iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] if damage is None else damage)
    assert nvrtc.cached_ptx(**SOURCE) == ptx
    assert file.read_bytes() == whole
    assert len(compiled) == 2


def test_without_a_cache_and_on_a_disk_that_takes_nothing_it_is_compiled(compiled: list[str], cache: Path) -> None:
    (cache / nvrtc.CACHE).write_text("a file where the folder is to be")
    assert nvrtc.cached_ptx(**SOURCE) == nvrtc.cached_ptx(**SOURCE)
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        nvrtc.cached_ptx(**SOURCE)
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert len(compiled) == 3
    jax.config.update("jax_compilation_cache_dir", None)
    nvrtc.cached_ptx(**SOURCE)
    assert len(compiled) == 4
