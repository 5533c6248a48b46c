"""Errors of the closed forms: none on exact motion, what the metric says on others, small for preset `standard`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import pytest

from jax2d import preset
from jax2d.fidelity.closed_forms import CAPACITY, CLOSED_FORMS
from jax2d.fidelity.closed_forms.joints import ARM_INERTIA, ARM_KG, ARM_M
from jax2d.fidelity.simulator import Scenario, Simulator
from jax2d.fidelity.study_scene import by_name
from jax2d.fidelity.trajectory import Trajectory, bounce_heights, vertex, zero_crossings
from jax2d.fidelity.units import G, with_plain_friction

DT = 1e-3  # s, of exact trajectories


# Exact trajectories


def exact_trajectory(
    name: str, motion: Callable[[float], dict[int, tuple]], dt: float = DT
) -> tuple[float, Trajectory]:
    """(error of the scene, trajectory). `motion` gives {shape: (x, y, angle, vx, vy, w)} at time t; other shapes stay
    where they start."""
    form = CLOSED_FORMS[name]
    world, error = form.world()
    times = dt * np.arange(round(form.seconds / dt) + 1)
    still = np.concatenate(
        [world.position, world.angle[:, None], np.zeros_like(world.velocity), np.zeros_like(world.angle)[:, None]], 1
    )
    states = np.tile(still, (len(times), 1, 1)).astype(float)
    for k, t in enumerate(times):
        for shape, values in motion(float(t)).items():
            states[k, shape] = values
    trajectory = Trajectory(
        scene=world.scene,
        interval=dt,
        position=states[..., :2],
        angle=states[..., 2],
        velocity=states[..., 3:5],
        angular_velocity=states[..., 5],
    )
    return error(trajectory), trajectory


def integrated(acceleration: Callable[[float], float], angle: float, seconds: float) -> np.ndarray:
    """[steps + 1, 2] angle and its rate of angle'' = acceleration(angle) from rest, Runge-Kutta of fourth order."""

    def rate(y: np.ndarray) -> np.ndarray:
        return np.array([y[1], acceleration(float(y[0]))])

    states = [np.array([angle, 0.0])]
    for _ in range(round(seconds / DT)):
        y = states[-1]
        a = rate(y)
        b = rate(y + DT / 2 * a)
        c = rate(y + DT / 2 * b)
        d = rate(y + DT * c)
        states.append(y + DT / 6 * (a + 2 * b + 2 * c + d))
    return np.array(states)


BALL = CAPACITY.polygons  # the first circle
BOX = 0
ON_FLOOR = 1  # the second polygon


def test_free_fall_and_projectile_have_no_error_on_the_parabola():
    error, _ = exact_trajectory("free_fall", lambda t: {BALL: (0, -G * t * t / 2, 0, 0, -G * t, 0)})
    assert error < 1e-12
    error, _ = exact_trajectory("projectile", lambda t: {BALL: (3 * t, 8 * t - G * t * t / 2, 0, 3, 8 - G * t, 0)})
    assert error < 1e-12


def test_thruster_formulas_are_those_of_constant_acceleration():
    assert exact_trajectory("thruster_push", lambda t: {BOX: (1.5 * t * t, 0, 0, 3 * t, 0, 0)})[0] < 1e-12
    # 0.1 N at two arms of 0.5 m on 1/6 kg m^2.
    assert exact_trajectory("thruster_couple", lambda t: {BOX: (0, 0, 0.3 * t * t, 0, 0, 0.6 * t)})[0] < 1e-12


def test_an_error_is_what_the_metric_says():
    error, _ = exact_trajectory("free_fall", lambda t: {BALL: (0, -1.01 * G * t * t / 2, 0, 0, 0, 0)})
    assert error == pytest.approx(0.01)
    error, _ = exact_trajectory("motor_stall", lambda t: {1: (0, 0, 0.8 + 0.05, 0, 0, 0)})
    assert error == pytest.approx(0.05)


def test_block_stops_after_v_squared_over_2_mu_g():
    def motion(t: float) -> dict[int, tuple]:
        t = min(t, 3.0 / (0.3 * G))
        return {ON_FLOOR: (3 * t - 0.3 * G * t * t / 2, 0.1, 0, 3 - 0.3 * G * t, 0, 0)}

    assert exact_trajectory("slide_to_stop", motion)[0] < 1e-12


def test_sliding_disc_rolls_on_with_two_thirds_of_its_speed():
    # Integrated, not the formula again: friction acts while the contact point moves.
    x, speed, spin_speed, dt = 0.0, 3.0, 0.0, 1e-5
    xs = [x]
    for step in range(100_000):
        sliding = speed - spin_speed > 0
        speed -= 0.5 * G * dt * sliding
        spin_speed += 2 * 0.5 * G * dt * sliding  # surface speed r w; I = m r^2 / 2
        x += speed * dt
        if step % 100 == 99:
            xs.append(x)
    assert speed == pytest.approx(2.0, abs=1e-3)
    error, _ = exact_trajectory("slide_to_roll", lambda t: {BALL: (xs[round(t / DT)], 0.2, 0, 0, 0, 0)})
    assert error < 1e-4


@pytest.mark.parametrize(
    ("name", "e", "shape"),
    [
        ("bounce_e0.8", 0.8, BALL),
        ("bounce_e0.5", 0.5, BALL),
        ("bounce_elastic", 1.0, BALL),
        ("flat_bounce", 0.5, ON_FLOOR),
        ("welded_bounce", 0.5, BALL),
    ],
)
def test_exactly_bouncing_body_has_no_error(name: str, e: float, shape: int):
    def motion(t: float) -> dict[int, tuple]:
        speed, since = math.sqrt(2 * G), t + math.sqrt(2 / G)  # as if thrown up before the start
        while since > 2 * speed / G and speed > 1e-3:
            since -= 2 * speed / G
            speed *= e
        return {shape: (0, 0.1 + speed * since - G * since**2 / 2, 0, 0, speed - G * since, 0)}

    assert exact_trajectory(name, motion)[0] < 1e-5


@pytest.mark.parametrize("swing", [0.2, 1.0, 2.0, 2.8])
def test_period_formula_agrees_with_the_integrated_pendulum(swing: float):
    name = f"pendulum_{swing:g}"
    inertia_over_mass = 1.0 + 0.2**2 / 2
    states = integrated(lambda angle: -G * math.sin(angle) / inertia_over_mass, swing, CLOSED_FORMS[name].seconds)
    bob = BALL + 1
    error, _ = exact_trajectory(name, lambda t: {bob: (0, 0, 0, 0, 0, states[round(t / DT), 1])})
    assert error < 1e-6


def test_exact_pendulum_keeps_the_energy_that_is_measured():
    inertia_over_mass = 1.0 + 0.2**2 / 2
    states = integrated(lambda angle: -G * math.sin(angle) / inertia_over_mass, 1.0, 10.0)

    def motion(t: float) -> dict[int, tuple]:
        angle, rate = states[round(t / DT)]
        x, y = math.sin(angle), -math.cos(angle)
        return {BALL + 1: (x, y, angle, -y * rate, x * rate, rate)}

    assert exact_trajectory("pendulum_energy", motion)[0] < 1e-6  # masses are float32


def test_lifted_arm_turns_back_where_the_work_of_the_motor_is_spent():
    inertia = ARM_INERTIA + ARM_KG * (ARM_M / 2) ** 2
    torque = ARM_KG * G * ARM_M / 2 * (1 - math.cos(1.2)) / 1.2
    states = integrated(lambda a: (torque - ARM_KG * G * ARM_M / 2 * math.sin(a)) / inertia, 0.0, 2.0)
    error, _ = exact_trajectory("motor_lift", lambda t: {1: (0, 0, states[round(t / DT), 0], 0, 0, 0)})
    assert error < 1e-6


def test_motor_run_up_is_constant_torque_and_then_constant_speed():
    def motion(t: float) -> dict[int, tuple]:
        angle = 9 * t * t if t < 2 / 3 else 4 + 12 * (t - 2 / 3)
        return {BALL: (0, 0, angle, 0, 0, 0)}

    assert exact_trajectory("motor_run_up", motion)[0] < 1e-12


def test_collisions_keep_momentum_and_return_e_of_the_approach():
    """Integrated through the impact with the impulse (1 + e) m_eff v_n along the line of centres."""

    def collide(name: str, masses: tuple[float, float], e: float) -> float:
        world, _ = CLOSED_FORMS[name].world()
        x = world.position[[BALL, BALL + 1]].astype(float)
        v = world.velocity[[BALL, BALL + 1]].astype(float)
        states, dt = [], 1e-5
        for step in range(round(CLOSED_FORMS[name].seconds / dt) + 1):
            if step % 100 == 0:
                states.append(np.concatenate([x, v], 1))
            apart = x[1] - x[0]
            normal = apart / np.linalg.norm(apart)
            closing = float((v[0] - v[1]) @ normal)
            if np.linalg.norm(apart) <= 0.4 and closing > 0:
                impulse = (1 + e) * closing / (1 / masses[0] + 1 / masses[1])
                v = v + np.array([-impulse / masses[0] * normal, impulse / masses[1] * normal])
            x = x + v * dt
        paths = np.array(states)

        def motion(t: float) -> dict[int, tuple]:
            return {BALL + i: (*paths[round(t / DT), i, :2], 0, *paths[round(t / DT), i, 2:], 0) for i in (0, 1)}

        return exact_trajectory(name, motion)[0]

    assert collide("collision", (1.0, 3.0), 0.5) < 1e-4
    assert collide("collision_off_centre", (1.0, 1.0), 0.5) < 1e-4


# Reading a trajectory


def test_crossings_interpolate_between_samples():
    assert zero_crossings(np.array([1.0, -1.0, -1.0, 3.0]), interval=1.0) == pytest.approx([0.5, 2.25])
    assert zero_crossings(np.array([1.0, 0.0, -1.0]), interval=0.1) == pytest.approx([0.1])


def test_vertex_of_a_parabola_between_samples():
    x = np.array([0.0, 1.0, 2.0])
    assert vertex(5.0 - (x - 1.3) ** 2, 1) == pytest.approx(5.0)


def test_bounce_heights_skip_the_flight_that_has_not_topped():
    height = np.array([2.0, 1.0, 0.0, 1.0, 1.5, 1.0, 0.0, 1.0])
    speed = np.array([0.0, -1.0, -1.0, 1.0, 0.1, -1.0, -1.0, 1.0])
    assert bounce_heights(height, speed) == pytest.approx([1.5])


def test_a_trajectory_is_cut_to_the_nearest_step():
    _, trajectory = exact_trajectory("free_fall", lambda t: {}, dt=1 / 30)
    assert trajectory.until(0.5).num_intervals == 15
    assert trajectory.num_intervals == 45


def test_plain_friction_is_that_of_two_equal_shapes():
    assert with_plain_friction(preset("standard")).base_friction == 1.0
    assert with_plain_friction(preset("paper")).base_friction * math.hypot(0.3, 0.3) == pytest.approx(0.3)


def test_a_name_that_two_scenes_have_is_refused():
    scene = CLOSED_FORMS["spin"]
    with pytest.raises(ValueError, match="two scenes are called 'spin'; give each a name of its own"):
        by_name([scene, scene])


# The engine


@pytest.mark.parametrize("name", sorted(CLOSED_FORMS))
def test_standard_stays_within_its_worst_known_error(name: str):
    assert standard_errors()[name] < 0.04


@functools.cache
def standard_errors() -> dict[str, float]:
    built = {name: form.world() for name, form in CLOSED_FORMS.items()}
    scenarios = [
        Scenario(world=world, seconds=form.seconds, control=form.control)
        for form, (world, _) in zip(CLOSED_FORMS.values(), built.values())
    ]
    results = Simulator(capacity=CAPACITY).run(scenarios, with_plain_friction(preset("standard")))
    return {name: error(one.trajectory) for (name, (_, error)), one in zip(built.items(), results)}


@pytest.mark.slow
def test_float64_turns_a_free_body_without_rounding_that_shows():
    form = CLOSED_FORMS["spin"]
    world, error = form.world()
    simulator = Simulator(capacity=CAPACITY, backend="xla", dtype="float64")
    scenario = Scenario(world=world, seconds=form.seconds, control=form.control)
    (result,) = simulator.run([scenario], preset("standard"))
    assert error(result.trajectory) < 1e-12  # float32: 1e-6
    assert simulator.microseconds_per_world_second(result.timing, preset("standard"), worlds=2, steps=4) > 0
