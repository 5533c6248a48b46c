"""Action spaces and the way from actions to motors and thrusters."""

from __future__ import annotations

import json
import os
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Controls
from kinetix_dist.env.action_spaces import ACTION_SPACES, ActionSpace
from kinetix_dist.env.action_spaces.space import controls_of
from tests.helpers import PATIENCE_S, REPOSITORY, present
from tests.kinetix_package import VARIABLE

MULTI_DISCRETE, CONTINUOUS, DISCRETE = (ACTION_SPACES[name] for name in ("multi_discrete", "continuous", "discrete"))
MOTOR_COLOUR = jnp.array([[0, 3, 3]])
MOTOR_AUTO = jnp.array([[False, False, False]])
THRUSTER_COLOUR = jnp.array([[1, 0]])


def controls(space: ActionSpace, action: object, auto: jax.Array = MOTOR_AUTO) -> tuple[Controls, jax.Array]:
    actions = jnp.asarray([action], space.dtype)
    return controls_of(space, actions, MOTOR_COLOUR, auto, THRUSTER_COLOUR)


def test_multi_discrete_actions_drive_everything_of_their_colour() -> None:
    result, num_invalid = controls(MULTI_DISCRETE, [1, 0, 0, 2, 0, 1])
    np.testing.assert_array_equal(result.motor, [[1, -1, -1]])
    np.testing.assert_array_equal(result.thruster, [[1, 0]])
    assert int(num_invalid[0]) == 0


def test_continuous_actions_pass_through() -> None:
    result, _ = controls(CONTINUOUS, [0.5, 0, 0, -0.25, 0.75, 0.0])
    np.testing.assert_allclose(result.motor, [[0.5, -0.25, -0.25]])
    np.testing.assert_allclose(result.thruster, [[0.0, 0.75]])


@pytest.mark.parametrize(
    ("action", "motor", "thruster"),
    [(0, [-1, 0, 0], [0, 0]), (7, [0, 1, 1], [0, 0]), (8, [0, 0, 0], [0, 0]), (9, [0, 0, 0], [0, 1])],
)
def test_a_discrete_action_drives_one_colour(action: int, motor: list[int], thruster: list[int]) -> None:
    result, _ = controls(DISCRETE, action)
    np.testing.assert_array_equal(result.motor, [motor])
    np.testing.assert_array_equal(result.thruster, [thruster])


# What `kinetix.environment.utils.convert_discrete_actions` of kinetix-env 3.0.2 makes of actions 0 to 10, for one motor
# of each colour and one thruster of each; `test_the_numbers_are_those_of_the_package_itself` asks it.
PACKAGE_DISCRETE = np.array(
    [
        [-1, 0, 0, 0, 0, 0],
        [1, 0, 0, 0, 0, 0],
        [0, -1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0],
        [0, 0, -1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 0, -1, 0, 0],
        [0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 1],
    ]
)


def test_discrete_actions_are_numbered_as_in_the_public_package() -> None:
    motor, thruster = DISCRETE.colour_values(jnp.arange(11), jnp.ones(11, bool))
    np.testing.assert_array_equal(jnp.concatenate([motor, thruster], axis=1), PACKAGE_DISCRETE)


