"""The accuracy study: formulas against exact motion, the Pareto set by hand, records, and what the command refuses."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable

import numpy as np
import pytest

from jax2d import PRESETS, preset
from jax2d.fidelity.__main__ import main, parse
from jax2d.fidelity.closed_forms import CAPACITY, CLOSED_FORMS
from jax2d.fidelity.closed_forms.motors import ARM_INERTIA, ARM_KG, ARM_M
from jax2d.fidelity.extrema import bounce_heights, vertex, zero_crossings
from jax2d.fidelity.frontier import Record, pareto_set, points_of, slope
from jax2d.fidelity.labels import setting_label
from jax2d.fidelity.report import beaten_scenes
from jax2d.fidelity.simulator import Scenario, Simulator
from jax2d.fidelity.study_scene import by_name
from jax2d.fidelity.sweep import sweep
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import G, with_plain_friction

DT = 1e-3  # s, of exact trajectories
FIELDS = ("scene", "preset", "backend", "dtype", "device", "setting", "metric", "error", "us_per_world_second")


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
    assert trajectory.until(0.5).num_steps == 15
    assert trajectory.num_steps == 45


def test_plain_friction_is_that_of_two_equal_shapes():
    assert with_plain_friction(preset("standard")).base_friction == 1.0
    assert with_plain_friction(preset("paper")).base_friction * math.hypot(0.3, 0.3) == pytest.approx(0.3)


def test_a_name_that_two_scenes_have_is_refused():
    scene = CLOSED_FORMS["spin"]
    with pytest.raises(ValueError, match="two scenes are called 'spin'"):
        by_name([scene, scene])


# Points


def test_pareto_set_of_five_points():
    # (2, 3) is beaten by (1, 3); (4, 1) equals another and counts once; (5, 2) is beaten by (4, 1).
    assert pareto_set([(2, 3), (1, 3), (4, 1), (5, 2), (4, 1)]) == [1, 2]
    assert pareto_set([]) == []


def test_slope_of_error_that_halves_when_the_cost_doubles():
    assert slope([1, 2, 4], [0.4, 0.2, 0.1]) == pytest.approx(-1.0)
    assert math.isnan(slope([1.0], [0.1]))


def record(scene: str, name: str, setting: str, error: float | None, cost: float) -> Record:
    return Record(
        scene=scene,
        preset=name,
        backend="warp",
        dtype="float32",
        device="cpu",
        setting=setting,
        metric="m",
        error=error,
        us_per_world_second=cost,
    )


def test_points_are_geometric_means_over_the_scenes_that_all_settings_have():
    records = [
        record("a", "x", "1", 0.01, 10.0),
        record("b", "x", "1", None, 40.0),  # not finite: counts as 1
        record("only x", "x", "1", 1e-5, 1.0),
        record("a", "y", "1", 0.0, 9.0),  # exact: counts as 1e-6
        record("b", "y", "1", 0.01, 9.0),
    ]
    x, y = points_of(records)
    assert (x.cost, x.error) == (pytest.approx(20.0), pytest.approx(0.1))
    assert (y.cost, y.error) == (pytest.approx(9.0), pytest.approx(1e-4))


def test_a_preset_is_beaten_only_where_another_is_better_in_one_and_worse_in_none():
    own = setting_label(preset("standard"))
    records = [
        record("faster only", "standard", own, 0.1, 10.0),
        record("faster only", "box2d", "1", 0.2, 5.0),
        record("both", "standard", own, 0.1, 10.0),
        record("both", "box2d", "1", 0.1, 5.0),
        record("swept", "standard", "dt 1/999, 4 substeps", 0.1, 10.0),
        record("swept", "box2d", "1", 0.01, 5.0),
    ]
    assert beaten_scenes(records, "standard", "box2d") == ["both"]


def test_sweep_has_each_preset_as_it_is_and_nothing_twice():
    cases = sweep(list(PRESETS), ["warp"], quick=True)
    labels = [(case.settings.solver, setting_label(case.settings)) for case in cases]
    assert len(set(labels)) == len(labels)
    for name in set(PRESETS) - {"reference"}:
        assert preset(name) in [case.settings for case in cases if case.preset == name]
    assert {round(1 / case.settings.dt) for case in cases} == {30, 60, 120, 240, 480}
    full = sweep(list(PRESETS), ["warp"], quick=False)
    assert len(full) > len(cases)
    for some, names in ((cases, {"standard", "paper"}), (full, {"draft", "standard", "fine", "paper"})):
        assert {case.preset for case in some if not case.settings.warm_start} == names


# The command


def test_study_writes_records_table_and_picture(tmp_path, capsys):
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "free_fall", "stack_rest"]
    assert main([*arguments, "--presets", "standard", "--peers", "--worlds", "8"]) == 0
    records = json.loads(file.read_text())
    assert {tuple(record) for record in records} == {FIELDS}
    assert {record["scene"] for record in records} == {"free_fall", "stack_rest"}
    for entry in records:
        assert isinstance(entry["error"], float) and entry["us_per_world_second"] > 0
    falls = {r["setting"]: r["error"] for r in records if r["scene"] == "free_fall"}
    # Semi-implicit Euler falls g t h / 2 farther, h / t of the height.
    assert falls["dt 1/60, 4 substeps"] == pytest.approx(1 / 240 / 1.5, rel=0.02)
    with file.with_suffix(".csv").open(newline="") as table:
        assert [row["scene"] for row in csv.DictReader(table)] == [record["scene"] for record in records]
    assert file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert "free_fall" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(CLOSED_FORMS))
def test_standard_stays_within_its_worst_known_error(name: str):
    """One scene is known to be worse: an impact is passed on from ball to ball as if they were one body."""
    worst = {"newtons_cradle": 0.35}
    assert standard_errors()[name] < worst.get(name, 0.04)


_ERRORS: dict[str, float] = {}


def standard_errors() -> dict[str, float]:
    if not _ERRORS:
        built = {name: form.world() for name, form in CLOSED_FORMS.items()}
        scenarios = [
            Scenario(world=world, seconds=form.seconds, control=form.control)
            for form, (world, _) in zip(CLOSED_FORMS.values(), built.values())
        ]
        results = Simulator(capacity=CAPACITY).run(scenarios, with_plain_friction(preset("standard")))
        _ERRORS.update({name: error(one.trajectory) for (name, (_, error)), one in zip(built.items(), results)})
    return _ERRORS


def test_quick_parses_and_leaves_the_slow_parts_out(tmp_path):
    quick = parse(["--quick", "--json", str(tmp_path / "a.json")])
    full = parse(["--json", str(tmp_path / "a.json")])
    assert (quick.backends, quick.peers) == (["warp"], ["box2d"])
    assert (full.backends, full.peers) == (["warp", "xla"], ["box2d", "published"])
    assert quick.picture == tmp_path / "a.png"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--worlds", "0"], "--worlds is 0"),
        (["--repeats", "2"], "--repeats is 2"),
        (["--scenes", "perpetual_motion"], "perpetual_motion"),
        (["--presets", "best"], "best"),
        (["--peers", "bullet"], "bullet"),
        (["--json", "/dev/null/study.json"], "cannot write"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(arguments: list[str], says: str, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and says in lines[0]


def test_peer_that_is_not_installed_is_left_out_with_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("KINETIX_BOX2D_PYTHON", str(tmp_path / "no" / "python"))
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers", "box2d"]) == 0
    said = capsys.readouterr().out
    assert "box2d left out: not installed; run `bash bench/peers/setup_box2d.sh`" in said
    assert {record["preset"] for record in json.loads(file.read_text())} == {"standard"}


def test_a_setting_that_fails_costs_no_other_its_records(tmp_path, monkeypatch, capsys):
    whole = Simulator.run

    def run(self, scenarios, settings):
        if settings.dt == 1 / 480:
            raise MemoryError("out of memory\nwhile trying")
        return whole(self, scenarios, settings)

    monkeypatch.setattr(Simulator, "run", run)
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "1 measurement failed" in line and "dt 1/480" in line and "out of memory while trying" in line
    rates = {record["setting"].split(",")[0] for record in json.loads(file.read_text())}
    assert rates == {"dt 1/30", "dt 1/60", "dt 1/120", "dt 1/240"}


def test_a_peer_whose_process_fails_is_a_failure_and_the_rest_is_written(tmp_path, monkeypatch, capsys):
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho boom >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setenv("KINETIX_BOX2D_PYTHON", str(fake))
    file = tmp_path / "study.json"
    arguments = ["--quick", "--json", str(file), "--scenes", "spin", "--presets", "standard", "--worlds", "4"]
    assert main([*arguments, "--peers", "box2d"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "box2d failed: boom" in line
    assert {record["preset"] for record in json.loads(file.read_text())} == {"standard"}


@pytest.mark.slow
def test_float64_turns_a_free_body_without_rounding_that_shows():
    form = CLOSED_FORMS["spin"]
    world, error = form.world()
    simulator = Simulator(capacity=CAPACITY, backend="xla", dtype="float64")
    scenario = Scenario(world=world, seconds=form.seconds, control=form.control)
    (result,) = simulator.run([scenario], preset("standard"))
    assert error(result.trajectory) < 1e-12  # float32: 1e-6
    assert simulator.microseconds_per_world_second(result.timing, preset("standard"), worlds=2, steps=4) > 0
