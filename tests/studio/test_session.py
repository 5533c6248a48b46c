"""Sessions against the environment of training: bit for bit, for every player, also after seeking and taking over."""

from __future__ import annotations

import dataclasses
import functools
import json
from typing import Any

import jax
import numpy as np
import pytest

from jax2d.scene import stack_worlds
from kinetix_dist.env.action_spaces.continuous import Continuous
from kinetix_dist.env.action_spaces.discrete import Discrete
from kinetix_dist.env.action_spaces.multi_discrete import MultiDiscrete
from kinetix_dist.env.action_spaces.space import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import read_proof
from kinetix_dist.level.schema import load_level, turned_colours_of
from kinetix_dist.studio.worker import frames, programs
from kinetix_dist.studio.worker.attempts import Progress, play_attempts, steps_until_noop_solves
from kinetix_dist.studio.worker.levels import level_of
from kinetix_dist.studio.worker.request import policy_of
from kinetix_dist.studio.worker.session import Session
from kinetix_dist.studio.worker.wire import RequestError

NAME = "s/hop_home"
CONFIG = EnvConfig(size="s")


@functools.cache
def level() -> Level:
    return load_level(levels_root() / f"{NAME}.json")[0]


@functools.cache
def actions() -> np.ndarray:
    return read_proof(levels_root() / "proofs" / f"{NAME}.json").actions


def shown(session: Session) -> frames.Frame:
    return frames.decode(session.frame(), session.sizes)


def play(session: Session, given: np.ndarray) -> list[bytes]:
    """Frames of a person's actions."""
    found = []
    for number, action in enumerate(given):
        session.set_input(action.tolist(), number + 1)
        session.step()
        found.append(session.frame())
    return found


@functools.cache
def environment_frames() -> list[tuple[np.ndarray, float, bool, bool]]:
    """(poses, reward, done, solved) of the proof, by `Environment.step` alone; the last pose by `bodies_after`."""
    env = programs.environment(CONFIG)
    prepared = env.prepare(stack_worlds([level()]))
    state, _ = env.reset(prepared)
    found = []
    for action in actions():
        state, _, reward, done, info = env.step(prepared, state, action[None])
        position, angle, *_ = env.engine.bodies(state.packed_state)
        poses = np.concatenate([np.asarray(position)[0], np.asarray(angle)[0][:, None]], axis=-1)
        found.append((poses, float(reward[0]), bool(done[0]), bool(info.solved[0])))
    return found


def test_frames_are_the_environments_bit_for_bit_and_a_proof_solves_its_level() -> None:
    session = Session(1, CONFIG, level(), seed=0)
    found = [frames.decode(frame, session.sizes) for frame in play(session, actions())]
    assert len(found) == len(environment_frames())
    for number, (frame, (poses, reward, done, solved)) in enumerate(zip(found, environment_frames())):
        assert (frame.step, frame.seq) == (number + 1, number + 1)
        assert frame.reward == pytest.approx(reward, abs=1e-6)  # XLA fuses the distance in other ways
        assert (bool(frame.flags & frames.DONE), bool(frame.flags & frames.SOLVED)) == (done, solved)
        if not done:  # the environment has started again
            np.testing.assert_array_equal(frame.poses, poses)
    assert found[-1].flags == frames.DONE | frames.SOLVED
    assert session.outcome == "solved" and not session.step()
    assert found[-1].total_reward == pytest.approx(sum(reward for _, reward, _, _ in environment_frames()), abs=1e-4)


def test_seeking_and_playing_on_gives_the_same_bytes() -> None:
    session = Session(1, CONFIG, level(), seed=0)
    first = play(session, actions())
    half = len(actions()) // 2
    session.seek(half)
    assert shown(session).flags & frames.AGAIN and shown(session).step == half
    again = []
    while session.step():
        again.append(shown(session).poses)
    np.testing.assert_array_equal(again, [frames.decode(one, session.sizes).poses for one in first[half:]])
    # Taking over at the same step drops later steps; the same actions give the same bytes.
    session.seek(half)
    session.set_actor(session.actor)
    assert session.last == half
    rest = play(session, actions()[half:])
    sizes = session.sizes
    for one, other in zip(rest, first[half:]):
        ours, theirs = frames.decode(one, sizes), frames.decode(other, sizes)
        np.testing.assert_array_equal(ours.poses, theirs.poses)
        assert (ours.reward, ours.total_reward, ours.flags) == (theirs.reward, theirs.total_reward, theirs.flags)


def test_a_person_drives_a_level_as_its_file_says_where_the_level_is_turned_round() -> None:
    """drag_cart has a negative speed, so that forward is to the right; its level has a positive one."""
    document = json.loads((levels_root() / "s" / "drag_cart.json").read_text())
    given = level_of({"document": document})
    session = Session(1, CONFIG, given.level, seed=0, turned_colours=turned_colours_of(document))
    bar = document["shapes"][0]["position"][0]
    slot = int(np.flatnonzero(np.isclose(given.level.position[:, 0], bar))[0])
    for action, way in ((1, 1), (2, -1)):
        session.reset()
        frame = frames.decode(play(session, np.array([[action, 0, 0, 0, 0, 0]] * 8))[-1], session.sizes)
        assert np.sign(frame.poses[slot, 0] - bar) == way


