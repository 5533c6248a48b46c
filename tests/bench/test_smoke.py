"""The smoke run itself: a run on Ray passes it, and one that fails, or learns nothing but NaN, does not."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from bench import smoke


@pytest.mark.slow
def test_a_run_on_ray_is_trained_resumed_and_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "smoke.json"
    monkeypatch.setattr(sys, "argv", ["smoke", "--json", str(file), "--keep", str(tmp_path / "kept")])
    assert smoke.main() == 0
    train, resume, evaluation = json.loads(file.read_text())
    for record in (train, resume):
        assert record["exit_code"] == 0 and not record["wrong"]
        assert 0 < record["first_update_seconds"] < record["seconds"]
        assert record["env_steps_per_second"] > 0
    assert 0 <= evaluation["solve_rate"] <= 1


class _Said(smoke.Smoke):
    """Commands are not run: what they would have left is given."""

    def __init__(self, rows: list[dict[str, Any]], tmp_path: Path) -> None:
        super().__init__(tmp_path, argparse.Namespace(updates=2))
        self.rows = rows

    def _command(self, name: str, arguments: list[str], num_rows: int | None = None) -> dict[str, Any]:
        return {"command": name, "wrong": []}

    def _rows(self) -> list[dict[str, Any]]:
        return self.rows


@pytest.mark.parametrize(
    ("updates", "loss", "says"),
    [
        ([1.0, 2.0], 0.5, None),
        ([1.0], 0.5, "metrics are of updates [1.0], 1 to 2 were to be made"),
        ([1.0, 1.0], 0.5, "metrics are of updates [1.0, 1.0], 1 to 2 were to be made"),
        ([1.0, 2.0], float("nan"), "loss of update 1 is not finite"),
    ],
)
def test_what_a_run_leaves_out_is_wrong(updates: list[float], loss: float, says: str | None, tmp_path: Path) -> None:
    rows = [{"progress/updates": u, "progress/env_steps_per_second": 10.0, "loss": loss} for u in updates]
    wrong = _Said(rows, tmp_path)._train("train", [], 1)["wrong"]
    assert wrong[:1] == ([says] if says else [])


def test_a_command_that_fails_is_wrong_with_its_last_words(tmp_path: Path) -> None:
    args = argparse.Namespace(recipe="tiny", device="cpu", seconds=60.0)
    record = smoke.Smoke(tmp_path, args)._command("train", ["trian"])
    assert record["exit_code"] == 2 and "did you mean 'train'" in record["wrong"][0]
