"""A file in place of a directory to write into, or the reverse, is one line that comes before anything slow."""

from __future__ import annotations

from pathlib import Path

import pytest

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.cli.checks import check_output_directory
from kinetix_dist.cli.main import main
from kinetix_dist.errors import UserError
from tests.helpers import REPOSITORY

OFFLINE = str(REPOSITORY / "tests" / "data" / "kinetix_offline_s")
# FILE and DIR stand for an existing file and an existing directory.
DIRECTORIES = (
    "collect --policy random --levels s/hop_home --out FILE",
    f"data import-kinetix {OFFLINE} FILE",
    "clone-flow --data DIR --run FILE",
    "finetune --recipe tiny --levels s/hop_home --each --evaluation.every 4 --run FILE",
    "study embodiment --plan --out FILE",
    "levels generate FILE",
    "levels export designed_s FILE",
    "levels solve s/kick --proofs FILE",
    "levels play s/kick --results FILE",
    "edit --results FILE",
)
FILES = (
    "levels solve s/kick --check --picture DIR",
    "levels export s/kick DIR",
    "levels stats --json DIR",
    "eval --levels s/kick --policy noop --json DIR",
    "eval --levels s/kick --policy noop --record DIR",
    "replay FILE --to DIR",
    "replay FILE --picture DIR",
    "replay FILE --gif DIR",
    "bench env --json DIR",
)


@pytest.fixture
def places(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "directory").mkdir()
    return {"FILE": str(tmp_path / "file"), "DIR": str(tmp_path / "directory")}


def refusal(capsys: pytest.CaptureFixture[str], command: str, places: dict[str, str]) -> str:
    assert main([places.get(word, word) for word in command.split()]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert Path(places["FILE"]).read_text() == "mine" and not list(Path(places["DIR"]).iterdir())
    return line


@pytest.mark.parametrize("command", DIRECTORIES)
def test_a_file_is_no_directory_to_write_into(
    places: dict[str, str], capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert f"{places['FILE']} is a file; give a directory" in refusal(capsys, command, places)
    below = places | {"FILE": f"{places['FILE']}/below"}
    assert main([below.get(word, word) for word in command.split()]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{places['FILE']}/below is below {places['FILE']}, which is a file; give a directory" in line


@pytest.mark.parametrize("command", FILES)
def test_a_directory_is_no_file_to_write(
    places: dict[str, str], capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert places["DIR"] in refusal(capsys, command, places)


def test_a_directory_is_no_file_for_records_of_a_benchmark(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="Is a directory"):
        Results(tmp_path)


def test_a_directory_that_does_not_exist_yet_is_fine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path, tmp_path / "a" / "b", Path(), Path("a")):
        check_output_directory(path)