def test_other_actions_after_taking_over_lead_elsewhere() -> None:
    session = Session(1, CONFIG, level(), seed=0)
    first = frames.decode(play(session, actions()[:20])[-1], session.sizes)
    session.seek(10)
    session.set_actor(session.actor)
    other = frames.decode(play(session, np.zeros_like(actions()[:10]))[-1], session.sizes)
    assert other.step == first.step
    assert not np.array_equal(other.poses, first.poses)


def test_random_actions_are_those_of_recorded_rollouts() -> None:
    session = Session(1, CONFIG, level(), seed=7)
    actor = policy_of("random").actor(CONFIG, level())
    session.set_actor(actor)
    env = programs.environment(CONFIG)
    player = Player(RandomPolicy(env.action_space))
    (rollout,) = record_rollouts(env, player, stack_worlds([level()]), jax.random.key(7))
    for step in range(1, rollout.num_steps + 1):
        assert session.step()
        frame = shown(session)
        np.testing.assert_array_equal(frame.poses[:, :2], rollout.position[step])
        np.testing.assert_array_equal(frame.thruster, rollout.thruster[step - 1])
    assert session.outcome == rollout.outcome


def test_a_checkpoint_plays_as_in_recorded_rollouts_and_says_its_probabilities() -> None:
    given = policy_of({"checkpoint": "generalist"})
    assert given.trained is not None
    config = given.trained.env_config("s")
    session = Session(1, config, level(), seed=3)
    session.set_actor(given.actor(config, level()))
    env = session.actor.env
    player = session.actor.player
    assert player is not None
    (rollout,) = record_rollouts(env, player, stack_worlds([level()]), jax.random.key(3))
    for step in range(1, 41):
        frame = shown(session)
        heads = np.split(frame.outputs, np.cumsum([3, 3, 3, 3, 2]))
        np.testing.assert_allclose([head.sum() for head in heads], 1.0, atol=1e-5)
        assert np.isfinite(frame.value)
        assert session.step()
        np.testing.assert_array_equal(shown(session).poses[:, :2], rollout.position[step])
    # A person goes on from here, in the same world.
    session.set_actor(policy_of("keys").actor(config, level()))
    assert shown(session).value == 0 and session.sizes.outputs == 0
    session.seek(5)
    assert len(shown(session).outputs) == 0, "that is not what a person made of it"
    session.seek(40)
    np.testing.assert_array_equal(shown(session).poses[:, :2], rollout.position[40])
    assert session.step() and shown(session).step == 41


def test_at_the_end_a_policys_last_values_stay() -> None:
    given = policy_of({"checkpoint": "generalist"})
    assert given.trained is not None
    config = dataclasses.replace(given.trained.env_config("s"), max_steps=3)
    session = Session(1, config, level(), seed=3)
    session.set_actor(given.actor(config, level()))
    played = [shown(session)]
    while session.step():
        played.append(shown(session))
    assert [bool(frame.flags & frames.DONE) for frame in played] == [False, False, False, True]
    np.testing.assert_array_equal(played[-1].outputs, played[-2].outputs)
    assert played[-1].value == played[-2].value != played[0].value


def test_a_world_that_diverges_keeps_the_places_that_it_had(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(1, CONFIG, level(), seed=0)
    session.step()
    before = shown(session)

    def diverged(*args: Any) -> programs.Stepped:
        found = step(*args)
        yes = np.ones(1, bool)
        return found._replace(
            poses=np.full_like(found.poses, np.nan),
            env_state=dataclasses.replace(found.env_state, distance=np.full(1, np.nan)),
            done=yes,
            info=dataclasses.replace(found.info, unstable=yes),
        )

    step = programs.step
    monkeypatch.setattr(programs, "step", diverged)
    session.step()
    after = shown(session)
    assert after.flags == frames.DONE | frames.UNSTABLE and session.outcome == "unstable"
    np.testing.assert_array_equal(after.poses, before.poses)
    assert after.gap == before.gap > 0


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (MultiDiscrete(), [[c, v] for c in range(4) for v in (0, 1, -1)] + [[c, v] for c in (4, 5) for v in (0, 1)]),
        (Discrete(), [[c, v] for c in range(4) for v in (-1, 1)] + [[None, 0], [4, 1], [5, 1]]),
        (Continuous(), [[c, None] for c in range(6)] * 2),
    ],
)
def test_outputs_of_a_policy_say_which_colour_they_are_about(space: ActionSpace, expected: list) -> None:
    assert [*map(list, programs.controls_of_outputs(space))] == expected
    assert space.distribution is not None and len(expected) == sum(space.distribution.head_sizes)


def test_a_policy_that_gives_no_numbers_is_an_error_and_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(1, CONFIG, level(), seed=0)
    actor = policy_of("random").actor(CONFIG, level())
    choose = programs.choose
    monkeypatch.setattr(programs, "choose", lambda *args: choose(*args)._replace(value=np.full(1, np.nan)))
    with pytest.raises(RequestError, match="numbers that are not finite; choose another"):
        session.set_actor(actor)


