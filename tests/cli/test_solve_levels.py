"""`kinetix-dist levels solve`: stores what it finds, checks what is stored, and one line for what is wrong."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.level.level_data import levels_root
from tests.cli.test_eval_command import TINY_POLICY, save_run
from tests.level.documents import cart_document


def command(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, list[str]]:
    """Exit status and lines of stdout."""
    status = main(["levels", "solve", *argv])
    return status, capsys.readouterr().out.splitlines()


def refusal(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    assert main(["levels", "solve", *argv]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.fixture
def level_file(tmp_path: Path) -> Path:
    """A level of a user's own: that of the trapdoor."""
    path = tmp_path / "mine.json"
    path.write_text((levels_root() / "s" / "trapdoor.json").read_text())
    return path


@pytest.mark.long
def test_what_is_found_is_stored_beside_the_level_and_checked(
    level_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, lines = command(capsys, str(level_file), "--check")
    assert status == 1 and "mine: there is no proof" in lines[0]
    status, lines = command(capsys, str(level_file), "--seconds", "20", "--worlds", "64")
    stored = level_file.with_name("mine.proof.json")
    assert status == 0 and lines[0].startswith("mine: solved in ") and lines[0].endswith(f"wrote {stored}")
    steps = json.loads(stored.read_text())["num_steps"]

    status, lines = command(capsys, str(level_file))
    assert status == 0 and lines[0] == f"mine: has a proof of {steps} steps (--again searches for another)"
    picture = level_file.with_name("end.png")
    status, lines = command(capsys, str(level_file), "--check", "--picture", str(picture))
    share = r"also from (\d+)% of slightly different starts"
    assert status == 0
    assert (found := re.fullmatch(rf"mine: solved in {steps} steps, {share} \(the proof: (\d+)%\)", lines[0]))
    assert abs(int(found[1]) - int(found[2])) < 20  # of 64 starts, and not those of the search
    assert picture.read_bytes().startswith(b"\x89PNG")

    # A proof of another preset, and of the level before a change.
    status, lines = command(capsys, str(level_file), "--check", "--env.preset", "fine")
    assert status == 1 and f"{stored}: preset: is 'standard', requested is 'fine'" in lines[0]
    level_file.write_text(level_file.read_text().replace("[3.1, 0.85]", "[3.2, 0.85]"))
    status, lines = command(capsys, str(level_file), "--check")
    assert status == 1 and f"{stored}: level_sha256: is " in lines[0] and "0 of 1" in lines[1]


@pytest.mark.long
def test_the_policy_of_a_checkpoint_tries_first(level_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that has learned nothing yet: what it draws opens the trapdoor in a third of all episodes."""
    checkpoint = save_run(level_file.parent, TINY_POLICY)
    status, lines = command(
        capsys, str(level_file), "--checkpoint", str(checkpoint), "--seconds", "30", "--worlds", "64"
    )
    assert status == 0 and " steps by policy after " in lines[0]
    assert json.loads(level_file.with_name("mine.proof.json").read_text())["method"] == "policy"


def test_actions_that_do_not_solve_are_found_out(level_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    proof = json.loads((levels_root() / "proofs" / "s" / "trapdoor.json").read_text())
    proof |= {"actions": "5*000000", "num_steps": 5}
    level_file.with_name("mine.proof.json").write_text(json.dumps(proof))
    status, lines = command(capsys, str(level_file), "--check")
    assert status == 1 and "mine: the proof claims to solve it in 5 steps; replayed, it is" in lines[0]


def test_a_level_that_is_not_solved_says_what_was_tried(level_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    level_file.write_text(level_file.read_text().replace('"role": "green"', '"role": "green", "fixed": true'))
    status, lines = command(capsys, str(level_file), "--seconds", "2", "--worlds", "64")
    assert status == 1 and lines[0].startswith("mine: not solved in ")
    assert all(f"{method}: " in lines[0] for method in ("random", "cem", "best_first"))
    assert lines[1] == "0 of 1 levels have a proof" and not level_file.with_name("mine.proof.json").exists()


def test_what_is_wrong_is_one_line(level_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    level = str(level_file)
    assert "unknown level set 'nope'" in refusal(capsys, "nope")
    assert "drawn when it is used" in refusal(capsys, "random_s")
    assert "--seconds is 0.0" in refusal(capsys, level, "--seconds", "0")
    assert "--worlds is 8; give 32 or more" in refusal(capsys, level, "--worlds", "8")
    assert "--method policy needs --checkpoint" in refusal(capsys, level, "--method", "policy")
    assert "plays no policy" in refusal(capsys, level, "--method", "cem", "--checkpoint", "generalist")
    assert "searches nothing" in refusal(capsys, level, "--check", "--again")
    assert "give --check too" in refusal(capsys, level, "--picture", "a.png")
    assert "unknown preset 'exact'" in refusal(capsys, level, "--env.preset", "exact")
    assert "is a file; give a directory" in refusal(capsys, level, "--proofs", level)
    assert "nothing to draw" in refusal(capsys, level, "--check", "--picture", str(tmp_path / "a.png"))
    missing = refusal(capsys, level, "--method", "policy", "--checkpoint", str(tmp_path / "none"), "--seconds", "1")
    assert "there is no checkpoint" in missing and "none" in missing
    assert "there is no checkpoint generalists" in refusal(capsys, level, "--checkpoint", "generalists")
    document = cart_document() | {"joints": [], "thrusters": []}
    level_file.write_text(json.dumps(document))
    assert "no action moves anything in it" in refusal(capsys, level)
    document = cart_document() | {"thrusters": []}
    document["joints"][0]["motor"]["speed"] = 0.0
    level_file.write_text(json.dumps(document))
    assert "no action moves anything in it" in (said := refusal(capsys, level))
    assert "a motor of speed 0 can only brake" in said
    level_file.write_text("{}")
    assert "size: is missing" in refusal(capsys, level)
