"""Teaching in the background: outcomes, files, and what is refused. Scripts stand in for training and search."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.level.level_data import levels_root
from kinetix_dist.studio.server import teaching as teaching_module
from kinetix_dist.studio.server.background_command import BackgroundCommand
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.teaching import BusyError, Job, Teaching, TeachingError, file_name
from kinetix_dist.studio.server.worker_client import Progress, WorkerClient
from kinetix_dist.studio.worker.wire import Message
from kinetix_dist.telemetry.status import Status
from tests.helpers import run_in_time

DOCUMENT = json.loads((levels_root() / "s" / "hop_home.json").read_text())
PROOF = levels_root() / "proofs" / "s" / "hop_home.json"
GOOD = {"problems": [], "num_problems": 0, "warnings": [], "facts": {"noop_solved_at": None}}
STATUS = dataclasses.asdict(
    Status(
        phase="training", pid=1, host="h", session=1, started="2026-11-29T00:00:00Z", time="2026-11-29T00:00:00Z",
        update=None, env_steps=None, total_env_steps=0, seconds_left=None, update_seconds=None,
    )
)  # fmt: skip

# Trains in no time: the files of a run that the server reads.
TRAINS = """
import json, pathlib, sys, time
words = dict(zip(sys.argv[1:], sys.argv[2:]))
if sys.argv[1] == "finetune":
    run = pathlib.Path(words["--run"])
    (run / "checkpoints" / "00000002").mkdir(parents=True)
    (run / "config.json").write_text("{{}}")
    def evaluated(phase, update, solved):
        sets = {{words["--levels"]: {{"names": ["level"], "solved": [solved], "attempts": 64}}}}
        with (run / "evaluations.jsonl").open("a") as file:
            file.write(json.dumps({{"phase": phase, "update": update, "env_steps": 8 * update, "sets": sets}}) + "\\n")
    def phase(name):
        text = json.dumps({status!r} | {{"phase": name}})
        (run / "status.json").write_text(text)
        time.sleep({phase_seconds})
    phase("evaluating")
    evaluated("before", 0, {before})
    time.sleep({sleep})
    for name in (*(["imitating"] if "--run.imitation_steps" in words else []), "compiling", "training", "evaluating"):
        phase(name)
    evaluated("after", 2, {after})
else:
    if {found} or ("--method" in words and {found_by_policy}):
        file = pathlib.Path(sys.argv[3])
        file.with_name(file.stem + ".proof.json").write_text(pathlib.Path({proof!r}).read_text())
    else:
        print("hop_home: not solved in 60 s; tried random: 5 steps, green came within 0.10 m of blue")
        print("0 of 1 levels have a proof")
        sys.exit(1)
