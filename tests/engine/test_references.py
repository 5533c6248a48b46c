"""Scenes with a reference solution: the stored truth, errors against it, and which of them are believed."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from jax2d import preset
from jax2d.fidelity import references
from jax2d.fidelity.frontier import NOT_ACCEPTED, accepted, points_of, scenes_of_means
from jax2d.fidelity.records import Record
from jax2d.fidelity.reference_scenes import CAPACITY, REFERENCE_SCENES
from jax2d.fidelity.references import SAMPLES_PER_SECOND, TRUST, StaleReference, signature, study_scenes
from jax2d.fidelity.simulator import Scenario, Simulator
from jax2d.fidelity.study import fields_of
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import with_plain_friction

# Impacts of several bodies with friction: half the step may not come ten times closer than what `standard` errs by.
LEAST_CERTAIN = {"ragdoll_slope"}


def stored_positions(name: str) -> np.ndarray:
    return np.array(json.loads(references.FILE.read_text())[name]["position"])


def trajectory_through(name: str, positions: np.ndarray) -> Trajectory:
    """A trajectory with one step a sample, movable bodies at `positions` [samples, movable, 2]."""
    world, _ = study_scenes([name])[name].world()
    samples = references.samples_of(REFERENCE_SCENES[name])
    there = np.tile(world.position, (samples[-1] + 1, 1, 1)).astype(float)
    there[np.ix_(samples, references.movable(world))] = positions
    angle = np.zeros(there.shape[:2])
    return Trajectory(
        scene=world.scene,
        interval=1 / SAMPLES_PER_SECOND,
        position=there,
        angle=angle,
        velocity=np.zeros_like(there),
        angular_velocity=angle,
    )


def test_a_pile_is_compared_where_it_has_come_to_rest():
    scene = REFERENCE_SCENES["circles_poured"]
    assert references.samples_of(scene).tolist() == [10, 11, 12]
    truth = stored_positions("circles_poured")
    assert np.linalg.norm(truth[-1] - truth[0], axis=-1).max() < 0.02
    _, error = study_scenes(["circles_poured"])["circles_poured"].world()
    trajectory = trajectory_through("circles_poured", truth)  # before, the bodies are where they started
    assert error(trajectory) == 0.0


@pytest.mark.parametrize("name", sorted(REFERENCE_SCENES))
def test_every_scene_has_its_solution_with_all_samples(name: str):
    scene = REFERENCE_SCENES[name]
    truth = stored_positions(name)
    bodies = int(references.movable(scene.world()).sum())
    assert truth.shape == (len(references.samples_of(scene)), bodies, 2)
    assert np.isfinite(truth).all()
    # Something happens: over the motion some body gets as far as a third of what errors are divided by.
    world = scene.world()
    started = world.position[references.movable(world)]
    assert np.linalg.norm(truth - started, axis=-1).max() > scene.length / 3


def test_error_is_the_largest_distance_of_a_body_over_the_length():
    name = "triple_pendulum"
    truth = stored_positions(name)
    _, error = study_scenes([name])[name].world()
    assert error(trajectory_through(name, truth)) == 0.0
    truth[3, 1] += (0.03, -0.04)
    assert error(trajectory_through(name, truth)) == pytest.approx(0.05 / REFERENCE_SCENES[name].length)
    truth[5, 0] = np.nan
    assert not np.isfinite(error(trajectory_through(name, truth)))


def test_a_dt_that_misses_the_samples_is_refused():
    name = "triple_pendulum"
    _, error = study_scenes([name])[name].world()
    trajectory = dataclasses.replace(trajectory_through(name, stored_positions(name)), interval=0.03)
    with pytest.raises(ValueError, match=r"dt is 0.03 s; errors are taken every 0.1 s"):
        error(trajectory)


def test_a_changed_scene_refuses_its_old_solution(monkeypatch):
    scene = REFERENCE_SCENES["stack_on_cart"]

    def with_a_pebble(b):
        scene.build(b)
        b.add_circle(radius=0.01, position=(5, 0.01))

    changed = dataclasses.replace(scene, build=with_a_pebble)
    assert signature(changed) != signature(scene)
    monkeypatch.setitem(REFERENCE_SCENES, "stack_on_cart", changed)
    with pytest.raises(StaleReference, match=r"run python -m jax2d.fidelity.references stack_on_cart"):
        study_scenes(["stack_on_cart"])


def test_a_missing_solution_names_the_command(monkeypatch, tmp_path):
    monkeypatch.setattr(references, "FILE", tmp_path / "references.json")
    references.FILE.write_text("{}\n")
    with pytest.raises(StaleReference, match="no solution of pinball"):
        study_scenes(["pinball"])


def test_the_solution_is_good_enough_to_judge_standard_by():
    scenes = study_scenes()
    built = {name: scene.world() for name, scene in scenes.items()}
    scenarios = [
        Scenario(world=world, seconds=scene.seconds, control=scene.control)
        for scene, (world, _) in zip(scenes.values(), built.values())
    ]
    results = Simulator(capacity=CAPACITY).run(scenarios, with_plain_friction(preset("standard")))
    errors = {name: error(one.trajectory) for (name, (_, error)), one in zip(built.items(), results)}
    refused = {name for name, error in errors.items() if error < TRUST * scenes[name].uncertainty}
    assert refused <= LEAST_CERTAIN
    assert max(errors.values()) < 0.4  # of the scene's length: it is the same motion


def record(scene: str, preset_name: str, metric: str, error: float) -> Record:
    return Record(
        scene=scene,
        preset=preset_name,
        backend="warp",
        dtype="float32",
        device="cpu",
        setting="dt 1/60, 4 substeps",
        metric=metric,
        error=error,
        us_per_world_second=1.0,
    )


def test_an_error_smaller_than_ten_times_the_doubt_says_so_and_is_kept():
    scene = dataclasses.replace(study_scenes(["catapult"])["catapult"], uncertainty=1e-3)
    believed, doubted = fields_of(scene, 1.01e-2, {}), fields_of(scene, 0.99e-2, {})
    assert believed["metric"] == scene.metric
    assert doubted["metric"].startswith(scene.metric + NOT_ACCEPTED)
    assert doubted["error"] == 0.99e-2


def test_means_leave_out_what_is_not_accepted():
    doubted = "m" + NOT_ACCEPTED + "why"
    records = [
        record("a", "standard", "m", 0.1),
        record("b", "standard", doubted, 0.1),
        record("a", "swept", "m", 0.01),
        record("b", "swept", "m", 0.01),
        record("a", "finer", doubted, 0.001),
    ]
    assert [accepted(r) for r in records] == [True, False, True, True, False]
    assert scenes_of_means(records) == ["a"]  # the preset itself has no accepted record of b
    # The finer setting has no mean at all rather than one over other scenes.
    assert [(point.preset, point.error) for point in points_of(records)] == [
        ("standard", pytest.approx(0.1)),
        ("swept", pytest.approx(0.01)),
    ]
