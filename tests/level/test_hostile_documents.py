"""Level files that are large or made to harm: refused in time, in one short printable line, whatever they hold."""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.errors import UserError
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix
from kinetix_dist.level.proof import read_proof
from kinetix_dist.level.schema import level_from_json, load_level
from kinetix_dist.level.structure import MAX_LEVEL_BYTES, LevelFormatError
from kinetix_dist.level.validate import problems_of
from kinetix_dist.studio.server.level_links import read_link
from kinetix_dist.studio.worker.document_check import check_document
from tests.helpers import REPOSITORY
from tests.level.documents import cart_document

SECONDS = 10.0  # of CPU time; 1,000 shapes need 0.7 s; 100,000 needed 62 s
CLEAR = "\x1b[2J\x1b]0;mine\x07"  # clears the screen, and names the window
Edit = Callable[[dict[str, Any]], Any]


def shapes(count: int) -> Edit:
    return lambda document: document.update(shapes=[document["shapes"][0] | {"id": f"s{i}"} for i in range(count)])


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def wide_below_long_keys(document: dict[str, Any]) -> None:
    """Add many entries, each with a path of 30,000 characters."""
    inner: dict[str, Any] = {str(i): i for i in range(90_000)}
    for _ in range(90):
        inner = {"x" * 300: inner}
    document["walls"] = inner


def unknown_shape(document: dict[str, Any]) -> None:
    """Add as many shapes as are read, and a joint to none of them: the remedy lists all."""
    shapes(1000)(document)
    document["joints"][0]["a"] = "none"


# name: (change of a valid document, a part of the message)
DOCUMENTS: dict[str, tuple[Edit, str]] = {
    "shapes": (shapes(1001), "shapes: has 1,001 entries; give at most 1,000"),
    "joints": (lambda d: d.update(joints=d["joints"] * 5000), "joints: has 5,000 entries"),
    "tags": (lambda d: d.update(tags=[str(i) for i in range(20_000)]), "tags: has 20,000 entries"),
    "corners": (lambda d: d["shapes"][0].update(vertices=[[0, 0]] * 2000), "vertices: has 2,000 entries"),
    "values": (lambda d: d.update(shapes=[{str(i): i for i in range(200)}] * 600), "more than 100,000 values"),
    "text": (lambda d: d.update(description="x" * 3_000_000), "description: has 3,000,000 characters"),
    "size": (lambda d: d.update(size="x" * 9000), "unknown size 'xxx"),
    "role": (lambda d: d["shapes"][0].update(role="x" * 9000), "shapes[0].role: is 'xxx"),
    "key": (lambda d: d.update({"x" * 9000: 1}), "is not a field of the format"),
    "format": (lambda d: d.update(format=["x" * 9000]), "format: is ['xxx"),
    "names": (unknown_shape, "joints[0].a: there is no shape 'none'; shapes are s0, s1"),
    "paths": (wide_below_long_keys, "walls"),
    "deep": (lambda d: d.update(shapes=nested(99)), "nested too deeply"),
    "name": (lambda d: d.update(name=CLEAR), "name: has the control character '\\x1b'; remove it"),
    "title": (lambda d: d.update(title="a\nb"), "title: has the control character '\\n'; remove it"),
    "id": (lambda d: d["shapes"][0].update(id=CLEAR), "shapes[0].id: has the control character"),
    "unknown key": (lambda d: d.update({CLEAR: 1}), "has the control character '\\x1b'; remove it"),
    "surrogate": (lambda d: d.update(name="\ud800"), "name: has the control character '\\ud800'"),
}


def file_of(tmp_path: Path, document: Any) -> Path:
    path = tmp_path / "level.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_hostile_document_is_refused_in_time_and_in_one_short_line(name: str, tmp_path: Path) -> None:
    edit, text = DOCUMENTS[name]
    document = cart_document()
    edit(document)
    began = time.process_time()
    for read in (lambda: level_from_json(document), lambda: load_level(file_of(tmp_path, document))):
        with pytest.raises(LevelFormatError) as raised:
            read()
        message = str(raised.value)
        assert message.isprintable() and len(message) < 1000 and text in message
    problems = check_document(document).problems
    assert problems and all(str(problem).isprintable() and len(str(problem)) < 1000 for problem in problems)
    assert any(text in str(problem) for problem in problems)
    assert time.process_time() - began < SECONDS


