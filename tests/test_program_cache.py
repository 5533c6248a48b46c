"""The program cache: files that are made once, and keys that change with what a program is made of."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import kinetix_dist
from kinetix_dist import prng, program_cache
from kinetix_dist.learner import update
from kinetix_dist.program_cache import ProgramKey, cached_file, closure_of, exported
from kinetix_dist.runtime.cores import rollout_core
from tests.helpers import compile_cache

KEY = ProgramKey(kind="programs", module=prng.__name__)


@pytest.fixture
def cache(tmp_path: Path) -> Iterator[Path]:
    with compile_cache(tmp_path):
        yield tmp_path


def forget_sources() -> None:
    program_cache.closure_of.cache_clear()
    program_cache._source.cache_clear()
    program_cache._native_checksum.cache_clear()


@pytest.fixture
def edit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Changes a source by a comment, as far as the cache sees it."""
    read = program_cache._content

    def add_comment(source: str) -> None:
        def content(file: Path) -> bytes:
            return read(file) + (b"# a comment" if file.as_posix().endswith(source) else b"")

        monkeypatch.setattr(program_cache, "_content", content)
        forget_sources()

    yield add_comment
    forget_sources()


def files(cache: Path) -> int:
    return len(list((cache / KEY.kind).iterdir()))


# --- Files


def test_a_file_of_another_key_is_not_taken(cache: Path) -> None:
    assert cached_file("texts", "one", lambda: b"one") == b"one"
    (of_one,) = (cache / "texts").iterdir()
    assert cached_file("texts", "other", lambda: b"other") == b"other"
    (of_other,) = set((cache / "texts").iterdir()) - {of_one}
    of_one.write_bytes(of_other.read_bytes())
    with pytest.warns(RuntimeWarning, match="is damaged: it is ignored and written again"):
        assert cached_file("texts", "one", lambda: b"again") == b"again"
    assert cached_file("texts", "one", lambda: b"not made") == b"again"


def test_a_damaged_program_is_ignored_with_a_warning_and_written_again(cache: Path) -> None:
    def double() -> np.ndarray:
        return np.asarray(exported(lambda x: 2 * x, KEY)(jnp.arange(3)))

    double()
    (file,) = (cache / KEY.kind).iterdir()
    content = file.read_bytes()
    file.write_bytes(content[:-1])
    with pytest.warns(RuntimeWarning, match=f"{file.name} is damaged"):
        np.testing.assert_array_equal(double(), [0, 2, 4])
    assert file.read_bytes() == content
    np.testing.assert_array_equal(double(), [0, 2, 4])  # and no warning


def _store(key: str, content: bytes) -> bytes:
    return cached_file("texts", key, lambda: content)


def test_writers_of_one_file_do_not_mix(cache: Path) -> None:
    """Each has another content here, so that a mixture would be seen."""
    contents = [bytes([number]) * (1 << 20) for number in range(4)]
    for key in map(str, range(8)):
        with ThreadPoolExecutor(len(contents)) as threads:
            list(threads.map(functools.partial(_store, key), contents))
        stored = cached_file("texts", key, lambda: b"made again: it was damaged")
        assert stored in contents
    assert not [path for path in (cache / "texts").iterdir() if path.suffix != ".texts"]


# --- Keys


def test_a_change_of_code_that_a_program_does_not_reach_leaves_it_valid(edit: Callable[[str], None]) -> None:
    modules = update.__name__, rollout_core.__name__
    before = {module: closure_of(module).checksum for module in modules}
    others = ("cli/main.py", "benchmarks/training_speed.py", "telemetry/sinks/rerun.py", "jax2d/fidelity/study.py")
    for source in others:
        assert list(Path(kinetix_dist.__path__[0]).parent.glob(f"**/{source}")), source
        edit(source)
        assert {module: closure_of(module).checksum for module in modules} == before, source
    assert not [name for name in closure_of(*modules).modules if "dashboard" in name or "server" in name]


