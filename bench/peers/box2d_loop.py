"""Box2D 2.3 in an RL loop: its worlds as gymnasium environments, in one process or a process each.

    python box2d_loop.py IN.json OUT.json      scenes as bench/rl_loop.py writes them, steps per second as it reads them

Episodes are reset after `max_steps`; reward and outcome are left out, which favours Box2D. Like `box2d_motions.py`,
whose worlds these are, this file uses nothing of the project.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from typing import Any

import gymnasium
import numpy as np
from box2d_motions import World
from vector_loop import steps_per_second

VELOCITY_ITERATIONS, POSITION_ITERATIONS = 8, 3  # advice of its manual


class Box2DWorld(gymnasium.Env[np.ndarray, np.ndarray]):
    """One scene. Observation: position, angle and velocities of all shapes; actions: each motor and thruster."""

    def __init__(self, request: dict[str, Any], scenes: dict[str, np.ndarray], index: int) -> None:
        self.request, self.scenes, self.index = request, scenes, index
        self._make()
        size = self.world.num_shapes * 6
        num_actions = max(1, len(scenes["scene.joints.active"][0]) + len(scenes["scene.thrusters.active"][0]))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (num_actions,), np.float32)

    def _make(self) -> None:
        self.num_steps = 0
        self.world = World(self.scenes, self.index, self.request["constants"])
        self.motors = [joint for joint in self.world.joints if hasattr(joint, "motorSpeed")]
        self.speeds = [joint.motorSpeed for joint in self.motors]
        self.thrusts = self.world.thrusts

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._make()
        return self._observed(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        for joint, speed, value in zip(self.motors, self.speeds, action):
            joint.motorSpeed = speed * float(value)
        pushes = action[len(self.motors) :]
        self.world.thrusts = [(*rest, force * float(value)) for (*rest, force), value in zip(self.thrusts, pushes)]
        for _ in range(self.request["frame_skip"]):
            self.world.step(self.request["dt"], VELOCITY_ITERATIONS, POSITION_ITERATIONS)
        self.num_steps += 1
        return self._observed(), 0.0, False, self.num_steps >= self.request["max_steps"], {}

    def _observed(self) -> np.ndarray:
        return self.world.state().reshape(-1).astype(np.float32)


def engine_alone(request: dict[str, Any], scenes: dict[str, np.ndarray], num_worlds: int) -> list[float]:
    """Environment steps per second of worlds that are stepped without observation, policy and resets."""
    worlds = [World(scenes, i % len(scenes["control"]), request["constants"]) for i in range(num_worlds)]
    found, num_steps = [], request["num_steps"]
    for _ in range(request["repeats"] + 1):
        began = time.perf_counter()
        for _ in range(num_steps * request["frame_skip"]):
            for world in worlds:
                world.step(request["dt"], VELOCITY_ITERATIONS, POSITION_ITERATIONS)
        found.append(num_worlds * num_steps / (time.perf_counter() - began))
    return found[1:]


def main() -> int:
    with open(sys.argv[1]) as file:
        request = json.load(file)
    scenes = dict(np.load(request["scenes"]))
    records = []
    for num_worlds in request["worlds"]:
        indices = [i % len(scenes["control"]) for i in range(num_worlds)]
        makers = [functools.partial(Box2DWorld, request, scenes, index) for index in indices]
        kinds = {
            "engine": None,
            "gymnasium": gymnasium.vector.SyncVectorEnv,
            "workers": gymnasium.vector.AsyncVectorEnv,
        }
        for kind, vector in kinds.items():
            if kind == "workers" and num_worlds > request["max_workers"]:
                continue
            if vector is None:
                found = engine_alone(request, scenes, num_worlds)
            else:
                envs = vector(makers)
                found = steps_per_second(envs, request["num_steps"], request["repeats"])
                envs.close()
            records.append({"loop": kind, "worlds": num_worlds, "env_steps_per_second": found})
    with open(sys.argv[2], "w") as file:
        json.dump(records, file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
