"""A session: one world that is played step by step; all states are stored for seeking and taking over.

    session = Session(number, env_config, level, seed=0)       compiles
    session.set_actor(actor)                                       who plays from the shown state on
    session.step(); session.seek(12); session.frame()

The world is stepped by the environment of training: frame skip, time limit and solver are those of the run. A session
knows no threads and no clock; `session_loop.py` runs several.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jax2d.scene import stack_worlds
from kinetix_dist.env.action_spaces import MultiDiscrete
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState
from kinetix_dist.evaluation.policies import Player, first_memory
from kinetix_dist.level.goal_gap import goal_pairs
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, Level
from kinetix_dist.studio.worker import frames, programs
from kinetix_dist.studio.worker.wire import BAD_REQUEST, NOT_FOUND, RequestError

PERSON_SPACE = MultiDiscrete()  # what keys give, whatever the action space of the run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Actor:
    """Player of a session in its environment. `player` None: a person with keys, or actions given beforehand."""

    env: Environment  # with the action space that the player acts in
    player: Player | None
    about: dict[str, Any]  # for the client
    actions: np.ndarray | None = None  # [T, 6] one for each step from the start, nothing is done after them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moment:
    """State of the episode and the step that led to it."""

    env_state: EnvState
    obs: Any
    memory: Any  # of a policy, before it acts; None without one
    poses: np.ndarray
    motor: np.ndarray
    thruster: np.ndarray
    colours: np.ndarray
    reward: float = 0.0
    flags: int = 0
    seq: int = 0
    gap: float  # from the edge of green to that of blue, m
    choice: programs.Choice | None = None  # what the actor will do; None: a person, or the end
    shown: programs.Choice | None = None  # what is shown of it; at the end: of what the actor did last
    actor: Actor | None = None  # whose choice that is

    @property
    def is_done(self) -> bool:
        return bool(self.flags & frames.DONE)


class Session:
    """One world with its played states. Methods raise RequestError for what cannot be done."""

    def __init__(
        self, number: int, env_config: EnvConfig, level: Level, *, seed: int, turned_colours: np.ndarray | None = None
    ) -> None:
        """turned_colours: [4] bool, motor colours whose direction is reversed for a person, who goes by the document of
        the level; None: none."""
        self.number, self.seed = number, seed
        self._turned = np.zeros(NUM_MOTOR_COLOURS, bool) if turned_colours is None else turned_colours
        self.level = level
        self.person_env = programs.environment(dataclasses.replace(env_config, action_space=PERSON_SPACE.name))
        self.prepared = programs.prepare(self.person_env, stack_worlds([level]))
        programs.check_effects(self.prepared)
        env_state, obs = programs.reset(self.person_env, self.prepared)
        self._goal_pairs = goal_pairs(level)
        start_poses = np.asarray(programs.poses(self.person_env, self.prepared, env_state))[0]
        zeros = np.zeros(frames.NUM_COLOURS, np.float32)
        num_joints, num_thrusters = len(level.motor_colour), len(level.thruster_colour)
        self._start = Moment(
            env_state=env_state,
            obs=obs,
            memory=None,
            poses=start_poses,
            motor=np.zeros(num_joints, np.float32),
            thruster=np.zeros(num_thrusters, np.float32),
            colours=zeros,
            gap=self._gap(start_poses),
        )
        self.actor = Actor(env=self.person_env, player=None, about={"kind": "keys"})
        self.moments = [self._start]
        self.shown = 0  # index of the moment that is shown
        self.action = np.array(PERSON_SPACE.noop_actions(1), np.int32)  # [1, 6] what a person does
        self.seq = 0
        self.was_sought = False

    @property
    def last(self) -> int:
        """Number of played steps."""
        return len(self.moments) - 1

    @property
    def step_seconds(self) -> float:
        return float(self.person_env.engine.settings.dt * self.person_env.config.frame_skip)

    @property
    def num_outputs(self) -> int:
        player = self.actor.player
        return sum(programs.heads_of(player.policy)["sizes"]) if player is not None else 0

    @property
    def sizes(self) -> frames.FrameSizes:
        shapes, joints, thrusters = (len(x) for x in (self._start.poses, self._start.motor, self._start.thruster))
        return frames.FrameSizes(shapes=shapes, joints=joints, thrusters=thrusters, outputs=self.num_outputs)

    @property
    def is_at_end(self) -> bool:
        """True where the shown state ends the episode."""
        return self.moments[self.shown].is_done

    @property
    def outcome(self) -> str:
        """Outcome of an episode that is shown at its end: one of `recording.OUTCOMES`."""
        flags = self.moments[self.shown].flags
        named = ((frames.SOLVED, "solved"), (frames.FAILED, "failed"), (frames.UNSTABLE, "unstable"))
        return next((name for flag, name in named if flags & flag), "out of time")

    def set_actor(self, actor: Actor) -> None:
        """Sets who plays from the shown state on; later states are dropped.

        A policy with a memory starts without one.
        """
        if self.is_at_end:
            raise RequestError(BAD_REQUEST, "the episode is over; reset it, or seek a step before its end")
        self.actor = actor
        del self.moments[self.shown + 1 :]
        memory = None if actor.player is None else first_memory(actor.player.policy, 1)
        self.moments[self.shown] = self._with_choice(dataclasses.replace(self.moments[self.shown], memory=memory))
        self.was_sought = False

    def set_input(self, action: Any, seq: Any) -> None:
        """Sets the action of a person from now on. action: six whole numbers; seq: the client's number of it."""
        if type(seq) is not int or not 0 <= seq < 1 << 32:
            raise RequestError(BAD_REQUEST, f"seq is {seq!r}; give a whole number from 0 to {(1 << 32) - 1}")
        if not isinstance(action, list) or any(type(number) is not int for number in action):
            raise RequestError(BAD_REQUEST, f"action is {action!r}; give {PERSON_SPACE.num_dimensions} whole numbers")
        if len(action) != PERSON_SPACE.num_dimensions or any(abs(number) > 2 for number in action):
            raise RequestError(BAD_REQUEST, f"action is {action}; give four numbers 0 to 2 and two of 0 or 1")
        given = np.array([action], np.int32)
        try:
            PERSON_SPACE.check(given, 1)
        except ValueError as error:
            raise RequestError(BAD_REQUEST, str(error)) from error
        motors = given[:, :NUM_MOTOR_COLOURS]
        given[:, :NUM_MOTOR_COLOURS] = np.where(
            self._turned & (motors > 0), 3 - motors, motors
        )  # forward 1, backward 2
        self.action, self.seq = given, seq

    def step(self) -> bool:
        """Shows the next state: one that was played already, or a new one. False at the end of the episode."""
        if self.is_at_end:
            return False
        if self.shown == self.last:
            self.moments.append(self._play())
            self.was_sought = False
        self.shown += 1
        return True

    def seek(self, step: int) -> None:
        if not 0 <= step <= self.last:
            raise RequestError(NOT_FOUND, f"step {step} was not played; there are 0 to {self.last}")
        self.shown, self.was_sought = step, True

    def reset(self) -> None:
        """Back to the start of the level, with the same actor."""
        self.moments, self.shown = [self._start], 0
        self.set_actor(self.actor)

    def frame(self) -> bytes:
        """The state that is shown."""
        moment = self.moments[self.shown]
        again = frames.AGAIN if self.was_sought else 0
        shown = moment.shown if moment.actor is self.actor else None  # not the choice of another actor
        return frames.encode(
            frames.Frame(
                session=self.number,
                step=self.shown,
                poses=moment.poses,
                motor=moment.motor,
                thruster=moment.thruster,
                colours=moment.colours,
                outputs=np.zeros(0, np.float32) if shown is None else np.asarray(shown.outputs)[0],
                flags=moment.flags | again,
                seq=moment.seq,
                reward=moment.reward,
                total_reward=float(moment.env_state.episode_return[0]),
                value=0.0 if shown is None else float(shown.value[0]),
                gap=moment.gap,
            )
        )

    def _play(self) -> Moment:
        """State after the last one. One that has diverged has no positions: it repeats the last ones, with its flag."""
        moment, player = self.moments[-1], self.actor.player
        actions = self._given_action(moment) if moment.choice is None else moment.choice.actions
        stepped = programs.step(self.actor.env, self.prepared, moment.env_state, actions)
        # One transfer for what is shown; the state stays where it is.
        seen = jax.device_get(stepped._replace(env_state=None, obs=None))
        ended = ((frames.DONE, seen.done), (frames.SOLVED, seen.info.solved), (frames.FAILED, seen.info.failed))
        flags = sum(flag for flag, is_so in (*ended, (frames.UNSTABLE, seen.info.unstable)) if is_so[0])
        has_diverged = bool(flags & frames.UNSTABLE)
        after = Moment(
            env_state=stepped.env_state,
            obs=stepped.obs,
            memory=None if moment.choice is None else moment.choice.memory,
            poses=moment.poses if has_diverged else seen.poses[0],
            motor=seen.motor[0],
            thruster=seen.thruster[0],
            colours=seen.colours[0],
            reward=float(seen.reward[0]),
            flags=flags,
            seq=self.seq if player is None and self.actor.actions is None else 0,
            gap=moment.gap if has_diverged else self._gap(seen.poses[0]),
        )
        if after.is_done:
            return dataclasses.replace(after, shown=moment.choice, actor=self.actor)
        return self._with_choice(after)

    def _gap(self, poses: np.ndarray) -> float:
        return float(programs.gap(self._goal_pairs, poses))

    def _given_action(self, moment: Moment) -> np.ndarray:
        """[1, 6] of a person, or of the actions that the actor was given for this step."""
        given = self.actor.actions
        if given is None:
            return self.action
        step = int(moment.env_state.num_steps[0])
        return given[step : step + 1] if step < len(given) else np.array(PERSON_SPACE.noop_actions(1), np.int32)

    def warm_up(self, actor: Actor) -> None:
        """Compiles what an actor needs to play here; changes nothing, so that any thread may call it."""
        start = self._start
        if actor.player is not None:
            memory = first_memory(actor.player.policy, 1)
            jax.block_until_ready(self._choice(actor, actor.player, dataclasses.replace(start, memory=memory)))
        actions = actor.env.action_space.noop_actions(1)
        jax.block_until_ready(programs.step(actor.env, self.prepared, start.env_state, actions))

    def _with_choice(self, moment: Moment) -> Moment:
        """Moment with the choice of the actor in it."""
        player = self.actor.player
        choice = None if player is None else self._choice(self.actor, player, moment)
        return dataclasses.replace(moment, choice=choice, shown=choice, actor=self.actor)

    def _choice(self, actor: Actor, player: Player, moment: Moment) -> programs.Choice:
        """Choice of a policy, drawn by the number of the state and the seed alone.

        Raises RequestError for a network whose outputs are not finite.
        """
        step = int(moment.env_state.num_steps[0])
        given = programs.PolicyInput(obs=moment.obs, memory=moment.memory, seed=self.seed, step=step)
        choice = programs.choose(actor.env, player.policy, player.params, self.prepared, given)
        if not (np.isfinite(choice.value).all() and np.isfinite(choice.outputs).all()):
            raise RequestError(BAD_REQUEST, "the policy answers with numbers that are not finite; choose another one")
        return choice
