"""Level sets by name, the designed levels, and the no-op filter on the engine."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import JointKind
from jax2d.scene import stack_worlds
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import LevelFormatError, level_from_json, load_level
from kinetix_dist.level.sets import RANDOM_SETS, designed_sets, held_out_key, load_level_set
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.level.variants import NUM_VARIANTS
from tests.level.documents import cart_document


def nothing_solved(levels: Level) -> jax.Array:
    return jnp.zeros(levels.position.shape[0], bool)


@pytest.mark.parametrize("size", SIZES)
def test_designed_sets_are_of_their_size(size: str) -> None:
    levels, names = load_level_set(f"designed_{size}")
    assert len(names) == 5 and set(names) < set(load_level_set(f"all_designed_{size}")[1])
    assert capacity_of(levels) == SIZES[size] and levels.position.shape[0] == len(names)


def test_a_set_is_made_of_others() -> None:
    levels, names = load_level_set("all_designed")
    assert capacity_of(levels) == SIZES["l"]
    assert names == [name for size in SIZES for name in load_level_set(f"all_designed_{size}")[1]]
    assert len(set(names)) == 74


def test_designed_levels_are_named_after_their_files_described_and_controllable() -> None:
    for entry in designed_sets().values():
        for file in entry["levels"]:
            level, info = load_level(levels_root() / file)
            assert info.name == Path(file).stem and info.description
            assert info.size == entry["size"] or "sets" in entry
            scene = level.scene
            motors = (
                scene.joints.active & scene.joints.motor_on & ~scene.joints.is_kind(JointKind.FIXED) & ~level.motor_auto
            )
            assert motors.any() or scene.thrusters.active.any()


# Since joints are one system the ball, whose weight opens the gate, tips the beam the right way and rolls to the goal.
# The level stays as evaluations know it.
SOLVES_ITSELF = {"l": ["lever_puzzle"]}


@pytest.mark.parametrize("size", SIZES)
def test_designed_levels_do_not_solve_themselves(size: str) -> None:
    levels, names = load_level_set(f"all_designed_{size}")
    solved = np.asarray(noop_solved(levels, num_steps=256))
    assert [name for name, done in zip(names, solved) if done] == SOLVES_ITSELF.get(size, [])


def test_a_ball_that_falls_on_the_goal_solves_itself_and_one_that_meets_red_first_does_not() -> None:
    def fall(red_height: float) -> Level:
        document = cart_document()
        document |= {"joints": [], "thrusters": []}
        document["shapes"] = [
            {"id": "ball", "type": "circle", "radius": 0.2, "position": [2.5, 3.0], "role": "green"},
            {"id": "goal", "type": "circle", "radius": 0.3, "position": [2.5, 1.0], "role": "blue", "fixed": True},
            {
                "id": "red",
                "type": "circle",
                "radius": 0.05,
                "position": [2.5, red_height],
                "role": "red",
                "fixed": True,
            },
        ]
        return level_from_json(document)

    np.testing.assert_array_equal(noop_solved(stack_worlds([fall(0.45), fall(2.0)])), [True, False])


def test_random_sets_are_held_out_and_fit_larger_sizes() -> None:
    levels, names = load_level_set("random_s", "m", num_levels=4, noop_outcome_fn=nothing_solved)
    assert names == ["random_s_0", "random_s_1", "random_s_2", "random_s_3"]
    assert capacity_of(levels) == SIZES["m"]
    again, _ = load_level_set("random_s", num_levels=4, noop_outcome_fn=nothing_solved)
    np.testing.assert_array_equal(again.position[:, :5], levels.position[:, :5])
    keys = {tuple(jax.random.key_data(held_out_key(size)).tolist()) for size in SIZES}
    seeds = {tuple(jax.random.key_data(jax.random.key(seed)).tolist()) for seed in range(100)}
    assert len(keys) == 3 and not keys & seeds


def test_sets_to_develop_with_share_no_level_with_those_that_are_published() -> None:
    held_out, _ = load_level_set("random_s", num_levels=8, noop_outcome_fn=nothing_solved)
    to_develop, names = load_level_set("dev_random_s", num_levels=8, noop_outcome_fn=nothing_solved)
    assert names[7] == "dev_random_s_7"
    distance = np.abs(held_out.position[:, None] - to_develop.position[None]).max(axis=(2, 3))
    assert distance.min() > 0.1
    assert RANDOM_SETS["dev_random_s"].num_levels == 2048


def test_the_long_random_sets_begin_with_the_short_ones() -> None:
    short, _ = load_level_set("random_s", num_levels=4, noop_outcome_fn=nothing_solved)
    long, names = load_level_set("random_1000_s", num_levels=8, noop_outcome_fn=nothing_solved)
    assert names[7] == "random_1000_s_7" and RANDOM_SETS["random_1000_s"].num_levels == 1000
    for one, other in zip(jax.tree.leaves(short), jax.tree.leaves(long), strict=True):
        np.testing.assert_allclose(one, other[:4], rtol=2e-5, atol=1e-6)  # programs of other batches round differently


def test_variants_of_designed_levels_differ_a_little_and_half_of_them_are_mirrored() -> None:
    plain, stems = load_level_set("all_designed_s")
    levels, names = load_level_set("dev_designed_s")
    assert names == [f"{stem}_{i}" for stem in stems for i in range(NUM_VARIANTS)]
    again, _ = load_level_set("dev_designed_s")
    np.testing.assert_array_equal(levels.velocity, again.velocity)
    for number in range(len(stems)):
        one = jax.tree.map(lambda x, i=number: x[i], plain)
        here, there = (jax.tree.map(lambda x, k=NUM_VARIANTS * number + k: x[k], levels) for k in (0, 1))
        active = one.scene.shapes.active
        np.testing.assert_array_equal(here.position, one.position)  # geometry stays
        np.testing.assert_allclose(there.position[active, 1], one.position[active, 1], atol=1e-5)
        shapes = one.scene.shapes
        movable = active & (shapes.inverse_mass > 0)
        np.testing.assert_allclose(here.scene.shapes.inverse_mass[movable], shapes.inverse_mass[movable], rtol=0.12)
        assert (here.scene.shapes.inverse_mass[movable] != shapes.inverse_mass[movable]).all()
        np.testing.assert_array_equal(here.scene.shapes.inverse_mass[~movable], shapes.inverse_mass[~movable])
        assert not here.velocity[~movable].any() or one.velocity[~movable].any()


def test_one_designed_level_a_file_and_a_directory_are_sets_too(tmp_path: Path) -> None:
    assert load_level_set("s/hop_home")[1] == load_level_set("hop_home")[1] == ["hop_home"]
    for name in ("b", "a"):
        (tmp_path / f"{name}.json").write_text(json.dumps(cart_document()))
    assert load_level_set(str(tmp_path))[1] == ["a", "b"]
    levels, names = load_level_set(str(tmp_path / "b.json"), "l")
    assert names == ["b"] and capacity_of(levels) == SIZES["l"]


def test_a_directory_of_public_levels_is_a_set(public_levels: Path) -> None:
    levels, names = load_level_set(str(public_levels / "s"))
    assert len(names) == 10 and capacity_of(levels) == SIZES["s"]


def test_wrong_names_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError,
        match=r"unknown level set 'nosuch'; sets are designed_s.*random_1000_l, frontier_s, frontier_m, or give",
    ):
        load_level_set("nosuch")
    for path in ("nosuch.json", "/no/such"):
        with pytest.raises(FileNotFoundError, match=f"there is no level file or directory {path}"):
            load_level_set(path)
    with pytest.raises(ValueError, match="unknown size 'xl'; sizes are s, m, l"):
        load_level_set("designed_s", "xl")
    with pytest.raises(FileNotFoundError, match=r"no \.json level files"):
        load_level_set(str(tmp_path))
    (tmp_path / "a.json").write_text(json.dumps(cart_document()))
    with pytest.raises(ValueError, match=r"a\.json: level has 6 polygons"):
        load_level_set(str(tmp_path), "s")
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(LevelFormatError, match=r"a\.json: size: is missing"):
        load_level_set(str(tmp_path))


def test_a_directory_is_not_the_file_beside_it_that_is_called_like_it(tmp_path: Path) -> None:
    """The file may be results of an evaluation of the directory."""
    (tmp_path / "mine").mkdir()
    shutil.copy(levels_root() / "s" / "kick.json", tmp_path / "mine")
    (tmp_path / "mine.json").write_text("{}")
    assert load_level_set(str(tmp_path / "mine"))[1] == ["kick"]
