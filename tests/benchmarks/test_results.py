"""Records of a benchmark that is cut short are on disk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.benchmarks.measuring import Results
from kinetix_dist.errors import UserError


def test_the_file_is_complete_after_every_record(tmp_path: Path) -> None:
    file = tmp_path / "new" / "records.json"
    results = Results(file)
    for number in range(3):
        results.add({"number": number})
        assert json.loads(file.read_text()) == [{"number": n} for n in range(number + 1)]
    results.replace([{"number": 7}])
    assert json.loads(file.read_text()) == results.records == [{"number": 7}]


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file"):
        Results(tmp_path / "file" / "records.json")