@pytest.mark.parametrize(
    "source", ["learner/update.py", "learner/gae.py", "kernels/cuda/attention.cu", "warp/native/joints.h"]
)
def test_a_changed_line_of_an_update_makes_another_key(edit: Callable[[str], None], source: str) -> None:
    before = closure_of(update.__name__).checksum
    edit(source)
    assert closure_of(update.__name__).checksum != before


SOURCE = """
import jax2d.scene
from kinetix_dist import prng
from kinetix_dist.env import outcome, Environment  # both
def later():
    from kinetix_dist.learner import (
        gae,  # in a function
        state as other,
    )
"""


def test_all_forms_of_imports_are_followed() -> None:
    assert set(program_cache._imports_of(SOURCE)) == {
        "jax2d.scene",
        "kinetix_dist.prng",
        "kinetix_dist.env.outcome",
        "kinetix_dist.env",
        "kinetix_dist.learner.gae",
        "kinetix_dist.learner.state",
    }


def test_another_setting_of_jax_makes_another_program(cache: Path) -> None:
    def compute() -> None:
        exported(lambda x: x @ x.T, KEY)(jnp.ones((2, 2)))

    compute()
    compute()
    assert files(cache) == 1
    with jax.default_matmul_precision("highest"):  # of a thread
        compute()
    assert files(cache) == 2
    settings = {"jax_random_seed_offset": 1, "jax_high_dynamic_range_gumbel": True, "jax_enable_x64": True}
    for number, (setting, other) in enumerate(settings.items()):
        usual = getattr(jax.config, setting)
        jax.config.update(setting, other)
        try:
            compute()
            assert files(cache) == 3 + number, setting
        finally:
            jax.config.update(setting, usual)
    with jax.log_compiles(True):  # which changes no program
        compute()
    assert files(cache) == 5


def test_settings_of_the_caller_hold_where_a_program_is_traced(cache: Path) -> None:
    with jax.enable_x64(True):
        assert exported(lambda x: x / 3, KEY)(np.ones(1, np.float64)).dtype == np.float64


def test_other_versions_and_parts_make_other_programs(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exported(lambda x: x, KEY)(jnp.ones(2))
    exported(lambda x: x, ProgramKey(kind=KEY.kind, module=KEY.module, depends_on="another"))(jnp.ones(2))
    exported(lambda x: x, ProgramKey(kind=KEY.kind, module=KEY.module, at_trace=lambda: "another"))(jnp.ones(2))
    assert files(cache) == 3
    monkeypatch.setattr(program_cache, "_versions", lambda: ("0.0.1",))
    exported(lambda x: x, KEY)(jnp.ones(2))
    exported(lambda x: x, KEY)(jnp.ones(3))
    assert files(cache) == 5


def test_a_source_that_changes_while_a_process_runs_keeps_its_programs_out_of_the_cache(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its checksum is not of the code that this process runs: a process of the new code would read the old program."""
    monkeypatch.setattr(program_cache, "_IMPORTED_AT", os.stat(prng.__file__).st_ctime - 1)
    forget_sources()
    with pytest.warns(RuntimeWarning, match="was changed after this process began"):
        np.testing.assert_array_equal(exported(lambda x: x + 1, KEY)(jnp.zeros(2)), 1)
    assert not (cache / KEY.kind).exists()
    monkeypatch.undo()
    forget_sources()
    assert time.time() >= program_cache._IMPORTED_AT


# --- Programs


def test_modules_that_a_program_needs_are_imported_before_it_is_loaded(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels of Mosaic cannot be started by a process that does not know where their library is."""

    def call(x: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call("mosaic_gpu_v2", jax.ShapeDtypeStruct(x.shape, x.dtype))(x)

    order: list[str] = []
    deserialize = export.deserialize
    monkeypatch.setattr(program_cache, "import_module", order.append)
    monkeypatch.setattr(export, "deserialize", lambda content: order.append("load") or deserialize(content))
    for _ in range(2):  # it is traced, then read
        order.clear()
        jax.jit(exported(call, KEY)).trace(jnp.ones(3))
        assert order == ["jax.experimental.mosaic.gpu", "load"]
    exported(lambda x: x + 1, KEY)(jnp.ones(4))
    assert order[2:] == ["load"]