def test_a_hundred_thousand_shapes_in_memory_are_counted_alone() -> None:
    document = cart_document()
    shapes(100_000)(document)
    began = time.process_time()
    (problem,) = problems_of(document, capacity_of_size("l"))
    assert "100,000 entries" in str(problem) and time.process_time() - began < 1.0


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ('{"name": "' + "x" * MAX_LEVEL_BYTES + '"}', "has more than 4 MiB; a level file has a few kB"),
        ('{"name": "a", "name": "b"}', "is not JSON (an object has the key 'name' twice)"),
        ('{"shapes": [{"id": "a", "id": "b"}]}', "is not JSON (an object has the key 'id' twice)"),
        ('{"gravity": [0, NaN]}', "is not JSON (gravity[1] is nan, which JSON does not have)"),
        ('{"gravity": [0, 1e999]}', "is not JSON (gravity[1] is inf"),
        ('{"gravity": [0, 9223372036854775808]}', "is not JSON (gravity[1] is an integer of more than 64 bits)"),
        ("[" * 100_000, "is not JSON (brackets are nested too deeply)"),
        ("[" * 200 + "]" * 200, "is not JSON (brackets are nested too deeply)"),
        ('{"' + "x" * 9000 + '": 1, "' + "x" * 9000 + '": 1}', "is not JSON (an object has the key 'xxx"),
        (f'{{"{CLEAR}": 1}}', "is not JSON (Invalid control character"),
    ],
    ids=["bytes", "twice", "twice inside", "nan", "infinity", "integer", "deep", "deep and whole", "long", "control"],
)
def test_a_file_is_checked_before_it_is_a_document(content: str, text: str, tmp_path: Path) -> None:
    path = file_of(tmp_path, content)
    for read in (load_level, read_proof):
        began = time.process_time()
        with pytest.raises(LevelFormatError) as raised:
            read(path)
        message = str(raised.value)
        assert message.startswith(f"{path}: ") and text in message and message.isprintable() and len(message) < 500
        assert time.process_time() - began < SECONDS


def test_a_description_may_have_lines() -> None:
    document = cart_document() | {"description": "Roll.\n\tThen stop.\r\n"}
    level_from_json(document)


def test_a_public_document_is_bounded_too() -> None:
    document = export_kinetix(level_from_json(cart_document()))
    document["env_state"]["polygon"] = [document["env_state"]["polygon"][0]] * 2000
    with pytest.raises(LevelFormatError, match=r"polygon: has 2,000 entries"):
        import_kinetix(document)


def test_a_proof_makes_room_for_no_more_steps_than_it_claims(tmp_path: Path) -> None:
    path = next((REPOSITORY / "levels" / "proofs").glob("s/*.json"))
    document = json.loads(path.read_text())
    for change in ({"actions": " ".join(["9999*000000"] * 100_000)}, {"num_steps": 10**9, "max_steps": 10**9}):
        began = time.process_time()
        with pytest.raises(LevelFormatError, match=r"actions: are 999900000 steps|num_steps: is 1000000000"):
            read_proof(file_of(tmp_path, document | change))
        assert time.process_time() - began < SECONDS


def test_what_a_command_prints_about_files_is_printable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = cart_document() | {"name": CLEAR, CLEAR: CLEAR}
    (tmp_path / "level.json").write_text(json.dumps(document))
    assert main(["levels", "validate", "--no-play", str(tmp_path)]) == 1
    assert main(["levels", "list", str(tmp_path)]) == 2
    shown = capsys.readouterr()
    assert "\x1b" not in shown.out + shown.err and "\x07" not in shown.out + shown.err
    assert r"\x1b" in shown.out and r"\x1b" in shown.err


def test_a_link_is_read_as_strictly() -> None:
    for content in (b'{"a": NaN}', b'{"a": 1, "a": 2}', b"[" * 100_000):
        packed = "1." + base64.urlsafe_b64encode(zlib.compress(content)).decode().rstrip("=")
        with pytest.raises(UserError, match="this link is damaged"):
            read_link(packed)
