"""Files of a run with numbers that JSON does not have, or of wrong types: that run reports it, others do not."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from kinetix_dist.studio.server.app import one_line_errors
from kinetix_dist.studio.server.responses import json_response
from kinetix_dist.telemetry.status import StatusError, read_status
from tests.studio.runs_for_tests import write_run
from tests.studio.serving import Server, serving

STATUS = (
    '{"format": 1, "phase": "training", "pid": 1, "host": "h", "session": 1, "started": "2026-01-31T12:00:00Z", %s}'
)
TIME = '"time": "2026-01-31T12:00:00Z", "total_env_steps": 9'
KNOWN = '"update": 1, "env_steps": 2, "update_seconds": 3'
EVALUATION = '{"phase": "after", "update": 20, "env_steps": %s, "sets": {"s": {"names": ["x"], "solved": [%s], %s}}}\n'
OUTCOMES = '{"format": 1, "from_update": 1, "update": 3, "buffer": 0, "solved": [%s], "finished": [2], "sources": %s}\n'
PROCESS = '{"time": "2026-01-31T12:00:00Z", "update": %s, "processes": [{"name": "w", "pid": 1, "busy": %s}]}\n'

# name of the run: (file, what is added to it, in the line that reports it)
DAMAGED = {
    "nan": ("metrics/metrics.jsonl", '{"update": 21, "train/solve_rate": NaN}\n', "train/solve_rate is nan"),
    "overflow": ("metrics/metrics.jsonl", '{"update": 21, "learner/entropy": 1e999}\n', "learner/entropy is inf"),
    "huge": ("metrics/metrics.jsonl", f'{{"update": {10**400}}}\n', "update is an integer of more than 64 bits"),
    "endless": ("metrics/metrics.jsonl", '{"update": -Infinity}\n', "update is -inf"),
    "texts": ("metrics/metrics.jsonl", '{"update": "21"}\n', "it is no row of this file"),
    "left": ("status.json", STATUS % f'{TIME}, {KNOWN}, "seconds_left": NaN', "seconds_left is nan"),
    "late": ("status.json", STATUS % f'"time": 5, "total_env_steps": 9, {KNOWN}, "seconds_left": 1', "time is 5, not"),
    "many": ("status.json", STATUS % f'{TIME}, {KNOWN}, "seconds_left": [1]', "seconds_left is [1]"),
    "state": ("status.json", STATUS % f'{TIME}, {KNOWN}, "seconds_left": 1, "state": "gone"', "state gone is none of"),
    "seed": ("config.json", '{"config": {"run": {"seed": Infinity}}}', "config.run.seed is inf"),
    "name": ("config.json", '{"config": {"run": {"name": {}}}}', "name is a dict, not str"),
    "list": ("config.json", '{"config": []}', "config is a list, not dict"),
    "report": ("report.json", '{"solve_rate": []}', "solve_rate is a list, not dict"),
    "rates": ("report.json", '{"solve_rate": {"after": {"random_s": 3}}}', "random_s is a int, not dict"),
    "before": ("evaluations.json", '{"before": {"random_s": {"rate": "x"}}}', "rate is a str, not int or float"),
    "steps": ("evaluations.jsonl", EVALUATION % ('"x"', 1, '"attempts": 4'), "it is no row of this file"),
    "attempts": ("evaluations.jsonl", EVALUATION % (5, 1, '"attempts": 1e999'), "sets.s.attempts is inf"),
    "event": ("events.jsonl", '{"event": "recovered", "update": NaN}\n', "1 line is damaged in events.jsonl"),
    "busy": ("processes.jsonl", PROCESS % (3, "Infinity"), "1 line is damaged in processes.jsonl"),
    "counts": ("curriculum/outcomes.jsonl", OUTCOMES % (10**30, "{}"), "1 line is damaged in curriculum/outcomes"),
    "sources": ("curriculum/outcomes.jsonl", OUTCOMES % (1, '{"random": 3}'), "1 line is damaged in curriculum/"),
}  # fmt: skip
IN_THE_TABLE = {"metrics.jsonl", "status.json", "config.json", "report.json", "evaluations.jsonl"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    runs = tmp_path_factory.mktemp("runs")
    write_run(runs / "good")
    for name, (file, content, _) in DAMAGED.items():
        path = write_run(runs / name) / file
        path.parent.mkdir(exist_ok=True)
        with path.open("a" if file.endswith(".jsonl") else "w") as out:
            out.write(content)
    with serving(runs, "--no-play") as server:
        yield server


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


def _answer(server: Server, path: str) -> Any:
    status, _, body = server.request(path)
    found = json.loads(body, parse_constant=_refuse)
    assert status == 200 or (status < 500 and found["error"]), (path, status, body)
    return found


def test_every_run_is_listed_and_the_good_one_without_a_word(server: Server) -> None:
    rows = {row["id"]: row for row in _answer(server, "/api/runs")["runs"]}
    assert set(rows) == {"good", *DAMAGED}
    assert rows["good"]["problems"] == [] and rows["good"]["last"]["update"] == 20
    for name, (file, _, text) in DAMAGED.items():
        if Path(file).name in IN_THE_TABLE:
            (problem,) = rows[name]["problems"]
            assert text in problem and Path(file).name in problem and "\n" not in problem, name
        assert rows[name]["last"]["update"] == 20, name


@pytest.mark.parametrize("name", DAMAGED)
def test_the_pages_of_a_damaged_run_say_what_is_wrong_with_it(server: Server, name: str) -> None:
    words = ["", "/evaluations", "/processes", "/curriculum", "/events", "/series?names=train/solve_rate&x=updates"]
    found = [_answer(server, f"/api/runs/{name}{word}") for word in words]
    said = [*next(row for row in _answer(server, "/api/runs")["runs"] if row["id"] == name)["problems"]]
    for answer in found:
        said += [*answer.get("problems", []), answer.get("error", "")]
    assert any(DAMAGED[name][2] in line for line in said), said
    assert found[-1]["rows"] == 20, "rows before it are shown"


def test_damaged_runs_do_not_keep_others_from_being_compared(server: Server) -> None:
    found = _answer(server, f"/api/compare?runs=good,{','.join(DAMAGED)}&metric=train/solve_rate&x=updates")
    assert len(found["curves"]["train/solve_rate"]["runs"]) == len(DAMAGED) + 1
    assert any(problem.startswith("list: config.json is damaged") for problem in found["problems"])


def test_a_bug_in_the_server_is_a_line_too(caplog: pytest.LogCaptureFixture) -> None:
    async def handler(request: web.Request) -> web.StreamResponse:
        return json_response({"rate": float("nan")})

    request = make_mocked_request("GET", "/api/runs")
    answer = asyncio.run(one_line_errors(request, handler))
    assert isinstance(answer, web.Response) and answer.status == 500 and isinstance(answer.body, bytes)
    assert json.loads(answer.body)["error"].startswith("a bug in the server (ValueError: Out of range float")
    assert "Traceback" in caplog.text and "/api/runs" in caplog.text


def test_a_status_as_runs_write_it_is_taken(tmp_path: Path) -> None:
    """The types that are checked are those of the fields; an integer is a float."""
    content = STATUS % f'{TIME}, {KNOWN}, "seconds_left": null'
    (tmp_path / "status.json").write_text(content)
    status = read_status(tmp_path / "status.json")
    assert status is not None and (status.update, status.update_seconds, status.seconds_left) == (1, 3, None)
    (tmp_path / "status.json").write_text(content.replace('"update": 1', '"update": 1.5'))
    with pytest.raises(StatusError, match=r"status.json is damaged: update is 1\.5, not int \| None"):
        read_status(tmp_path / "status.json")
