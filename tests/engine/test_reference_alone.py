"""Features of the reference in plain JAX alone: derivatives, and contacts solved in batches."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, Controls, Engine, SceneBuilder, State, preset
from kinetix_dist.level.level import SIZES

ARM = Capacity(polygons=3, circles=1, joints=1, thrusters=1)


def outcome(name: str) -> Any:
    """`f(x, scene, state, weights)` in float64, a sum over what 20 steps lead to."""
    one = Engine(ARM, settings=preset(name), backend="xla", dtype=jnp.float64)

    def value(x: dict[str, jax.Array], scene: Any, state: State, weights: dict[str, jax.Array]) -> jax.Array:
        state = dataclasses.replace(state, **{k: v for k, v in x.items() if k not in ("motor", "thruster")})
        end, _ = one.step(scene, state, Controls(motor=x["motor"], thruster=x["thruster"]), num_steps=20)
        return jnp.asarray(sum(jnp.sum(weight * getattr(end, field)) for field, weight in weights.items()))

    return value


@functools.cache
def value_and_slope(name: str) -> Any:
    """`f(x, direction, scene, state, weights) -> (value, its derivative along a direction)`, in forward mode, whose
    program compiles in a minute; that of `gradient` takes up to several."""
    value = outcome(name)

    @jax.jit
    def forward(x: dict, direction: dict, scene: Any, state: State, weights: dict) -> Any:
        return jax.jvp(lambda x: value(x, scene, state, weights), (x,), (direction,))

    return forward


@functools.cache
def gradient(name: str) -> Any:
    """`f(x, scene, state, weights)`, in reverse mode."""
    return jax.jit(jax.grad(outcome(name)))


def slopes_along(name: str, x: dict, field: str, indices: Iterable[Any], *rest: Any) -> Iterator[float]:
    """Derivatives that `gradient` should give for these numbers of a field, one by one in forward mode."""
    nothing = jax.tree.map(jnp.zeros_like, x)
    for index in indices:
        along = nothing | {field: nothing[field].at[index].set(1.0)}
        yield float(value_and_slope(name)(x, along, *rest)[1])


def gradient_case(b: SceneBuilder, name: str, motor: float, thruster: float) -> tuple[dict, Any, State, dict]:
    one, world = Engine(ARM, settings=preset(name), backend="xla", dtype=jnp.float64), b.build()
    state = one.initial_state(*world)
    fields = ("position", "angle", "velocity", "angular_velocity")
    x = {field: getattr(state, field) for field in fields}
    x |= {"motor": jnp.array([motor], jnp.float64), "thruster": jnp.array([thruster], jnp.float64)}
    rng = np.random.default_rng(3)
    weights = {field: jnp.asarray(rng.standard_normal(getattr(state, field).shape)) for field in fields}
    return x, world.scene, state, weights


def arm_and_ball() -> tuple[SceneBuilder, int, int]:
    """A driven arm, and a ball with a thruster that rolls on a floor: no event in 20 steps. (builder, arm, ball)."""
    b = SceneBuilder(ARM)
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True)
    base = b.add_box(width=0.2, height=0.2, position=(0, 3), fixed=True)
    link = b.add_box(width=1.0, height=0.2, position=(0.5, 3))
    ball = b.add_circle(radius=0.3, position=(3, 0.2995), velocity=(1.0, 0.0), angular_velocity=-3.0)
    b.add_revolute_joint(base, link, at=(0, 3), motor_speed=0.2, motor_power=1.0, limits=(-3, 3))
    b.add_thruster(ball, at=(3.1, 0.2995), angle=0.5, power=0.05)
    return b, link, ball


def corners() -> SceneBuilder:
    """Bodies at rest, coincident centres, no speed, no friction."""
    b = SceneBuilder(ARM, gravity=(0, 0))
    b.add_box(width=1, height=1, friction=0.0)
    b.add_box(width=1, height=1, position=(0, 1))
    b.add_box(width=1, height=1, position=(0, 0.4))
    b.add_circle(radius=0.3, position=(0, 0))
    return b


# Derivatives of `standard` compile for a minute and more, those of `paper` in a quarter of that.
BOTH_SOLVERS = pytest.mark.parametrize("name", ["paper", pytest.param("standard", marks=pytest.mark.slow)])


@BOTH_SOLVERS
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    """Checks forward mode; `test_reverse_mode_is_forward_mode` has the other."""
    b, link, ball = arm_and_ball()
    with jax.enable_x64(True):
        case = gradient_case(b, name, motor=0.4, thruster=0.5)
        x, rest = case[0], case[1:]
        nothing = jax.tree.map(jnp.zeros_like, x)
        for field, index in (
            ("motor", 0),
            ("thruster", 0),
            ("angle", link),
            ("velocity", (ball, 0)),
            ("position", (ball, 0)),
            ("angular_velocity", ball),
        ):
            step = 1e-6
            moved = [x | {field: x[field].at[index].add(d)} for d in (step, -step)]
            ends = [value_and_slope(name)(there, nothing, *rest)[0] for there in moved]
            slope = float(ends[0] - ends[1]) / (2 * step)
            (forwards,) = slopes_along(name, x, field, [index], *rest)
            # Of a difference of 1e-6: rounding 1e-16 / 1e-6, curvature 1e-12.
            assert forwards == pytest.approx(slope, rel=1e-6, abs=1e-7), (field, index)
            assert abs(slope) > 1e-3, (field, index)


@BOTH_SOLVERS
def test_derivatives_are_finite_where_the_maths_has_corners(name: str) -> None:
    """Roots of zero must not give infinite slopes: along a direction in which all moves, any of them would show."""
    rng = np.random.default_rng(4)
    with jax.enable_x64(True):
        x, *rest = gradient_case(corners(), name, motor=0.0, thruster=0.0)
        for _ in range(2):
            direction = {field: jnp.asarray(rng.uniform(0.5, 1.0, value.shape)) for field, value in x.items()}
            assert np.isfinite(value_and_slope(name)(x, direction, *rest)[1])


@pytest.mark.long
@BOTH_SOLVERS
def test_reverse_mode_is_forward_mode(name: str) -> None:
    """Modes agree where the maths has corners, too: there a branch not taken gives reverse mode 0 times infinity, if
    let."""
    with jax.enable_x64(True):
        for b, acts in ((arm_and_ball()[0], (0.4, 0.5)), (corners(), (0.0, 0.0))):
            case = gradient_case(b, name, *acts)
            backwards = gradient(name)(*case)
            for field, slopes in backwards.items():
                forwards = [*slopes_along(name, case[0], field, np.ndindex(slopes.shape), *case[1:])]
                assert np.isfinite(slopes).all()
                np.testing.assert_allclose(slopes.ravel(), forwards, rtol=1e-8, atol=1e-9, err_msg=field)


BALLS = Capacity(polygons=1, circles=3, joints=0, thrusters=0)


def one_iteration(b: SceneBuilder, batch_size: int) -> State:
    """The state after one step of one iteration."""
    one = Engine(BALLS, settings=preset("paper").replace(substeps=1, solver_batch_size=batch_size), backend="xla")
    world = b.build()
    return one.step(world.scene, one.initial_state(*world))[0]


def head_on() -> SceneBuilder:
    """A ball at rest is hit from both sides at 1 m/s by its equals."""
    b = SceneBuilder(BALLS, gravity=(0, 0))
    b.add_circle(radius=0.5, position=(0, 0))
    b.add_circle(radius=0.5, position=(-0.999, 0), velocity=(1, 0))
    b.add_circle(radius=0.5, position=(0.999, 0), velocity=(-1, 0))
    return b


def test_one_contact_after_another_sees_what_the_one_before_did() -> None:
    # Left first: both at 0.5. Then right: 0.5 against -1 closes at 1.5, shared.
    np.testing.assert_allclose(one_iteration(head_on(), 1).velocity[1:, 0], [-0.25, 0.5, -0.25], atol=1e-6)


def test_contacts_of_a_batch_are_solved_from_the_same_velocities() -> None:
    # Either contact alone stops its closing speed of 1 m/s by half each; the two halves cancel in the middle.
    np.testing.assert_allclose(one_iteration(head_on(), 16).velocity[1:, 0], [0, 0.5, -0.5], atol=1e-6)


def test_contacts_that_share_no_movable_body_do_not_depend_on_the_batch_size() -> None:
    b = SceneBuilder(BALLS)
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True)
    for x in (-3, 0, 3):
        b.add_circle(radius=0.5, position=(x, 0.49), velocity=(x, -2))
    alone, together = one_iteration(b, 1), one_iteration(b, 16)
    for x, y in zip(jax.tree.leaves(alone), jax.tree.leaves(together)):
        np.testing.assert_allclose(x, y, atol=1e-6)
    assert np.sum(np.asarray(alone.contact_key) >= 0) == 3


def test_only_the_reference_and_only_sequential_impulses_solve_in_batches() -> None:
    with pytest.raises(ValueError, match="backend='xla'"):
        Engine(SIZES["s"], settings=preset("paper").replace(solver_batch_size=16))
    with pytest.raises(ValueError, match="soft_step"):
        preset("standard").replace(solver_batch_size=16)
    with pytest.raises(ValueError, match="from 1 to"):
        preset("paper").replace(solver_batch_size=0)
