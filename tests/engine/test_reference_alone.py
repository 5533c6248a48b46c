"""What only the reference in plain JAX has: derivatives, contacts solved in batches, the preset `reference`."""

from __future__ import annotations

import dataclasses
import functools
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
        return sum(jnp.sum(weight * getattr(end, field)) for field, weight in weights.items())

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


def gradient_forwards(name: str, x: dict, *rest: Any) -> dict[str, np.ndarray]:
    """What `gradient` gives, number by number in forward mode."""
    found = {field: np.zeros(value.shape) for field, value in x.items()}
    nothing = jax.tree.map(jnp.zeros_like, x)
    for field, slopes in found.items():
        for index in np.ndindex(slopes.shape):
            along = nothing | {field: nothing[field].at[index].set(1.0)}
            slopes[index] = value_and_slope(name)(x, along, *rest)[1]
    return found


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


BOTH_SOLVERS = pytest.mark.parametrize("name", ["standard", "paper"])


@BOTH_SOLVERS
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    """In forward mode; `test_reverse_mode_is_forward_mode` has the other."""
    b, link, ball = arm_and_ball()
    with jax.enable_x64(True):
        case = gradient_case(b, name, motor=0.4, thruster=0.5)
        x, rest = case[0], case[1:]
        slopes = gradient_forwards(name, x, *rest)
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
            # Of a difference of 1e-6: rounding 1e-16 / 1e-6, curvature 1e-12.
            assert float(slopes[field][index]) == pytest.approx(slope, rel=1e-6, abs=1e-7), (field, index)
            assert abs(slope) > 1e-3, (field, index)


@BOTH_SOLVERS
def test_derivatives_are_finite_where_the_maths_has_corners(name: str) -> None:
    """Roots of zero must not give infinite slopes."""
    with jax.enable_x64(True):
        slopes = gradient_forwards(name, *gradient_case(corners(), name, motor=0.0, thruster=0.0))
    assert all(np.isfinite(x).all() for x in slopes.values())


# Reverse mode of `standard` compiles for minutes, that of `paper` in less than one.
@pytest.mark.parametrize("name", ["paper", pytest.param("standard", marks=pytest.mark.slow)])
def test_reverse_mode_is_forward_mode(name: str) -> None:
    """Also where the maths has corners: there a branch not taken gives reverse mode 0 times infinity, if let."""
    with jax.enable_x64(True):
        for b, acts in ((arm_and_ball()[0], (0.4, 0.5)), (corners(), (0.0, 0.0))):
            case = gradient_case(b, name, *acts)
            backwards, forwards = gradient(name)(*case), gradient_forwards(name, *case)
            assert all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(backwards))
            for field, slopes in forwards.items():
                np.testing.assert_allclose(backwards[field], slopes, rtol=1e-8, atol=1e-9, err_msg=field)


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
    with pytest.raises(ValueError, match="at least 1"):
        preset("paper").replace(solver_batch_size=0)


PENDULUM = Capacity(polygons=0, circles=2, joints=1, thrusters=0)  # no more: it takes 40,000 steps


def test_preset_reference_is_converged() -> None:
    """A pendulum for half a second: four times the step changes its angle by 2e-4 rad, so the error is below 1e-4."""
    b = SceneBuilder(PENDULUM)
    post, link = b.add_circle(radius=0.1, fixed=True), b.add_circle(radius=0.3, position=(0.5, 0.0))
    b.add_revolute_joint(post, link, at=(0, 0))
    world = b.build()
    angles = []
    with jax.enable_x64(True):
        for coarser in (4, 1):
            settings = preset("reference").replace(dt=preset("reference").dt * coarser)
            one = Engine(PENDULUM, settings=settings, backend="xla", dtype=jnp.float64)
            scene, state = jax.tree.map(lambda x: jnp.asarray(x)[None], (world.scene, one.initial_state(*world)))
            packed_scene, packed = one.pack_scene(scene), one.pack_state(state)
            for _ in range(4 // coarser):  # calls of as many steps: one program for both
                packed, _ = one.step_packed(packed_scene, packed, one.no_controls(1), num_steps=64 * 120)
            angles.append(float(one.unpack_state(packed).angle[0, link]))
    assert abs(angles[0] - angles[1]) < 3e-4
    assert angles[0] != angles[1]
