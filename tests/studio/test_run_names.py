"""Names of runs in addresses: of directories with any name that a file system allows, and one name a run."""

from __future__ import annotations

import os
import shlex
import subprocess
from pathlib import Path

import pytest

from kinetix_dist.studio.runs.address_names import address_name
from kinetix_dist.studio.runs.finetune_command import finetune_lines
from kinetix_dist.studio.runs.run_index import RunIndex
from tests.studio.runs_for_tests import write_run
from tests.studio.serving import serving

NAMES = [b"run\xff", b"100%", b"a%2Fb", b"a%41", b"a,b", b'"q"', b"a\\b", b"tab\tx", b"line\n", b"~", "Ü ü".encode()]
PLAIN = ["mine", "2026-11-29 s", "a+b&c=d#e?f", "Ü"]


@pytest.mark.parametrize("name", PLAIN)
def test_usual_names_stay(name: str) -> None:
    assert address_name(name) == name


def test_different_names_stay_different_and_are_printable() -> None:
    names = [address_name(os.fsdecode(name)) for name in NAMES]
    assert names[:3] == ["run~ff", "100~25", "a~252Fb"]
    assert len({*names, *(f"{name}~7e" for name in names)}) == 2 * len(names)
    assert all(name.isprintable() and not set('%,"\\') & set(name) for name in names)


def test_runs_of_any_name_are_listed_and_have_an_address(tmp_path: Path) -> None:
    for name in NAMES:
        run = tmp_path / os.fsdecode(name)
        write_run(run, 1)
        (run / "recordings").mkdir()
        (run / "recordings" / os.fsdecode(b"100%\xff.mcap")).write_bytes(b"")
    with serving(tmp_path, "--no-play") as server:
        rows = server.json("/api/runs")["runs"]
        assert {row["id"] for row in rows} == {address_name(os.fsdecode(name)) for name in NAMES}
        for row in rows:
            in_address = row["id"].encode().hex(" ").upper().split()
            base = "/api/runs/" + "".join(f"%{byte}" for byte in in_address)
            assert server.json(base)["path"] == row["path"]
            assert server.json(f"{base}/series?names=train/solve_rate")["rows"] == 1
            assert server.request(f"{base}/recordings/100~25~ff.mcap/0")[0] == 503  # needs the engine: it is there
            assert server.request(f"{base}/recordings/none.mcap/0")[0] == 404
        names = ",".join(address_name(os.fsdecode(name)) for name in NAMES[:6])
        assert len(server.json(f"/api/compare?runs={names.replace('~', '%7E')}")["rows"]) == 6


def test_links_to_a_run_are_no_other_runs(tmp_path: Path) -> None:
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    write_run(runs / "mine", 1)
    write_run(elsewhere, 1)
    (runs / "latest").symlink_to("mine")  # before the run in order
    (runs / "older").symlink_to("mine")
    (runs / "other").symlink_to(elsewhere)
    (runs / "same").symlink_to(elsewhere)
    index = RunIndex([runs])
    assert index.runs == {"mine": runs / "mine", "other": runs / "other"}
    index.add(runs / "latest")
    assert list(index.scan()) == ["mine", "other"]


def test_a_command_names_a_run_whose_name_is_not_utf_8(tmp_path: Path) -> None:
    run = tmp_path / os.fsdecode(b"run\xff\n")
    (run / "checkpoints" / "1").mkdir(parents=True)
    (line,) = finetune_lines(run, "designed_s", archive=None)
    assert line.isprintable()
    shown = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {line}"], capture_output=True, check=True, timeout=60
    ).stdout.split(b"\0")
    assert shown[3] == os.fsencode(run.resolve())
    (line,) = finetune_lines(tmp_path / "a b", "designed_s", archive=None)
    assert shlex.split(line)[:2] == ["kinetix-dist", "finetune"]
