"""Processes forked after JAX has started: JAX would wait for ever in them, so that each call raises one line."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable

import gymnasium
import jax
import numpy as np
import pytest

import kinetix_dist as kd
from jax2d import Capacity, Engine, SceneBuilder, after_fork
from jax2d.after_fork import ForkedProcessError
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.wrappers.gymnasium_env import KinetixEnv, KinetixVectorEnv
from kinetix_dist.gymnasium_envs import IDS
from tests.helpers import PATIENCE_S, REPOSITORY

CAPACITY = Capacity(polygons=1, circles=1, joints=0, thrusters=0)
FLAT = EnvConfig(observation="flat", max_steps=8)


def outcome_in_fork(call: Callable[[], object]) -> str:
    """Return what `call` raises in a forked child, or "returned". Fails if it waits for ever."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def report() -> None:
        try:
            call()
        except ForkedProcessError as error:
            sender.send(str(error))
        else:
            sender.send("returned")

    child = context.Process(target=report)
    child.start()
    try:
        assert receiver.poll(PATIENCE_S), "it waits for ever"
        return receiver.recv()
    finally:
        child.kill()
        child.join()


@pytest.fixture(scope="module")
def calls() -> dict[str, Callable[[], object]]:
    """Calls that run JAX, on objects that the child inherits or makes."""
    builder = SceneBuilder(CAPACITY)
    builder.add_circle(radius=0.1)
    world, engine = builder.build(), Engine(CAPACITY)
    state = engine.initial_state(*world)
    levels = jax.tree.map(np.asarray, kd.load_level_set("designed_s")[0])
    env = kd.make("s", levels="designed_s")
    played = env.reset(jax.random.key(0))[1]
    single = KinetixEnv(FLAT, levels)
    vector = KinetixVectorEnv(FLAT, levels, num_envs=2)
    vector.reset(seed=0)
    policy = kd.load_policy("generalist")
    space = Environment(policy.env_config).observation_space
    observation = jax.tree.map(lambda x: np.zeros((1, *x.shape), x.dtype), space)
    key = jax.random.key(0)
    return {
        "Engine": lambda: Engine(CAPACITY),
        "Engine.initial_state": lambda: engine.initial_state(*world),
        "Engine.step": lambda: engine.step(world.scene, state),
        "Environment.prepare": lambda: env.environment.prepare(levels),
        "draw": lambda: kd.draw(env, played),
        "make": lambda: kd.make("s"),
        "load_level_set": lambda: kd.load_level_set("random_s", num_levels=1),
        "load_policy": lambda: kd.load_policy("generalist"),
        "BatchedEnv.reset": lambda: env.reset(key),
        "PolicyFunction": lambda: policy(observation, key),
        "KinetixEnv.reset": lambda: single.reset(seed=0),
        "KinetixVectorEnv": lambda: KinetixVectorEnv(FLAT, levels, num_envs=3),
        "KinetixVectorEnv.reset": lambda: vector.reset(seed=0),
        "KinetixVectorEnv.step": lambda: vector.step(np.zeros((2, 6), int)),
        "reset of a KinetixEnv made there": lambda: KinetixEnv(FLAT, levels).reset(),
    }


def test_each_call_raises_one_line_that_names_the_remedy(calls: dict[str, Callable[[], object]]):
    outcomes = {name: outcome_in_fork(call) for name, call in calls.items()}
    assert outcomes == dict.fromkeys(calls, after_fork.REMEDY)
    assert 'vector_kwargs={"context": "spawn"}' in after_fork.REMEDY and "\n" not in after_fork.REMEDY


def test_workers_of_gymnasium_report_it_to_their_parent():
    envs = gymnasium.make_vec(
        IDS["s"], num_envs=2, vectorization_mode="async", levels="designed_s", observation="flat", max_steps=8
    )
    with pytest.raises(ForkedProcessError, match='context": "spawn"'):
        envs.reset(seed=0)
    envs.close(terminate=True)


@pytest.mark.long
def test_workers_that_are_spawned_play(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "import gymnasium\nfrom kinetix_dist.gymnasium_envs import IDS\n"
        "if __name__ == '__main__':\n"
        "    envs = gymnasium.make_vec(IDS['s'], num_envs=2, vectorization_mode='async', levels='designed_s',\n"
        "                              observation='flat', vector_kwargs={'context': 'spawn'})\n"
        "    envs.reset(seed=0)\n"
        "    print(envs.step(envs.action_space.sample())[1].shape)\n"
        "    envs.close()\n"
    )
    assert output_of(str(program)) == "(2,)"


def test_only_a_start_of_jax_before_the_fork_counts():
    """Also if the child alone imports the engine."""
    program = (
        "import os, jax\n"
        "def fork(label):\n"
        "    pid = os.fork()\n"
        "    if pid == 0:\n"
        "        from jax2d import after_fork\n"
        "        print(label, after_fork.is_forked(), flush=True)\n"
        "        os._exit(0)\n"
        "    os.waitpid(pid, 0)\n"
        "fork('not started')\n"
        "jax.devices()\n"
        "fork('imported by the child')\n"
        "from jax2d import after_fork\n"
        "fork('imported before')\n"
        "print('parent', after_fork.is_forked())\n"
    )
    assert output_of("-W", "ignore", "-c", program).splitlines() == [
        "not started False",
        "imported by the child True",
        "imported before True",
        "parent False",
    ]


def output_of(*arguments: str) -> str:
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        cwd=REPOSITORY,
        check=True,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    ).stdout.strip()


def test_a_fork_while_jax_starts_waits_for_nothing():
    """The child inherits a lock that nobody releases; it counts as started."""
    program = (
        "import os, jax\n"
        "from jax._src import xla_bridge\n"
        "from jax2d import after_fork\n"
        "with xla_bridge._backend_lock:\n"
        "    pid = os.fork()\n"
        "    if pid == 0:\n"
        "        print(after_fork.is_forked(), flush=True)\n"
        "        os._exit(0)\n"
        "    os.waitpid(pid, 0)\n"
    )
    assert output_of("-W", "ignore", "-c", program) == "True"
