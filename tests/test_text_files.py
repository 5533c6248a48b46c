"""Text files as editors and file systems of others leave them: byte order marks, and hidden copies from a Mac."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.config.phases import read_phases
from kinetix_dist.level.sets import data_files, files_of_set
from kinetix_dist.level.structure import read_document
from kinetix_dist.studio.server.level_files import LevelFiles
from kinetix_dist.sweep.design import read_design
from kinetix_dist.text_files import read_json, read_toml
from tests.helpers import REPOSITORY
from tests.level.documents import cart_document

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16"]  # the last two begin with a byte order mark
OF_A_MAC = b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X        "


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_byte_order_mark_is_no_part_of_a_text(encoding: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes('{"name": "Ü"}'.encode(encoding))
    assert read_json(file) == read_document(file) == {"name": "Ü"}
    file.write_bytes('name = "Ü"'.encode(encoding))
    assert read_toml(file) == {"name": "Ü"}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_files_that_people_write_are_read_with_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    phases = tmp_path / "phases.toml"
    phases.write_bytes("[[phases]]\nstart = 1000\n".encode(encoding))
    assert read_phases(phases) == [{"start": 1000}]
    phases = tmp_path / "phases.json"
    phases.write_bytes('[{"start": 1000}]'.encode(encoding))
    assert read_phases(phases) == [{"start": 1000}]
    example = REPOSITORY / "examples" / "sweeps" / "curricula_s.toml"
    (tmp_path / "sweep.toml").write_bytes(example.read_text(encoding="utf-8").encode(encoding))
    assert read_design(tmp_path / "sweep.toml") == read_design(example)
    (tmp_path / "cart.json").write_bytes(json.dumps(cart_document()).encode(encoding))
    assert json.loads(LevelFiles(directory=tmp_path).read("cart.json").text) == cart_document()


def test_hidden_files_beside_levels_are_skipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cart.json").write_text(json.dumps(cart_document()))
    (tmp_path / "._cart.json").write_bytes(OF_A_MAC)
    hidden = tmp_path / ".trash"
    hidden.mkdir()
    (hidden / "old.json").write_bytes(OF_A_MAC)
    assert files_of_set(str(tmp_path)) == data_files(tmp_path, "**/*.json") == [tmp_path / "cart.json"]
    assert main(["levels", "validate", "--no-play", str(tmp_path)]) == 0
    assert capsys.readouterr().out.endswith("1 of 1 files are valid\n")
