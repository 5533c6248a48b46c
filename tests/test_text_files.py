"""Text files from outside: byte order marks, hidden copies from a Mac, and JSON that is no JSON or too large."""

from __future__ import annotations

import ast
import json
import time
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.config.phases import read_phases
from kinetix_dist.level.sets import data_files, files_of_set
from kinetix_dist.level.structure import read_document
from kinetix_dist.studio.server.level_files import LevelFiles
from kinetix_dist.sweep.design import read_design
from kinetix_dist.text_files import FileTooLargeError, loads_json, read_bytes, read_json, read_toml
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


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"a": 1, "a": 1}', "an object has the key 'a' twice"),
        ('{"a": [{"b": 1, "c": 2, "b": 3}]}', "an object has the key 'b' twice"),
        ('{"a": [0, {"b": NaN}]}', "a[1].b is nan, which JSON does not have"),
        ("[-Infinity]", "[0] is -inf, which JSON does not have"),
        ("1e999", "is inf, which JSON does not have"),
        ('{"\\u001b[2J": 1e999}', r"\x1b[2J is inf"),
        ("[" * 101 + "]" * 101, "brackets are nested too deeply"),
        ("[" * 100_000, "brackets are nested too deeply"),
        ("1" * 5000, "Exceeds the limit"),
        ("{", "Expecting property name"),
    ],
)
def test_json_is_strict(text: str, problem: str) -> None:
    for content in (text, text.encode()):
        with pytest.raises(ValueError) as raised:
            loads_json(content)
        message = str(raised.value)
        assert message.startswith(problem) and message.isprintable() and len(message) < 300


def test_json_that_is_json_is_read_as_python_reads_it() -> None:
    text = '{"a": [1, -2.5e3, true, null, "\\u00fc"], "b": {"a": {}}}'
    assert loads_json(text) == json.loads(text)
    assert loads_json("[" * 100 + "]" * 100) == json.loads("[" * 100 + "]" * 100)


def test_a_file_has_a_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x" * (1 << 20))
    assert len(read_bytes(tmp_path / "file", 1 << 20)) == 1 << 20
    with pytest.raises(FileTooLargeError, match="it has more than 1 MiB"):
        read_bytes(Path("/dev/zero"), 1 << 20)


# Modules that call json.loads themselves: their text comes from this package's own processes, or from files that a run
# wrote for itself.
OWN_JSON = {
    "benchmarks/peer_process", "benchmarks/training_options", "benchmarks/training_run", "child_python",
    "cli/doctor_probes", "cli/sweep", "config/plain", "delay/cloning_state", "level/fingerprints",
    "runtime/driver/run_directory", "runtime/driver/totals", "runtime/processes/fork_client",
    "runtime/processes/fork_server",
    "studio/runs/long_metrics", "studio/runs/verdict_process", "studio/server/evaluation_pages",
    "studio/server/verdict_summaries", "studio/worker/wire", "study/command_results/kind", "text_files",
}  # fmt: skip


def test_json_from_outside_has_one_reader() -> None:
    package = REPOSITORY / "kinetix_dist"
    calls = {
        path.relative_to(package).with_suffix("").as_posix()
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
        and node.attr in ("load", "loads")
        and isinstance(node.value, ast.Name)
        and node.value.id == "json"
    }
    assert calls <= OWN_JSON, f"read JSON from outside with text_files: {calls - OWN_JSON}"


def test_an_equal_key_among_many_takes_no_time() -> None:
    text = "{" + ", ".join(f'"{number}": 0' for number in [*range(100_000), 99_999]) + "}"
    started = time.process_time()
    with pytest.raises(ValueError, match="has the key '99999' twice"):
        loads_json(text)
    assert time.process_time() - started < 5.0  # 0.1 s here; counting each key takes minutes