def test_the_numbers_are_those_of_the_package_itself() -> None:
    if not (python := os.environ.get(VARIABLE)):
        pytest.skip(f"the public package is not here: set {VARIABLE} to a Python with kinetix-env 3.0.2")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    program = REPOSITORY / "bench" / "peers" / "kinetix_actions.py"
    ended = subprocess.run([python, str(program)], env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 0, ended.stderr[-2000:]
    np.testing.assert_array_equal(json.loads(ended.stdout), PACKAGE_DISCRETE)


def test_automatic_motors_run_forward_whatever_the_action() -> None:
    result, _ = controls(MULTI_DISCRETE, [2, 0, 0, 2, 0, 0], jnp.array([[True, False, True]]))
    np.testing.assert_array_equal(result.motor, [[1, -1, 1]])


@pytest.mark.parametrize(
    ("space", "action"),
    [(MULTI_DISCRETE, [3, 0, 0, -1, 0, 2]), (CONTINUOUS, [1.5, 0, 0, np.nan, 0, -0.5]), (DISCRETE, 11)],
)
def test_numbers_out_of_range_act_as_off_and_are_counted(space: ActionSpace, action: object) -> None:
    result, num_invalid = controls(space, action)
    assert not result.motor.any() and not result.thruster.any()
    assert int(num_invalid[0]) == (1 if space.is_flat else 3)


@pytest.mark.parametrize("space", [ACTION_SPACES[name] for name in ACTION_SPACES], ids=list(ACTION_SPACES))
def test_samples_and_noops_belong_to_their_space(space: ActionSpace) -> None:
    samples = space.sample(jax.random.key(0), 64)
    space.check(samples, 64)
    space.check(space.noop_actions(5), 5)
    result, _ = controls(space, space.noop_actions(1)[0])
    assert not result.motor.any() and not result.thruster.any()
    if space.is_integer:
        for column, high in zip(np.asarray(samples).reshape(64, -1).T, space.high):
            assert set(column) == set(range(int(high) + 1))


def test_head_sizes_are_those_of_the_paper() -> None:
    assert present(MULTI_DISCRETE.distribution).head_sizes == (3, 3, 3, 3, 2, 2)
    assert DISCRETE.noop == 8 and present(DISCRETE.distribution).head_sizes == (11,)
    assert present(CONTINUOUS.distribution).head_sizes == (6, 6)  # means and spreads


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 5), np.int32), r"shape \(2, 5\); multi_discrete actions of 2 worlds have \(2, 6\)"),
        (np.zeros((3, 6), np.int32), r"shape \(3, 6\)"),
        (np.zeros((2, 6), np.float32), "type float32; multi_discrete actions are integers"),
        (np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 3, 0, 0]], np.int32), r"action 3 at \[1, 3\].*dimension 3.*0 to 2"),
        (np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, -1]], np.int32), r"action -1 at \[1, 5\].*0 to 1"),
    ],
)
def test_bad_actions_are_refused_with_what_is_wrong(actions: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MULTI_DISCRETE.check(actions, 2)


def test_nan_is_not_a_continuous_action() -> None:
    with pytest.raises(ValueError, match="action nan"):
        CONTINUOUS.check(np.array([[np.nan, 0, 0, 0, 0, 0]], np.float32), 1)


def test_wrong_shapes_are_refused_inside_jit_too() -> None:
    def traced(actions: jax.Array) -> jax.Array:
        MULTI_DISCRETE.check(actions, 2)
        return actions

    with pytest.raises(ValueError, match="shape"):
        jax.jit(traced)(jnp.zeros((2, 5), jnp.int32))
    jax.jit(traced)(jnp.full((2, 6), 99))  # values are not known here; a step counts them instead


@pytest.mark.parametrize("name", ACTION_SPACES)
def test_numbers_of_an_action_have_names(name: str) -> None:
    space = ACTION_SPACES[name]
    assert len(space.action_names) == space.num_dimensions
    for action, high in zip(space.action_names, space.high):
        assert len(action.values) == (int(high) + 1 if space.is_integer else 0), action


@pytest.mark.parametrize(
    ("name", "dimension", "value", "words"),
    [
        ("multi_discrete", 1, 2.0, "motor colour 1: backward"),
        ("multi_discrete", 5, 1.0, "thruster colour 1: on"),
        ("continuous", 0, -0.25, "motor colour 0: -0.25"),
        ("discrete", 0, 3.0, "choice: motor colour 1 forward"),
        ("discrete", 0, 8.0, "choice: nothing"),
        ("discrete", 0, 10.0, "choice: thruster colour 1 on"),
    ],
)
def test_an_action_in_words_says_what_it_drives(name: str, dimension: int, value: float, words: str) -> None:
    assert ACTION_SPACES[name].action_names[dimension].words(value) == words
