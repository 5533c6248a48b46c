"""Scenes on which solvers fail. docs/hard_scenes.md says where a preset does; a test fails where it passes there."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Engine, SceneError, State, preset, stack_worlds
from jax2d.fidelity import record, record_worlds
from jax2d.fidelity.hard_scenes import CAPACITY as LARGE
from jax2d.fidelity.hard_scenes import Check, HardSceneBuilder
from jax2d.fidelity.hard_scenes.stacks import heavy_on_light, stack
from jax2d.fidelity.hard_table import REFUSED, SHOWN, outcomes, scenes
from tests.engine.worlds import builder, engine
from tests.helpers import REPOSITORY, present

NAMES = [scene.name for scene in scenes()]

# What `standard` fails, with the figures that do; all others must hold.
STANDARD_FAILING = {
    # A hundred times its weight on a box a 28th as heavy: 4.5 cm of 30.
    "press of density 10": {"overlap, m"},
    # The boxes pass through each other: 240 times is what boxes of this size bear.
    "mass ratio 400 of boxes of 0.2 m": {"order is lost by, m"},
}


def published_failures() -> dict[str, set[str]]:
    """preset: scenes that it fails, as docs/hard_scenes.md says."""
    return {
        name: {scene for scene, row in published_rows().items() if row[name].startswith("**fails**")} for name in SHOWN
    }


def published_rows() -> dict[str, dict[str, str]]:
    """scene: its row of docs/hard_scenes.md, by the table's header."""
    lines = [line for line in (REPOSITORY / "docs/hard_scenes.md").read_text().splitlines() if line.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    first = next(k for k, row in enumerate(table) if row[:2] == ["scene", "figure, at most"])
    last = next(k for k, row in enumerate(table) if row[0] == "fails")
    return {row[0]: dict(zip(table[first], row, strict=True)) for row in table[first + 2 : last]}


FAILING = published_failures()
REFUSED_SCENES = {
    preset_name: {scene for scene, row in published_rows().items() if row[preset_name] == REFUSED}
    for preset_name in SHOWN
}


def assert_holds(checks: list[Check] | None) -> None:
    assert checks is not None, "the solver does not have the effects that the scene calls for"
    for check in checks:
        assert check.holds, f"{check.figure} {check.value:.3g}, at most {check.limit:g}"


def cases(*solvers: str) -> list:
    """Every scene under every one of the presets; where one fails, its failure is expected, but no other error is."""
    expected = pytest.mark.xfail(strict=True, raises=AssertionError)
    return [
        pytest.param(solver, name, marks=[expected] if name in FAILING[solver] else [])
        for solver in solvers
        for name in NAMES
        if name not in REFUSED_SCENES[solver]
    ]


@pytest.mark.also_gpu
@pytest.mark.parametrize("name", [name for name in NAMES if name not in STANDARD_FAILING])
def test_standard_passes(name: str):
    assert_holds(outcomes(preset("standard"))[name])


@pytest.mark.parametrize(("solver", "name"), cases("fine", "draft", "paper"))
def test_others_fail_only_where_it_is_written(solver: str, name: str):
    assert_holds(outcomes(preset(solver))[name])


@pytest.mark.xfail(strict=True, raises=AssertionError)
@pytest.mark.parametrize("name", STANDARD_FAILING)
def test_standard_still_fails_what_the_table_says(name: str):
    assert_holds(outcomes(preset("standard"))[name])


@pytest.mark.parametrize("solver", SHOWN)
def test_solvers_refuse_what_the_table_says(solver: str):
    assert {name for name, checks in outcomes(preset(solver)).items() if checks is None} == REFUSED_SCENES[solver]


@pytest.mark.parametrize("name", STANDARD_FAILING)
def test_standard_fails_in_no_other_figure(name: str):
    checks = present(outcomes(preset("standard"))[name])
    assert {check.figure for check in checks if not check.holds} == STANDARD_FAILING[name]


@pytest.mark.parametrize(("name", "per_metre"), [("standard", 1000.0), ("draft", 280.0)])
def test_small_boxes_bear_less_as_the_docs_say(name: str, per_metre: float):
    """A box bears `per_metre` times its mass for each metre of its size, and not one and a half times as much."""
    scenes = [heavy_on_light(share * per_metre * size, size) for share in (1.0, 1.5) for size in (0.1, 0.3, 1.0)]
    trajectories = record_worlds(Engine(LARGE, settings=preset(name)), [s.world for s in scenes], seconds=10.0)
    holds = [all(check.holds for check in scene.checks(m)) for scene, m in zip(scenes, trajectories, strict=True)]
    assert holds == [True] * 3 + [False] * 3


def test_far_stack_is_lost_to_the_rounding_of_positions_alone():
    """A stack at the origin, with positions rounded between steps as float32 rounds them at 10 km, drifts just as
    far."""
    world, one = stack(15).world, Engine(LARGE)
    scene, state = stack_worlds([world.scene]), stack_worlds([one.initial_state(*world)])
    packed_scene, controls = one.pack_scene(scene), one.no_controls(1)

    @jax.jit
    def simulate(state: State, far: jax.Array) -> State:  # a constant would be folded: x + far - far = x
        def body(state: State, _):
            state = one.unpack_state(one.step_packed(packed_scene, one.pack_state(state), controls)[0])
            return dataclasses.replace(state, position=(state.position + far) - far), None

        return jax.lax.scan(body, state, length=600)[0]

    moved = np.linalg.norm(
        np.asarray(simulate(state, jnp.float32(1e4)).position - state.position)[0, : 15 + 1], axis=-1
    )
    drift = present(outcomes(preset("standard"))["stack of 15 10000 m away"])[0]
    assert moved.max() == pytest.approx(drift.value, abs=1e-3)


def test_published_table_has_a_row_for_each_scene():
    """The table says of each scene what the tests above expect."""
    assert list(published_rows()) == NAMES, "print the table with `python -m jax2d.fidelity.hard_table`"
    assert FAILING["standard"] == set(STANDARD_FAILING)
    assert FAILING["fine"] == set()


# Long runs, changed scenes, other steps


@pytest.mark.also_gpu
def test_perfectly_elastic_ball_keeps_its_energy_over_a_thousand_bounces():
    b = builder()
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=1)
    ball = b.add_circle(radius=0.1, position=(0, 0.4), restitution=1)
    period = 2 * math.sqrt(2 * 0.3 / 9.81)
    # A bounce takes to the end of the step in which it falls, and one more to leave: up to two steps.
    (m,) = record_worlds(engine(), [b.build()], seconds=1000 * (period + 2 / 60))
    lift = m.position[:, ball, 1] - 0.1
    energy = 9.81 * lift + m.velocity[:, ball, 1] ** 2 / 2
    assert (np.diff(np.sign(m.velocity[:, ball, 1])) > 0).sum() >= 1000
    # Between two moments of a semi-implicit fall the sum itself swings by g h v / 2, 1.4 % here: a mean is compared.
    assert energy[-500:].mean() == pytest.approx(energy[1:501].mean(), rel=0.01)


