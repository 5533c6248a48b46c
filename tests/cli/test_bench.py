"""bench engine: its records, its refusals, and the published engine where it is installed."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from tests.helpers import REPOSITORY

FIELDS = {"engine", "backend", "preset", "size", "worlds", "device", "physics_steps_per_second"}
SMALL = ["--sizes", "s", "--steps", "2"]


def bench(json_file: Path, *arguments: str) -> list[dict]:
    assert main(["bench", "engine", *SMALL, "--json", str(json_file), *arguments]) == 0
    return json.loads(json_file.read_text())


def test_records_have_exactly_the_documented_fields(tmp_path: Path) -> None:
    records = bench(tmp_path / "new" / "bench.json", "--worlds", "2", "5", "--presets", "standard")
    assert [record["worlds"] for record in records] == [2, 5]
    for record in records:
        assert set(record) == FIELDS
        assert (record["engine"], record["size"], record["preset"]) == ("ours", "s", "standard")
        assert record["physics_steps_per_second"] > 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--steps", "3"], "--steps is 3"),
        (["--repeats", "2"], "--repeats is 2"),
        (["--worlds", "0"], "--worlds has 0"),
        (["--levels", "no/such/folder"], "no/such/folder"),
        (["--presets", "exact", "--worlds", "2", "--sizes", "s"], "exact"),
        (["--backend", "cuda", "--worlds", "2", "--sizes", "s"], "cuda"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "engine", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error


def test_our_own_engine_is_not_taken_for_the_published_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KINETIX_PEER_PYTHON", sys.executable)
    monkeypatch.setenv("KINETIX_PEER_PYTHONPATH", str(REPOSITORY))
    assert main(["bench", "engine", *SMALL, "--peers"]) == 2
    assert "setup.sh" in capsys.readouterr().err


@pytest.mark.slow
def test_the_published_engine_is_measured_next_to_ours(tmp_path: Path, public_levels: Path) -> None:
    installed = REPOSITORY / "bench" / ".peers" / "jax2d" / "bin" / "python"
    if "KINETIX_PEER_PYTHON" not in os.environ and not installed.exists():
        pytest.skip("the published jax2d is not installed: bash bench/peers/setup.sh")
    records = bench(tmp_path / "bench.json", "--worlds", "4", "--presets", "paper", "--peers")
    assert [record["engine"] for record in records] == ["ours", "published"]
    assert all(set(record) == FIELDS for record in records)
