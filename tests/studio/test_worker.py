"""The engine worker as a process: sessions, pictures, snapshots, recordings, and malformed requests."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
import struct
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from bench.worker_client import Client
from jax2d.scene import stack_worlds
from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.installation import data_directory
from kinetix_dist.level.kinetix_format import export_kinetix
from kinetix_dist.level.level import Level, Role
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import read_proof
from kinetix_dist.level.schema import load_level
from kinetix_dist.studio.worker import frames, programs, wire
from kinetix_dist.studio.worker.session import Session
from kinetix_dist.studio.worker.wire import RequestError
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, LEVELS, REFRESH
from kinetix_dist.telemetry.curriculum_log import write_snapshot as write_snapshot_file
from kinetix_dist.telemetry.sinks.mcap import McapSink
from tests.helpers import PATIENCE_S

NAME = "s/hop_home"


def document(name: str = NAME) -> dict[str, Any]:
    return json.loads((levels_root() / f"{name}.json").read_text())


# An attempt that goes on until it is cancelled: the pendulum hangs still.
LONG = {
    "level": {"document": document("s/swing_up")},
    "policy": "noop",
    "attempts": 1,
    "env": {"max_steps": 1_000_000},
}


def level(name: str = NAME) -> Level:
    return load_level(levels_root() / f"{name}.json")[0]


def test_actions_are_played_as_they_are_and_a_proof_solves_its_level(worker: Client) -> None:
    proof = read_proof(levels_root() / "proofs" / f"{NAME}.json")
    policy = {"actions": proof.actions.tolist()}
    session = worker.request("play.open", level={"document": document()}, policy=policy)
    assert session["policy"] == {"kind": "actions"} and session["sizes"]["outputs"] == 0
    state = worker.request("play.control", session=session["session"], do="step", steps=1000)
    assert state["step"] == proof.num_steps
    [end] = [message.content for message in worker.others if message.content["type"] == "play.end"]
    assert end["outcome"] == "solved"
    worker.others.clear()


def test_after_the_last_of_the_actions_nothing_is_done(worker: Client) -> None:
    def end_of(policy: Any) -> tuple[int, str]:
        session = worker.request("play.open", level={"document": document()}, policy=policy)["session"]
        step = worker.request("play.control", session=session, do="step", steps=1000)["step"]
        [end] = [message.content for message in worker.others if message.content["type"] == "play.end"]
        worker.others.clear()
        return step, end["outcome"]

    assert end_of({"actions": [[0] * 6]}) == end_of("noop")


def opened(worker: Client, **fields: Any) -> dict[str, Any]:
    answer = worker.request("play.open", **({"level": {"document": document()}} | fields))
    worker.others.clear()
    return answer


def close(worker: Client, session: dict[str, Any]) -> None:
    worker.request("play.close", session=session["session"])
    worker.others.clear()


def refused(worker: Client, kind: str, **fields: Any) -> RequestError:
    with pytest.raises(RequestError) as error:
        worker.request(kind, **fields)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400
    return error.value


# Sessions


def test_keys_of_a_stored_proof_solve_its_level_bit_for_bit(worker: Client) -> None:
    actions = read_proof(levels_root() / "proofs" / f"{NAME}.json").actions
    mine = Session(1, EnvConfig(size="s"), level(), seed=0)
    session = worker.request("play.open", level={"document": document()})
    first = worker.frame(session["sizes"])
    assert first.step == 0
    np.testing.assert_array_equal(first.poses[:, :2], level().position)
    for number, action in enumerate(actions.tolist()):
        worker.send_only("play.input", session=session["session"], seq=number + 1, action=action)
        state = worker.request("play.control", session=session["session"], do="step")
        mine.set_input(action, number + 1)
        mine.step()
        mine.number = session["session"]
        assert worker.other("frame").body == mine.frame()
        assert state["step"] == number + 1
    end = worker.other("play.end").content
    assert (end["outcome"], end["step"], end["session"]) == ("solved", len(actions), session["session"])
    [green], [blue] = (np.flatnonzero(level().shape_role == role) for role in (Role.GREEN, Role.BLUE))
    apart = np.linalg.norm(level().position[green] - level().position[blue])
    assert end["return"] == pytest.approx(1 + 0.1 * apart, abs=0.1)  # the dense reward is 0.1 for each metre of centres
    assert first.gap == pytest.approx(mine.moments[0].gap) and apart > first.gap > mine.moments[-1].gap
    close(worker, session)


def test_keys_drive_a_level_as_its_file_says_where_the_level_is_turned_round(worker: Client) -> None:
    """drag_cart has a negative speed: forward is to the right, in its level backward is."""
    bar = document("s/drag_cart")["shapes"][0]["position"][0]
    for action, way in ((1, 1), (2, -1)):
        session = opened(worker, level={"document": document("s/drag_cart")})
        worker.send_only("play.input", session=session["session"], seq=1, action=[action, 0, 0, 0, 0, 0])
        worker.request("play.control", session=session["session"], do="step", steps=8)
        while (frame := worker.frame(session["sizes"])).step < 8:
            pass
        x = frame.poses[:, 0]
        assert np.sign(x[np.argmin(np.abs(level("s/drag_cart").position[:, 0] - bar))] - bar) == way
        close(worker, session)


def test_a_session_says_what_drives_what_and_how_it_is_stepped(worker: Client, tmp_path: Path) -> None:
    config = json.loads((data_directory("pretrained") / "generalist" / "checkpoint.json").read_text())["config"]
    config["env"] |= {"frame_skip": 4, "max_steps": 99}
    (tmp_path / "config.json").write_text(json.dumps({"hash": "0", "config": config}))  # as RunDirectory writes it
    session = opened(worker, level={"document": document("m/rocket_car")}, env={"run": str(tmp_path)})
    source = document("m/rocket_car")
    assert [motor["colour"] for motor in session["motors"]] == [
        joint["motor"].get("colour", 0) for joint in source["joints"] if "motor" in joint
    ]
    assert [thruster["colour"] for thruster in session["thrusters"]] == [
        thruster.get("colour", 0) for thruster in source["thrusters"]
    ]
    assert (session["frame_skip"], session["max_steps"], session["size"]) == (4, 99, "m")
    assert session["step_seconds"] == pytest.approx(4 / 60)
    assert session["exact"] and session["policy"] == {"kind": "keys"}
    assert session["display"]["num_shapes"] == session["sizes"]["shapes"]
    close(worker, session)


def test_a_running_session_keeps_time_and_pauses(worker: Client) -> None:
    # 30 steps a second at most: a busy machine loses some, none are made up for.
    began = time.monotonic()
    session = opened(worker, env={"max_steps": 10_000}, running=True)
    number = session["session"]
    while worker.request("play.control", session=number, do="speed", speed=1)["step"] < 5:
        assert time.monotonic() - began < PATIENCE_S
        time.sleep(0.1)
    state = worker.request("play.control", session=number, do="pause")
    assert state["step"] <= 30 * (time.monotonic() - began) + 1 and not state["running"]
    time.sleep(0.3)
    assert worker.request("play.control", session=number, do="pause")["step"] == state["step"]
    worker.request("play.control", session=number, do="speed", speed=1 / 64)
    began = time.monotonic()
    worker.request("play.control", session=number, do="run")
    time.sleep(0.5)
    slow = worker.request("play.control", session=number, do="pause")["step"] - state["step"]
    assert slow <= 30 / 64 * (time.monotonic() - began) + 1
    steps = [frames.HEADER.unpack_from(m.body)[3] for m in worker.others if m.content["type"] == "frame"]
    assert steps == sorted(steps)
    close(worker, session)


def test_seek_step_reset_and_take_over(worker: Client) -> None:
    session = opened(worker, policy="random", seed=3)
    number = session["session"]
    control = lambda do, **fields: worker.request("play.control", session=number, do=do, **fields)  # noqa: E731
    assert control("step", steps=20)["step"] == 20
    sought = control("seek", step=5)
    assert (sought["step"], sought["last"], sought["running"]) == (5, 20, False)
    assert control("step")["step"] == 6 and control("step")["last"] == 20
    taken = control("take_over")
    assert (taken["step"], taken["last"], taken["policy"]) == (7, 7, {"kind": "keys"})
    taken = control("take_over", policy={"checkpoint": "generalist"})
    assert taken["policy"]["num_updates"] > 0 and taken["sizes"]["outputs"] == 16
    worker.others.clear()
    control("step")
    frame = worker.frame(taken["sizes"])
    assert frame.step == 8 and np.isfinite(frame.value)
    assert control("reset")["last"] == 0
    close(worker, session)


def test_four_sessions_at_once_and_no_fifth(worker: Client) -> None:
    sessions = [opened(worker) for _ in range(4)]
    assert refused(worker, "play.open", level={"document": document()}).code == wire.BUSY
    for session in sessions:
        close(worker, session)
    assert refused(worker, "play.control", session=sessions[0]["session"], do="run").code == wire.NOT_FOUND


@pytest.mark.long
def test_a_slow_client_loses_frames_but_neither_order_nor_replies(tmp_path: Path) -> None:
    client = Client(log=tmp_path / "log")
    answer = client.request("play.open", level={"document": document("l/walker")}, env={"max_steps": 100_000})
    number = answer["session"]
    client.request("play.control", session=number, do="speed", speed=8.0)
    client.request("play.control", session=number, do="run")
    client.hold()
    client.send_only("play.control", id=10_000, session=number, do="run")  # its answer wakes the reader a last time
    time.sleep(4.0)  # 240 steps of 276 bytes a second: more than the pipe holds
    client.send_only("play.control", id=10_001, session=number, do="pause")
    time.sleep(0.5)
    client.read_on()
    state = client.wait(10_001).content
    while not any(
        m.content["type"] == "frame" and frames.HEADER.unpack_from(m.body)[3] == state["step"] for m in client.others
    ):
        assert client.take(10)
    steps = [frames.HEADER.unpack_from(m.body)[3] for m in client.others if m.content["type"] == "frame"]
    assert steps == sorted(set(steps))
    assert len(steps) < state["step"], "nothing was left out: was the client slow?"
    assert client.close() == 0


# Levels that come as arrays


def write_snapshot(run: Path, levels: Level, *, thinned: bool = False) -> None:
    run.mkdir(exist_ok=True)
    arrays = {} if thinned else {LEVELS + name: array for name, array in flatten_arrays(levels).items()}
    write_snapshot_file(run / DIRECTORY, REFRESH, 128, {"size": np.str_("s"), **arrays})


def test_a_level_of_a_snapshot_is_played_from_its_own_arrays(worker: Client, tmp_path: Path) -> None:
    one = level()
    # An angle that no document gives: one ulp off what is derived again.
    turned = dataclasses.replace(one, angle=np.nextafter(one.angle, np.float32(1)))
    write_snapshot(tmp_path, stack_worlds([one, turned]))
    given = {"run": str(tmp_path), "refresh": 128, "index": 1}
    session = worker.request("play.open", level=given, policy="random", seed=2)
    np.testing.assert_array_equal(worker.frame(session["sizes"]).poses[:, 2], turned.angle)
    env = programs.environment(EnvConfig(size="s"))
    player = Player(RandomPolicy(env.action_space))
    (rollout,) = record_rollouts(env, player, stack_worlds([turned]), jax.random.key(2))
    worker.request("play.control", session=session["session"], do="step", steps=20)
    np.testing.assert_array_equal(worker.frame(session["sizes"]).poses[:, :2], rollout.position[20])
    close(worker, session)
    answer = worker.wait(worker.send("thumbnails", run=str(tmp_path), refresh=128, indices=[1, 0, 1]))
    entries = json.loads(answer.body)
    assert [entry["index"] for entry in entries] == [1, 0, 1] and answer.content["count"] == 3
    assert entries[1]["display"] == worker.request("display", level={"document": document()})["display"]
    assert worker.request("document", level=given)["document"]["size"] == "s"


def test_snapshots_that_cannot_be_read_are_one_line(worker: Client, tmp_path: Path) -> None:
    def error_of(run: Path, **given: Any) -> RequestError:
        return refused(worker, "display", level={"run": str(run), "refresh": 128, "index": 0} | given)

    assert error_of(tmp_path / "none").code == wire.NOT_FOUND
    write_snapshot(tmp_path / "thin", stack_worlds([level()]), thinned=True)
    assert "holds no levels" in str(error_of(tmp_path / "thin"))
    answer = worker.wait(worker.send("thumbnails", run=str(tmp_path / "thin"), refresh=128, indices=[0]))
    assert answer.body == b"[]" and answer.content["count"] == 0
    write_snapshot(tmp_path / "whole", stack_worlds([level()]))
    assert "0 to 0" in str(error_of(tmp_path / "whole", index=1))
    file = tmp_path / "whole" / "curriculum" / "refresh_00000128.npz"
    data = file.read_bytes()
    for damaged in (b"", b"garbage", data[: len(data) // 2], data[:300] + bytes(50) + data[350:]):
        file.write_bytes(damaged)
        assert error_of(tmp_path / "whole").code in (wire.NOT_FOUND, wire.BAD_REQUEST)
    draws = np.random.default_rng(0)
    for _ in range(40):
        flipped = bytearray(data)
        flipped[int(draws.integers(len(data)))] ^= 1 << int(draws.integers(8))
        file.write_bytes(flipped)
        try:
            worker.request("display", level={"run": str(tmp_path / "whole"), "refresh": 128, "index": 0})
        except RequestError as error:
            assert error.code in (wire.NOT_FOUND, wire.BAD_REQUEST), error
    file.write_bytes(data)
    assert worker.request("display", level={"run": str(tmp_path / "whole"), "refresh": 128, "index": 0})["size"] == "s"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "a.mcap"
    env = programs.environment(EnvConfig(size="s"))
    player = Player(RandomPolicy(env.action_space))
    levels = stack_worlds([level("s/hop_home"), level("s/kick")])
    rollouts = record_rollouts(env, player, levels, jax.random.key(1), names=["hop", "kick"], seed=1)
    with McapSink(path, max_queued=2, on_event=lambda name, fields: pytest.fail(f"{name} {fields}")) as sink:
        for rollout in rollouts:
            sink.write(rollout)
    return path


def test_recordings_are_shown_as_they_are_stored(worker: Client, recording: Path) -> None:
    from kinetix_dist.evaluation.recordings import read_rollouts

    listed = worker.request("recordings", file=str(recording))
    assert [rollout["name"] for rollout in listed["rollouts"]] == ["hop", "kick"] and not listed["problems"]
    stored = read_rollouts(recording).rollouts[1]
    message = worker.wait(worker.send("recording", file=str(recording), index=1))
    values, start = np.frombuffer(message.body, "<f4"), 0
    arrays = {}
    for name, shape in message.content["arrays"]:
        count = int(np.prod(shape))
        arrays[name], start = values[start : start + count].reshape(shape), start + count
    assert start == len(values)
    np.testing.assert_array_equal(arrays["poses"][..., :2], stored.position)
    np.testing.assert_array_equal(arrays["poses"][..., 2], stored.angle)
    for name in ("velocity", "angular_velocity", "actions", "motor", "thruster", "reward"):
        np.testing.assert_array_equal(arrays[name], getattr(stored, name))
    assert message.content["outcome"] == stored.outcome
    # Taking over in the middle simulates anew, from the state that was stored.
    session = worker.request("play.open", level={"recording": str(recording), "index": 1, "step": 10})
    np.testing.assert_array_equal(worker.frame(session["sizes"]).poses[:, :2], stored.position[10])
    assert not session["exact"]
    close(worker, session)


def test_damaged_recordings_are_one_line(worker: Client, recording: Path, tmp_path: Path) -> None:
    assert refused(worker, "recordings", file=str(tmp_path / "none.mcap")).code == wire.NOT_FOUND
    (tmp_path / "b.mcap").write_bytes(b"garbage")
    assert "no MCAP file" in str(refused(worker, "recordings", file=str(tmp_path / "b.mcap")))
    data = recording.read_bytes()
    (tmp_path / "c.mcap").write_bytes(data[: len(data) * 3 // 4])
    cut = worker.request("recordings", file=str(tmp_path / "c.mcap"))
    assert len(cut["problems"]) == 1 and "\n" not in cut["problems"][0]
    assert refused(worker, "recording", file=str(recording), index=2).code == wire.NOT_FOUND
    level_at = {"recording": str(recording), "index": 0, "step": 10_000}
    assert refused(worker, "display", level=level_at).code == wire.NOT_FOUND


# Policies and attempts


def make_run(path: Path, *updates: int) -> Path:
    for number in updates:
        shutil.copytree(data_directory("pretrained") / "generalist", path / "checkpoints" / f"{number:08d}")
    return path


def test_the_newest_good_checkpoint_of_a_run_plays(worker: Client, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 10, 20)
    session = opened(worker, policy={"run": str(run)})
    assert session["policy"]["path"].endswith("00000020") and not session["policy"]["skipped"]
    close(worker, session)
    (run / "checkpoints" / "00000020" / "checkpoint.json").write_text("{}")
    session = opened(worker, policy={"run": str(run)})
    assert session["policy"]["path"].endswith("00000010") and len(session["policy"]["skipped"]) == 1
    close(worker, session)
    shutil.rmtree(run / "checkpoints")
    assert "no checkpoint" in str(
        refused(worker, "play.open", level={"document": document()}, policy={"run": str(run)})
    )


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.2])
def test_a_checkpoint_that_is_pruned_while_it_is_read_is_skipped(
    worker: Client, tmp_path: Path, seconds: float
) -> None:
    run = make_run(tmp_path / "run", 10, 20)
    request = worker.send("play.open", level={"document": document()}, policy={"run": str(run)})
    time.sleep(seconds)
    shutil.rmtree(run / "checkpoints" / "00000020")
    session = worker.wait(request).content
    assert session["policy"]["path"][-2:] in ("10", "20")
    close(worker, session)


def test_attempts_report_progress_and_end_when_cancelled(worker: Client) -> None:
    level_given = {"document": document()}
    request = worker.send("attempts", level=level_given, policy="random", attempts=64, seed=5)
    answer = worker.wait(request).content
    progress = worker.progress[request]
    assert [p["stage"] for p in progress[:2]] == ["compiling", "playing"]
    assert progress[-1]["done"] == progress[-1]["total"] == 64 and progress[-1]["solved"] == answer["solved"]
    assert answer["p"] == answer["solved"] / 64 and answer["low"] <= answer["p"] <= answer["high"]
    pairs = answer["attempts"] * (answer["attempts"] - 1)  # s (n - s) / (n (n - 1)) has the mean p (1 - p)
    assert answer["learnability"] == pytest.approx(answer["solved"] * (answer["attempts"] - answer["solved"]) / pairs)
    assert sum(answer[name] for name in ("solved", "failed", "timed_out", "unstable")) == 64
    running, waiting = worker.send("attempts", **LONG), worker.send("attempts", **LONG)
    while not any(p["stage"] == "playing" for p in worker.progress.get(running, ())):
        worker.take()
    # Sessions and checks go on meanwhile.
    assert worker.request("check", document=document(), play=False)["problems"] == []
    for request in (waiting, running):
        worker.send_only("cancel", id=request)
    for request in (running, waiting):
        with pytest.raises(RequestError) as error:
            worker.wait(request, seconds=30)
        assert error.value.code == wire.CANCELLED
    worker.send_only("cancel", id=running)  # of what has ended: nothing
    worker.send_only("cancel", id="x")


# Requests of an editor


def test_a_check_gives_all_problems_or_warnings_facts_and_a_picture(worker: Client) -> None:
    good = worker.request("check", document=document())
    assert good["problems"] == [] and good["warnings"] == [] and good["facts"]["noop_solved_at"] is None
    assert good["display"]["primitives"] and len(good["poses"]) == good["display"]["num_shapes"]
    bad = document()
    bad["shapes"][0] |= {"density": float("nan"), "role": "pink"}
    bad["gravity"] = [0]
    worker.send_raw(60_000, {"type": "check", "document": bad})
    found = worker.wait(60_000).content
    assert sorted(problem["path"] for problem in found["problems"]) == [
        "gravity",
        "shapes[0].density",
        "shapes[0].role",
    ]
    assert found["display"] is None and found["facts"] is None


@pytest.mark.parametrize("given", [None, 3, [], "x", {}, {"shapes": [{}] * 10_000}, {"shapes": [None] * 900}])
def test_a_check_of_what_is_no_level_names_problems_quickly(worker: Client, given: Any) -> None:
    begin = time.monotonic()
    found = worker.request("check", document=given)
    assert found["num_problems"] >= len(found["problems"]) > 0 and len(found["problems"]) <= 200
    assert time.monotonic() - begin < 10


def test_documents_are_converted_both_ways(worker: Client) -> None:
    public = worker.request("convert", document=document(), to="public")["document"]
    assert public == json.loads(json.dumps(export_kinetix(level())))
    ours = worker.request("convert", document=public, to="kinetix-dist")["document"]
    assert [shape["type"] for shape in ours["shapes"]] == ["polygon", "circle", "circle"]
    assert worker.request("check", document=ours, play=False)["problems"] == []
    (problem,) = worker.request("check", document=public)["problems"]
    assert "public package" in problem["problem"]


def test_a_mutator_changes_a_document_and_it_stays_valid(worker: Client) -> None:
    found = [worker.request("mutate", document=document(), mutator="swap_roles", seed=seed) for seed in range(4)]
    assert any(answer["changed"] for answer in found)
    for answer in found:
        assert worker.request("check", document=answer["document"], play=False)["problems"] == []
        assert answer["changed"] or answer["document"] == document()


@pytest.mark.slow  # the generator compiles for half a minute
def test_generated_levels_are_valid_and_follow_their_seed(worker: Client) -> None:
    one, two, again = (worker.request("generate", size="s", seed=seed, count=3)["documents"] for seed in (0, 1, 0))
    assert one == again and one != two and len(one) == 3
    for made in one + two:
        assert worker.request("check", document=made, play=False)["problems"] == []
    changed = [worker.request("mutate", document=one[0], mutator=None, changes=3, seed=seed) for seed in range(3)]
    assert any(answer["changed"] for answer in changed)


# What makes no sense

BAD_REQUESTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "unknown type": ("dance", {}, "there is no request 'dance'"),
    "no level": ("play.open", {}, "level is"),
    "empty level": ("play.open", {"level": {}}, "none of"),
    "wrong level": ("play.open", {"level": {"document": {"size": "s"}}}, "is missing"),
    "relative path": ("display", {"level": {"run": "runs/a", "refresh": 0, "index": 0}}, "absolute path"),
    "index of no number": ("display", {"level": {"run": "/a", "refresh": 0, "index": "1"}}, "level.index"),
    "unknown policy": ("play.open", {"level": {"document": document()}, "policy": "clever"}, "policy is 'clever'"),
    "no checkpoint": (
        "play.open",
        {"level": {"document": document()}, "policy": {"checkpoint": "nobody"}},
        "there is no checkpoint nobody; pretrained policies here",
    ),
    "no run": ("play.open", {"level": {"document": document()}, "policy": {"run": "/nowhere"}}, "not a directory"),
    "unknown field of env": ("play.open", {"level": {"document": document()}, "env": {"size": "l"}}, "env has 'size'"),
    "unknown preset": ("play.open", {"level": {"document": document()}, "env": {"preset": "x"}}, "env: "),
    "unknown reward": (
        "play.open",
        {"level": {"document": document()}, "env": {"reward": "x"}},
        "env: EnvConfig.reward is 'x'; choose one of dense, sparse, shaped",
    ),
    "no steps": (
        "play.open",
        {"level": {"document": document()}, "env": {"max_steps": 0}},
        "it must be from 1 to 1000000",
    ),
    "steps of text": ("play.open", {"level": {"document": document()}, "env": {"max_steps": "9"}}, "give a number"),
    "negative seed": ("play.open", {"level": {"document": document()}, "seed": -1}, "seed is -1"),
    "not running": ("play.open", {"level": {"document": document()}, "running": 1}, "true or false"),
    "no session": ("play.control", {"do": "run"}, "session is None"),
    "closed session": ("play.control", {"session": 999, "do": "run"}, "there is no session 999"),
    "keys do not attempt": ("attempts", {"level": {"document": document()}, "policy": "keys"}, "policy is keys"),
    "too many attempts": ("attempts", {"level": {"document": document()}, "attempts": 10**9}, "from 1 to 1024"),
    "convert to what": ("convert", {"document": document(), "to": "svg"}, "to is 'svg'"),
    "unknown mutator": ("mutate", {"document": document(), "mutator": "x"}, "mutator is 'x'"),
    "unknown generator": ("generate", {"size": "s", "generator": "x"}, "generator is 'x'"),
    "unknown mechanism": ("mechanism", {"mechanism": "x", "size": "m"}, "mechanism is 'x'"),
    "unknown size": ("generate", {"size": "xl"}, "size is 'xl'"),
    "no indices": ("thumbnails", {"run": "/a", "refresh": 0, "indices": "all"}, "indices"),
}


@pytest.mark.parametrize("case", BAD_REQUESTS)
def test_a_request_that_makes_no_sense_is_one_line(worker: Client, case: str) -> None:
    kind, fields, text = BAD_REQUESTS[case]
    error = refused(worker, kind, **fields)
    assert text in str(error) and error.code in (wire.BAD_REQUEST, wire.NOT_FOUND)


def test_controls_that_make_no_sense_are_one_line(worker: Client) -> None:
    session = opened(worker)
    number = session["session"]
    for fields, text in (
        ({"do": "fly"}, "do is 'fly'"),
        ({"do": "seek", "step": 3}, "step 3 was not played"),
        ({"do": "seek"}, "step is missing"),
        ({"do": "speed", "speed": 100}, "speed is 100"),
        ({"do": "speed", "speed": float("nan")}, "speed is nan"),
        ({"do": "step", "steps": 0}, "steps is 0"),
        ({"do": "take_over", "policy": {"checkpoint": "nobody"}}, "there is no checkpoint"),
    ):
        worker.send_raw(50_000, {"type": "play.control", "session": number, **fields})
        with pytest.raises(RequestError, match=text):
            worker.wait(50_000)
    worker.send_only("play.input", session=number, seq=1, action=[9] * 6)
    assert "four numbers" in worker.other("error").content["text"]
    close(worker, session)


def test_an_id_twice_and_too_many_requests_are_refused(worker: Client) -> None:
    requests = [worker.send("attempts", **LONG) for _ in range(16)]
    assert refused(worker, "check", document=document()).code == wire.BUSY
    worker.send_only("attempts", id=requests[0], **LONG)
    with pytest.raises(RequestError, match="in use"):
        worker.wait(requests[0])
    for request in requests:
        worker.send_only("cancel", id=request)
    for request in requests:
        with pytest.raises(RequestError, match="cancelled"):
            worker.wait(request)


def test_bytes_that_are_no_message_are_said_and_skipped(worker: Client) -> None:
    worker.write(struct.pack("<II", 9, 5) + b"nojsn")
    assert worker.other("error").content["code"] == wire.BAD_REQUEST
    size = wire.MAX_MESSAGE_BYTES + 1
    worker.write(struct.pack("<I", size))
    for start in itertools.count(0, 1 << 20):
        if start >= size:
            break
        worker.write(bytes(min(1 << 20, size - start)))
    assert worker.other("error").content["code"] == wire.TOO_LARGE
    assert worker.request("check", document=document(), play=False)["problems"] == []


def test_the_greeting_says_what_there_is(worker: Client) -> None:
    assert worker.hello["version"] == 1 and worker.hello["pid"] == worker.process.pid
    assert {"generalist"} <= set(worker.hello["pretrained"]) and "default" in worker.hello["generators"]
    assert worker.hello["palette"]["role_palette"][1] == [70, 178, 98]
    assert worker.hello["sizes"]["s"] == {"polygons": 1, "circles": 2, "joints": 1, "thrusters": 1}
