"""Links of levels, read by the command: by their part behind #, of whatever host; damaged ones are one line."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.errors import UserError
from kinetix_dist.studio.server.level_links import LINK_VERSION, MAX_LEVEL_BYTES, linked_level, read_link
from tests.helpers import REPOSITORY

LEVEL = json.loads((REPOSITORY / "levels" / "m" / "ramp_car.json").read_text())


def part_of(content: bytes) -> str:
    return f"{LINK_VERSION}.{base64.urlsafe_b64encode(zlib.compress(content)).decode().rstrip('=')}"


PART = part_of(json.dumps(LEVEL).encode())


@pytest.mark.parametrize(
    "link",
    [
        f"http://127.0.0.1:8650/#/edit?level={PART}",
        f"https://gpu.example/pages/?x=1#/edit?from=a&level={PART}",
        f"#/edit?level={PART}",
        f"level={PART}",
        f"  level={PART}\n",
    ],
)
def test_the_level_of_a_link_is_that_of_its_file(link: str) -> None:
    part = linked_level(link)
    assert part is not None and read_link(part) == LEVEL


def test_links_from_before_there_were_versions_open() -> None:
    stream = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    content = stream.compress(json.dumps(LEVEL).encode()) + stream.flush()
    assert read_link(base64.urlsafe_b64encode(content).decode().rstrip("=")) == LEVEL


@pytest.mark.parametrize("text", ["s/hop_home", "mine.json", "my_levels/", "sublevel=1.x"])
def test_files_and_levels_are_no_links(text: str) -> None:
    assert linked_level(text) is None


@pytest.mark.parametrize("text", ["http://127.0.0.1:8650/#/edit", "https://gpu.example/?token=x", "#/edit?from=a"])
def test_an_address_without_a_level_is_a_link_that_holds_none(text: str) -> None:
    with pytest.raises(UserError, match="it holds no level"):
        read_link(str(linked_level(text)))


@pytest.mark.parametrize("command", [["edit"], ["levels", "play"]])
@pytest.mark.parametrize(
    ("part", "text"),
    [
        (PART[:-20], "cut off"),
        (f"7.{PART[2:]}", "of version 7"),
        (f"{'1' * 5000}.{PART[2:]}", "damaged"),
        ("", "holds no level"),
    ],
)
def test_commands_refuse_a_bad_link_in_one_line(command: list[str], part: str, text: str, capsys: Any) -> None:
    assert main([*command, f"http://127.0.0.1:8650/#/edit?level={part}"]) == 2
    line = capsys.readouterr().err
    assert text in line and line.count("\n") == 1


def test_playing_refuses_the_level_of_a_link_that_cannot_be_played(capsys: Any) -> None:
    """The editor opens it: it is still to be drawn."""
    unfinished = part_of(json.dumps(LEVEL | {"joints": [], "shapes": LEVEL["shapes"][:1]}).encode())
    assert main(["levels", "play", f"level={unfinished}"]) == 2
    line = capsys.readouterr().err
    assert "the level of this link: shapes: 0 shapes are blue" in line and line.count("\n") == 1


DAMAGED: dict[str, tuple[str, str]] = {
    "cut off": (PART[:-20], "cut off"),
    "a letter changed": (PART[:40] + ("A" if PART[40] != "A" else "B") + PART[41:], "damaged"),
    "empty": ("", "damaged"),
    "no version": (PART[2:], "damaged"),
    "of a later version": (f"2.{PART[2:]}", "of version 2, this installation reads version 1"),
    "no object": (part_of(b"[1]"), "no JSON object"),
    "too large": (part_of(b" " * (MAX_LEVEL_BYTES + 1)), "too large"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_link_is_one_line(case: str) -> None:
    part, text = DAMAGED[case]
    with pytest.raises(UserError, match=text) as error:
        read_link(part)
    assert "\n" not in str(error.value)


def test_links_of_designed_levels_are_short() -> None:
    """Browsers take addresses of 2 MB, and chats some thousand characters."""
    files = sorted((REPOSITORY / "levels" / "l").glob("*.json"))
    lengths = {file.stem: len(part_of(json.dumps(json.loads(file.read_text())).encode())) for file in files}
    longest = max(lengths, key=lambda name: lengths[name])
    assert len(files) == 40 and lengths[longest] < 1000, (longest, lengths[longest])