@pytest.mark.parametrize("power", [0.05, 4.0, 1000.0])
def test_motor_gives_the_same_speed_at_half_the_time_step(power: float):
    b = builder(gravity=(0, 0))
    post = b.add_circle(radius=0.05, fixed=True)
    arm = b.add_box(width=1, height=0.2, position=(0.4, 0))
    b.add_revolute_joint(post, arm, at=(0, 0), motor_speed=1.0, motor_power=power)
    world = b.build()
    standard = preset("standard")
    ends = [
        record_worlds(engine(standard.replace(dt=dt)), [world], seconds=2.0)[0].angular_velocity[-1, arm]
        for dt in (1 / 60, 1 / 120)
    ]
    assert ends[0] == pytest.approx(6.0, rel=0.01)
    assert ends[0] == pytest.approx(ends[1], rel=0.01)


@pytest.mark.also_gpu
def test_removing_a_heavy_top_body_adds_no_energy():
    b = HardSceneBuilder()
    boxes = [b.box(0, 0.5 + k) for k in range(3)]
    heavy = b.box(0, 3.5, density=20)
    world = b.builder.build()
    one = Engine(LARGE)
    loaded, state = record(one, world.scene, one.initial_state(*world), num_samples=300)
    world.scene.shapes.active[heavy] = False
    freed, _ = record(one, world.scene, state, num_samples=300)
    stored = 9.81 * loaded.position[-1, boxes, 1].sum()  # J, potential energy of the boxes of 1 kg
    assert freed.energy(zero_at=freed.position[0]).max() < 0.01 * stored
    assert freed.speed().max() < 0.5  # warm-start impulses of the heavy body, taken back within the first step
    assert freed.speed()[-1] < 1e-3


@pytest.mark.also_gpu
def test_order_of_slots_changes_no_verdict():
    """A stack built from the ground up, from the top down and shuffled, its floor in the last slot."""
    orders = [list(range(10)), list(reversed(range(10))), list(np.random.default_rng(1).permutation(10))]
    worlds = []
    for order in orders:
        b = HardSceneBuilder(floor=False)
        for k in order:
            b.box(0, 0.5 + float(k))
        b.box(0, -0.5, width=200, fixed=True)
        worlds.append(b.builder.build())
    for m in record_worlds(Engine(LARGE), worlds, seconds=10.0):
        assert m.drift() < 0.05
        assert m.speed()[-1] < 1e-3


@pytest.mark.parametrize(
    "vertices",
    [
        [(0, 0), (1, 0), (0.5, 1e-9)],  # almost no area
        [(0, 0), (1, 0), (1, 0), (0, 1)],  # a vertex twice
        [(0, 0), (1, 0), (2, 0)],  # a line
        [(0, 0), (1e-5, 0), (0, 1e-5)],  # too small for float32 inertia
    ],
)
def test_shapes_beyond_float32_are_refused_where_they_are_built(vertices: list[tuple[float, float]]):
    with pytest.raises(SceneError):
        builder().add_polygon(vertices)