"""


class Engine(WorkerClient):
    """Engine worker that answers every check alike."""

    def __init__(self, **checked: Any) -> None:
        super().__init__(is_allowed=False)
        self._checked = GOOD | checked
        self.pretrained = ["generalist"]

    async def request(self, kind: str, fields: dict[str, Any], progress: Progress | None = None) -> Message:
        assert kind == "check" and fields["play"]
        return Message(self._checked)

    async def hello(self) -> dict[str, Any]:
        return {"pretrained": self.pretrained}


def teaching(tmp_path: Path, script: str, engine: WorkerClient | None = None) -> Teaching:
    program = tmp_path / "program.py"
    program.write_text(script)

    async def start(words: list[str]) -> BackgroundCommand:
        return await BackgroundCommand.start(words, module=str(program))

    return Teaching(tmp_path / "taught", engine or Engine(), RunService(()), start=start)


def trains(before: int, after: int, **options: Any) -> str:
    """found, found_by_policy: whether a search without and with the policy finds a proof."""
    usual = {"found": True, "found_by_policy": False, "sleep": 0.0, "phase_seconds": 0.0, "status": STATUS}
    return TRAINS.format(**usual | options, before=before, after=after, proof=str(PROOF))


def outcome(of: Teaching, kind: str = "teach") -> Job:
    async def run() -> Job:
        job = await of.begin(kind, DOCUMENT, 60)
        while not job.is_over:
            await asyncio.sleep(0.02)
        return job

    return run_in_time(run())


def files_of(tmp_path: Path) -> set[str]:
    return {path.suffix if path.is_file() else "run" for path in (tmp_path / "taught").glob("*")}


def test_a_level_that_was_learned_has_a_policy_a_proof_and_both_rates(tmp_path: Path) -> None:
    job = outcome(teaching(tmp_path, trains(3, 55)))
    assert job.state == "done" and job.text == "learned: 55 of 64 attempts, 3 before" and job.learned, job
    assert job.before is not None and job.after is not None
    assert job.after["rate"] == 55 / 64 and 0.74 < job.after["low"] < 0.76 and 0.92 < job.after["high"] < 0.93
    assert job.proof is not None and len(job.proof["actions"]) == job.proof["steps"]
    assert job.run == job.files.run.name and job.as_json()["files"].keys() == {"level", "run", "proof"}
    assert json.loads(job.files.level.read_text()) == DOCUMENT
    first, second = job.command.split("\n")
    assert first.startswith("kinetix-dist levels solve ") and first.endswith("--seconds 60")
    assert second.startswith("kinetix-dist finetune --recipe teach --from generalist --levels ")
    assert "--run.max_seconds 60" in second and second.endswith("--run.imitation_steps 150 --run.stop_at 0.5")


@pytest.mark.parametrize(("after", "text"), [(3, "not learned: 3 of 64"), (25, "partly learned: 25 of")])
def test_without_a_solution_it_trains_on_the_level_alone_and_says_so(tmp_path: Path, after: int, text: str) -> None:
    job = outcome(teaching(tmp_path, trains(2, after, found=False)))
    assert job.state == "done" and job.text.startswith(text) and "Try: a longer time" in job.advice
    assert job.text.endswith("no solution was found in 60 s of search, so it trained on the level alone")
    assert job.proof is None and job.run is not None
    _, finetune, policy = job.command.split("\n")  # its successes may be a proof
    assert "imitation" not in finetune and "--method policy" in policy and "checkpoints/00000002" in policy


def test_where_training_alone_solves_it_the_proof_is_of_the_policy(tmp_path: Path) -> None:
    job = outcome(teaching(tmp_path, trains(2, 55, found=False, found_by_policy=True)))
    assert job.text.startswith("learned: 55 of 64") and job.proof is not None and not job.advice


def test_where_training_taught_nothing_the_solution_is_offered(tmp_path: Path) -> None:
    job = outcome(teaching(tmp_path, trains(0, 2)))
    steps = json.loads(PROOF.read_text())["num_steps"]
    assert job.text == (
        f"not learned: 2 of 64 attempts, 0 before; the solution that was found solves it in {steps} steps"
    )
    assert not job.learned and job.proof is not None and "play the proof" in job.advice


@pytest.mark.parametrize("found", [True, False])
def test_each_stage_is_named_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: bool) -> None:
    monkeypatch.setattr(teaching_module, "POLL_SECONDS", 0.01)
    stages: list[str] = []

    async def run() -> None:
        of = teaching(tmp_path, trains(2, 55, found=found, phase_seconds=0.4))
        job = await of.begin("teach", DOCUMENT, 60)
        while not job.is_over:
            if stages[-1:] != [job.stage]:
                stages.append(job.stage)
            await asyncio.sleep(0.01)

    run_in_time(run())
    imitating, proving = (["imitating"], []) if found else ([], ["proving"])
    expected = ["searching", "trying", *imitating, "compiling", "training", "evaluating", *proving]
    assert [stage for stage in stages if stage != "checking"] == expected


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (
            59,
            54,
            "generalist solves most of it already, and training changed nothing clear: 54 of 64 attempts, 59 before",
        ),
        (59, 30, "unlearned, generalist plays it better than what was trained: 30 of 64 attempts, 59 before"),
        (40, 60, "learned: 60 of 64 attempts, 40 before"),
    ],
)
def test_only_a_gain_by_more_than_chance_is_called_learned(tmp_path: Path, before: int, after: int, text: str) -> None:
    job = outcome(teaching(tmp_path, trains(before, after)))
    assert job.state == "done" and job.text.startswith(text), job.text


def test_what_the_policy_solves_already_is_not_trained_on(tmp_path: Path) -> None:
    began = time.monotonic()
    job = outcome(teaching(tmp_path, trains(63, 0, sleep=600)))
    assert time.monotonic() - began < 60
    assert job.text.startswith("generalist solves it already, without any training: 63 of 64")
    assert job.run is None and not job.files.run.exists() and job.proof is not None
    assert job.command.endswith("--run.imitation_steps 150 --run.stop_at 0.5")  # which was ended


def test_a_search_stores_a_proof_or_says_how_near_it_came(tmp_path: Path) -> None:
    job = outcome(teaching(tmp_path, trains(0, 0)), "solve")
    assert job.text.startswith("solved in ") and job.proof is not None and files_of(tmp_path) == {".json"}
    job = outcome(teaching(tmp_path, trains(0, 0, found=False)), "solve")
    assert job.text.startswith("not solved in 60 s; tried random") and job.proof is None and "Try:" in job.advice


def test_a_command_that_fails_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    script = "import sys; sys.exit('kinetix-dist: no space left on device')"
    for kind in ("teach", "solve"):
        job = outcome(teaching(tmp_path, script), kind)
        assert job.state == "failed" and "status 1: no space left on device" in job.text
    assert files_of(tmp_path) == set()


def test_cancelling_ends_it_within_seconds_and_leaves_nothing(tmp_path: Path) -> None:
    async def run() -> None:
        of = teaching(tmp_path, trains(3, 55, sleep=600))
        job = await of.begin("teach", DOCUMENT, 60)
        while not (job.files.run / "evaluations.jsonl").exists():
            await asyncio.sleep(0.02)
        with pytest.raises(BusyError, match="'hop_home' is being taught now"):
            await of.begin("solve", DOCUMENT, 60)
        began = time.monotonic()
        await of.cancel()
        assert time.monotonic() - began < 15 and job.state == "cancelled"
        assert files_of(tmp_path) == set()
        await of.cancel()  # nothing runs
        assert (await of.begin("solve", DOCUMENT, 60)).number == 2
        await of.cancel()

    run_in_time(run())


def test_results_of_the_same_second_do_not_overwrite_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda pattern: "20261129-120000")
    of = teaching(tmp_path, trains(0, 0))
    names = [outcome(of, "solve").files.level.name for _ in range(2)]
    assert names == ["hop_home-20261129-120000.json", "hop_home-20261129-120000-2.json"]


@pytest.mark.parametrize(
    ("checked", "text"),
    [
        ({"problems": [{"path": "shapes", "problem": "no shape is blue"}], "num_problems": 1}, "no shape is blue"),
        ({"facts": {"noop_solved_at": 40}}, "solves itself: without any action green reaches blue after 40 steps"),
        ({"warnings": [{"kind": "uncontrollable"}]}, "no action moves anything"),
    ],
)
def test_levels_that_cannot_be_taught_are_refused(tmp_path: Path, checked: dict[str, Any], text: str) -> None:
    of = teaching(tmp_path, "", Engine(**checked))
    with pytest.raises(TeachingError, match=text):
        asyncio.run(of.begin("teach", DOCUMENT, 60))
    assert of.job is None and not (tmp_path / "taught").exists()


def test_without_the_policy_only_a_search_is_possible(tmp_path: Path) -> None:
    engine = Engine()
    engine.pretrained = []
    of = teaching(tmp_path, trains(0, 0), engine)
    with pytest.raises(TeachingError, match="'generalist' is not installed"):
        asyncio.run(of.begin("teach", DOCUMENT, 60))
    assert outcome(of, "solve").proof is not None


@pytest.mark.parametrize(("kind", "seconds"), [("train", 60), ("teach", 59), ("teach", "60")])
def test_other_requests_are_refused(tmp_path: Path, kind: str, seconds: Any) -> None:
    with pytest.raises(TeachingError, match="give kind teach or solve, and seconds 60, 120, 300"):
        asyncio.run(teaching(tmp_path, "").begin(kind, DOCUMENT, seconds))


def test_names_of_files_are_plain() -> None:
    names = ["my level", "../../etc", "", "ä" * 3, "x" * 99]
    assert [file_name({"name": name}) for name in names] == ["my_level", "etc", "level", "level", "x" * 40]
    assert file_name({}) == "level"
