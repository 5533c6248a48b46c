"""Files in folders of the compile cache: made once, and again where what is there is not what was asked for."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import export

from kinetix_dist.telemetry import exported_program
from kinetix_dist.telemetry.cached_files import cached
from kinetix_dist.telemetry.exported_program import current_settings, exported
from tests.helpers import compile_cache


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    with compile_cache(tmp_path):
        yield tmp_path


def test_a_file_of_something_else_is_not_taken(cache: Path) -> None:
    assert cached("things", "one", lambda: b"one") == b"one"
    (of_one,) = (cache / "things").iterdir()
    assert cached("things", "other", lambda: b"other") == b"other"
    (of_other,) = set((cache / "things").iterdir()) - {of_one}
    of_one.write_bytes(of_other.read_bytes())
    assert cached("things", "one", lambda: b"again") == b"again"
    assert cached("things", "one", lambda: b"not made") == b"again"


def _kept(key: str, content: bytes) -> bytes:
    return cached("things", key, lambda: content)


def test_writers_of_one_file_do_not_mix(cache: Path) -> None:
    """Each has another content here, so that a mixture would be seen."""
    contents = [bytes([number]) * (1 << 20) for number in range(4)]
    for key in map(str, range(8)):
        with ThreadPoolExecutor(len(contents)) as threads:
            list(threads.map(functools.partial(_kept, key), contents))
        kept = cached("things", key, lambda: b"made again: it was damaged")
        assert kept in contents
    assert not [path for path in (cache / "things").iterdir() if path.suffix != ".things"]


def test_modules_that_a_program_needs_are_imported_before_it_is_loaded(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels of Mosaic cannot be started by a process that does not know where their library is."""

    def call(x: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call("mosaic_gpu_v2", jax.ShapeDtypeStruct(x.shape, x.dtype))(x)

    order: list[str] = []
    deserialize = export.deserialize
    monkeypatch.setattr(exported_program, "import_module", order.append)
    monkeypatch.setattr(export, "deserialize", lambda content: order.append("load") or deserialize(content))
    shapes = [jax.ShapeDtypeStruct((3,), np.float32)]
    for _ in range(2):  # it is traced, then read
        order.clear()
        exported("programs", "call", call, shapes, current_settings())
        assert order == ["jax.experimental.mosaic.gpu", "load"]
    exported("programs", "none", lambda x: x + 1, shapes, current_settings())
    assert order[2:] == ["load"]
