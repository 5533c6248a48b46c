"""Verdicts of the table of runs: they come by themselves, again after a change, and nothing waits for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.studio.runs.run_index import summary
from kinetix_dist.studio.server import verdict_summaries
from kinetix_dist.studio.server.verdict_summaries import NO_VERDICT, Judge, Summary, VerdictSummaries
from tests.helpers import PATIENCE_S, run_in_time
from tests.studio.runs_for_tests import write_config, write_rows
from tests.studio.serving import serving, wait_for
from tests.studio.verdict_runs import write_collapsed, write_learning

WORKS = {"outcome": "works"}


class Judged(Judge):
    """A judge in this process, by a function that a test gives."""

    def __init__(self, judge: Callable[[Path], Summary], go_on: asyncio.Event | None = None) -> None:
        super().__init__()
        self.judge, self.begun, self.go_on = judge, asyncio.Event(), go_on
        self.is_ended = False

    async def summary(self, path: Path) -> Summary:
        self.begun.set()
        if self.go_on is not None:
            await self.go_on.wait()
        return self.judge(path)

    async def end(self) -> None:
        self.is_ended = True


def rows_of(*runs: Path) -> list[dict[str, Any]]:
    return [summary(run.name, run) for run in runs]


async def judged(verdicts: VerdictSummaries, rows: list[dict[str, Any]]) -> list[Summary]:
    """All of them, once they are there."""
    async with asyncio.timeout(PATIENCE_S):
        while None in (found := await verdicts.of(rows)):
            await asyncio.sleep(0.01)
    return [one for one in found if one is not None]


def test_the_table_has_a_word_for_each_run_after_a_while(tmp_path: Path) -> None:
    write_learning(tmp_path / "good", refreshes=2)
    write_collapsed(tmp_path / "bad", refreshes=2)
    write_config(tmp_path / "new")
    with serving(tmp_path, "--no-play") as server:
        first = server.json("/api/runs")["runs"]
        assert [run["verdict"] for run in first] == [None] * 3, "the table does not wait"

        def found() -> dict[str, Any] | None:
            verdicts = {run["id"]: run["verdict"] for run in server.json("/api/runs")["runs"]}
            return verdicts if all(verdicts.values()) else None

        verdicts = wait_for(found)
        heading = server.json("/api/runs/good/verdict")["heading"]
    assert {name: one["outcome"] for name, one in verdicts.items()} == {
        "good": "works",
        "bad": "collapsed",
        "new": "early",
    }
    assert verdicts["bad"]["rank"] < verdicts["new"]["rank"] < verdicts["good"]["rank"]
    assert verdicts["good"]["heading"] == heading


def test_a_run_is_judged_again_when_its_files_change_but_not_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_config(tmp_path / "run")
    calls = []

    def judge(path: Path) -> Summary:
        calls.append(path)
        return WORKS | {"number": len(calls)}

    async def see() -> None:
        verdicts = VerdictSummaries(Judged(judge))
        assert [one["number"] for one in await judged(verdicts, rows_of(run))] == [1]
        await judged(verdicts, rows_of(run))
        write_rows(run, 1, 2)
        for _ in range(3):
            await judged(verdicts, rows_of(run))
        assert len(calls) == 1, "its verdict is too new"
        monkeypatch.setattr(verdict_summaries, "SECONDS", 0.0)
        monkeypatch.setattr(verdict_summaries, "COST", 0)
        verdicts = VerdictSummaries(Judged(judge))
        await judged(verdicts, rows_of(run))
        await judged(verdicts, rows_of(run))
        assert len(calls) == 2, "nothing changed"
        write_rows(run, 3, 3)
        async with asyncio.timeout(PATIENCE_S):
            while (await verdicts.of(rows_of(run))) != [WORKS | {"number": 3}]:
                await asyncio.sleep(0.01)
        await verdicts.close()

    run_in_time(see())


def test_one_run_is_judged_at_a_time_and_those_that_are_not_shown_any_more_are_not(tmp_path: Path) -> None:
    runs = [write_config(tmp_path / name) for name in "abc"]
    calls = []

    def judge(path: Path) -> Summary:
        calls.append(path.name)
        return WORKS

    async def see() -> None:
        judged_by = Judged(judge, asyncio.Event())
        verdicts = VerdictSummaries(judged_by)
        assert await verdicts.of(rows_of(*runs)) == [None, None, None]
        await asyncio.wait_for(judged_by.begun.wait(), PATIENCE_S)
        assert await verdicts.of(rows_of(runs[0], runs[2])) == [None, None]
        assert judged_by.go_on is not None and not judged_by.is_ended
        judged_by.go_on.set()
        assert await judged(verdicts, rows_of(runs[0], runs[2])) == [WORKS, WORKS]
        async with asyncio.timeout(PATIENCE_S):
            while not judged_by.is_ended:
                await asyncio.sleep(0.01)
        await verdicts.close()

    run_in_time(see())
    assert calls == ["a", "c"]


def test_a_bug_in_a_verdict_is_said_and_ends_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The process ends over it, with a traceback; the next run gets another process."""
    script = tmp_path / "judge.py"
    script.write_text(
        "import json, sys\n"
        "for line in sys.stdin:\n"
        "    assert 'bad' not in line, 'a mistake'\n"
        "    print(json.dumps({'outcome': 'works'}), flush=True)\n"
    )
    runs = [write_config(tmp_path / name) for name in ("bad", "good", "bad_too")]

    async def see() -> list[Summary]:
        verdicts = VerdictSummaries(Judge(str(script)))
        found = await judged(verdicts, rows_of(*runs))
        await verdicts.close()
        return found

    assert run_in_time(see()) == [NO_VERDICT, WORKS, NO_VERDICT]
    assert capfd.readouterr().err.count("AssertionError: a mistake") == 2
