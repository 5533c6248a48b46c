"""Requests that play: sessions, and attempts at a level."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np

from kinetix_dist.env.env_config import describe
from kinetix_dist.evaluation.learnability import unbiased_learnability
from kinetix_dist.evaluation.policies import distinct_attempts
from kinetix_dist.level.level import Level
from kinetix_dist.level.schema import turned_colours_of
from kinetix_dist.program_cache import compile_seconds
from kinetix_dist.studio.worker.attempts import MAX_ATTEMPTS, Progress, play_attempts
from kinetix_dist.studio.worker.level_requests import MAX_SEED, Answer, display_of
from kinetix_dist.studio.worker.levels import level_of
from kinetix_dist.studio.worker.request import KEYS, Request, env_of, policy_of
from kinetix_dist.studio.worker.session import Actor, Session
from kinetix_dist.studio.worker.session_loop import MAX_SPEED, MIN_SPEED, Running, SessionLoop
from kinetix_dist.studio.worker.wire import BAD_REQUEST, RequestError

MAX_STEPS_AT_ONCE = 1_000_000
MAX_SESSION = 0xFFFF
CONTROLS = ("run", "pause", "step", "seek", "speed", "reset", "take_over")


def open_session(request: Request, loop: SessionLoop) -> tuple[Session, dict[str, Any]]:
    """Opens a session that is not in the loop yet; returns it with its reply. Compiles."""
    begin, compiled_before = time.monotonic(), compile_seconds()
    given = level_of(request.fields.get("level"))
    policy = policy_of(request.fields.get("policy", KEYS))
    seed = request.number("seed", low=0, high=MAX_SEED, default=0)
    env_config = env_of(request.fields.get("env"), given.info.size, policy.trained)
    number = loop.reserve()
    try:
        request.progress("compiling")
        turned = None if given.document is None else turned_colours_of(given.document)
        session = Session(number, env_config, given.level, seed=seed, turned_colours=turned)
        actor = policy.actor(env_config, given.level)
        session.warm_up(actor)
        session.set_actor(actor)
        request.check_cancelled()
    except BaseException:
        loop.cancel_reservation()
        raise
    level, config = given.level, session.person_env.config
    answer = {
        "session": number,
        "size": given.info.size,
        "name": given.info.name,
        "display": display_of(given),
        **_about_actor(session),
        **_drives(level),
        "max_steps": config.max_steps,
        "frame_skip": config.frame_skip,
        "preset": describe(config.physics),
        "step_seconds": session.step_seconds,
        "exact": given.is_exact,
        "seconds": time.monotonic() - begin,
        "compile_seconds": compile_seconds() - compiled_before,
    }
    return session, answer


def _about_actor(session: Session) -> dict[str, Any]:
    return {"policy": session.actor.about, "sizes": dataclasses.asdict(session.sizes)}


def _drives(level: Level) -> dict[str, Any]:
    """Motors and thrusters with the colours that drive them, for keys shown next to them."""
    joints, thrusters = level.scene.joints, level.scene.thrusters
    motors = np.flatnonzero(np.asarray(joints.active) & np.asarray(joints.motor_on)).tolist()
    return {
        "motors": [
            {"joint": k, "colour": int(level.motor_colour[k]), "auto": bool(level.motor_auto[k])} for k in motors
        ],
        "thrusters": [
            {"thruster": k, "colour": int(level.thruster_colour[k])}
            for k in np.flatnonzero(np.asarray(thrusters.active)).tolist()
        ],
    }


Command = Callable[[Running], dict[str, Any]]


def control(request: Request, loop: SessionLoop, loading: Executor) -> tuple[Command, Future[Any] | None]:
    """Command for the loop that controls a session and returns the reply, and the future it waits for."""
    do = request.choice("do", CONTROLS)
    if do == "take_over":
        session = loop.session(request.number("session", low=0, high=MAX_SESSION))
        loaded = loading.submit(_load_actor, request.fields.get("policy", KEYS), session)
        return lambda running: _take_over(running, loaded, loop), loaded
    if do == "step":
        steps = request.number("steps", low=1, high=MAX_STEPS_AT_ONCE, default=1)
        return lambda running: _step(running, steps, loop), None
    if do == "seek":
        step = request.number("step", low=0, high=MAX_STEPS_AT_ONCE)
        return lambda running: _show(running, loop, lambda: running.session.seek(step)), None
    if do == "speed":
        speed = request.real("speed", low=MIN_SPEED, high=MAX_SPEED)
        return lambda running: _set_speed(running, speed), None
    if do == "reset":
        return lambda running: _show(running, loop, running.session.reset), None
    return lambda running: _run(running, do == "run"), None


def _state(running: Running) -> dict[str, Any]:
    session = running.session
    return {
        "session": session.number,
        "step": session.shown,
        "last": session.last,
        "running": running.is_running,
    }


def _run(running: Running, is_running: bool) -> dict[str, Any]:
    running.run(is_running)
    return _state(running)


def _set_speed(running: Running, speed: float) -> dict[str, Any]:
    running.speed = speed
    running.run(running.is_running)
    return _state(running)


def _step(running: Running, steps: int, loop: SessionLoop) -> dict[str, Any]:
    running.is_running = False
    moved = False
    for _ in range(steps):
        if not running.session.step():
            break
        moved = True
    loop.show(running)
    if moved:
        loop.end_if_over(running)
    return _state(running)


def _show(running: Running, loop: SessionLoop, change: Callable[[], None]) -> dict[str, Any]:
    change()
    running.is_running = False
    loop.show(running)
    return _state(running)


def _load_actor(given: Any, session: Session) -> Actor:
    """Loads and compiles an actor for a session: the loop must not wait for that."""
    actor = policy_of(given).actor(session.person_env.config, session.level)
    session.warm_up(actor)
    return actor


def _take_over(running: Running, loaded: Future[Actor], loop: SessionLoop) -> dict[str, Any]:
    running.session.set_actor(loaded.result())
    loop.show(running)
    return _state(running) | _about_actor(running.session)


def attempts(request: Request) -> Answer:
    """Plays attempts at a level, with progress; ends where it is cancelled."""
    begin, compiled_before = time.monotonic(), compile_seconds()
    num_attempts = request.number("attempts", low=1, high=MAX_ATTEMPTS, default=64)
    seed = request.number("seed", low=0, high=MAX_SEED, default=0)
    given = level_of(request.fields.get("level"))
    policy = policy_of(request.fields.get("policy"))
    env_config = env_of(request.fields.get("env"), given.info.size, policy.trained)
    request.progress("compiling", done=0, total=num_attempts, solved=0)
    actor = policy.actor(env_config, given.level)
    if actor.player is None:
        raise RequestError(BAD_REQUEST, f"attempts: policy is {policy.kind}; give one that plays alone")
    num_attempts = distinct_attempts(actor.player.policy, num_attempts)

    def report(progress: Progress) -> None:
        request.progress("playing", done=progress.num_finished, total=num_attempts, solved=progress.num_solved)

    rate = play_attempts(actor.env, actor.player, given.level, attempts=num_attempts, seed=seed, report=report)
    [learnability] = unbiased_learnability(np.array([rate.solved]), np.array([rate.attempts])).tolist()
    return {
        "attempts": rate.attempts,
        "solved": rate.solved,
        "failed": rate.failed,
        "timed_out": rate.timed_out,
        "unstable": rate.unstable,
        "p": rate.rate,
        "low": rate.low,
        "high": rate.high,
        "learnability": learnability if np.isfinite(learnability) else None,
        "mean_return": rate.mean_return,
        "mean_length": rate.mean_length,
        "policy": actor.about,
        "seconds": time.monotonic() - begin,
        "compile_seconds": compile_seconds() - compiled_before,
    }, b""