def test_reset_plays_the_same_episode_again() -> None:
    session = Session(1, CONFIG, level(), seed=1)
    session.set_actor(policy_of("random").actor(CONFIG, level()))
    runs = []
    for _ in range(2):
        for _ in range(10):
            session.step()
        runs.append(session.frame())
        session.reset()
        assert (session.shown, session.last) == (0, 0)
    assert runs[0] == runs[1]


@pytest.mark.long
def test_programs_that_were_forgotten_are_compiled_again_and_give_the_same() -> None:
    session = Session(1, CONFIG, level(), seed=1)
    session.set_actor(policy_of("random").actor(CONFIG, level()))
    session.step()
    before = session.frame()
    programs.release_programs()
    again = Session(1, CONFIG, level(), seed=1)
    again.set_actor(policy_of("random").actor(CONFIG, level()))
    again.step()
    assert again.frame() == before


@pytest.mark.parametrize(
    ("action", "seq", "what"),
    [
        ([0, 0, 0, 0, 0], 1, "four numbers"),
        ([0, 0, 0, 0, 0, 2], 1, "out of range"),
        ([0, 0, 0, 10**30, 0, 0], 1, "four numbers"),
        ([0, 0, 0, 0.5, 0, 0], 1, "whole numbers"),
        ([True] * 6, 1, "whole numbers"),
        ("up", 1, "whole numbers"),
        ([0] * 6, -1, "seq"),
        ([0] * 6, 2**32, "seq"),
        ([0] * 6, None, "seq"),
    ],
)
def test_an_input_that_is_none_is_one_line_and_changes_nothing(action: object, seq: object, what: str) -> None:
    session = Session(1, CONFIG, level(), seed=0)
    with pytest.raises(RequestError, match=what):
        session.set_input(action, seq)
    assert session.seq == 0 and not session.action.any()


def test_steps_that_were_not_played_cannot_be_sought() -> None:
    session = Session(1, CONFIG, level(), seed=0)
    session.step()
    for step in (-1, 2):
        with pytest.raises(RequestError, match="0 to 1"):
            session.seek(step)


def test_an_episode_that_is_over_cannot_be_taken_over() -> None:
    session = Session(1, EnvConfig(size="s", max_steps=2), level(), seed=0)
    assert session.step() and session.step() and not session.step()
    assert session.outcome == "out of time"
    with pytest.raises(RequestError, match="over"):
        session.set_actor(session.actor)
    session.seek(1)
    session.set_actor(session.actor)
    assert session.step()


def test_attempts_are_those_of_an_evaluation() -> None:
    env = programs.environment(CONFIG)
    player = Player(RandomPolicy(env.action_space))
    seen: list[Progress] = []
    rate = play_attempts(env, player, level(), attempts=64, seed=5, report=seen.append)
    expected = evaluate(env, player, stack_worlds([level()]), attempts=64, key=jax.random.key(5)).levels[0]
    for name in ("solved", "failed", "timed_out", "attempts", "low", "high", "mean_length"):
        assert getattr(rate, name) == getattr(expected, name)
    assert rate.mean_return == pytest.approx(expected.mean_return, abs=1e-5)
    assert seen[-1].num_finished == 64 and seen[-1].num_solved == rate.solved
    finished = [progress.num_finished for progress in seen]
    assert finished == sorted(finished) and len(seen) > 3


def test_what_report_raises_ends_the_attempts() -> None:
    env = programs.environment(CONFIG)

    def stop(progress: Progress) -> None:
        raise RequestError("cancelled", f"after {progress.num_steps}")

    with pytest.raises(RequestError, match="after 8"):
        play_attempts(env, Player(RandomPolicy(env.action_space)), level(), attempts=64, seed=5, report=stop)


def test_a_level_that_solves_itself_says_when() -> None:
    env = programs.environment(CONFIG)
    assert steps_until_noop_solves(env, level()) is None
    position = level().position.copy()
    green, blue = (int(np.flatnonzero(level().shape_role == role)[0]) for role in (1, 2))
    position[green] = position[blue] + np.asarray([0.0, 1.2], np.float32)
    solved_at = steps_until_noop_solves(env, dataclasses.replace(level(), position=position))
    assert solved_at is not None and 5 < solved_at < 60


def test_a_level_that_calls_for_what_no_size_has_is_refused() -> None:
    """Environments are made without bodies on rails; nothing of such a level may be left out without a word."""
    scene = level().scene
    kinematic = np.ones_like(scene.shapes.kinematic)
    given = dataclasses.replace(
        level(), scene=dataclasses.replace(scene, shapes=dataclasses.replace(scene.shapes, kinematic=kinematic))
    )
    with pytest.raises(RequestError, match="kinematic"):
        Session(1, CONFIG, given, seed=0)
    env = programs.environment(CONFIG)
    with pytest.raises(RequestError, match="kinematic"):
        play_attempts(
            env, Player(RandomPolicy(env.action_space)), given, attempts=2, seed=0, report=lambda progress: None
        )
