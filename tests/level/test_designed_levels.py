"""The collection of designed levels: how many, what they say of themselves, and that they start in order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import stack_worlds
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.proof import level_hash
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import files_of_set
from kinetix_dist.level.validate import read_document

NUM_LEVELS = {"s": 10, "m": 24, "l": 40}
TOUCHING_M = 1e-3  # what rests on something may be written a little into it
# Results are published on these: what is in the sets, and what is in the levels, stays.
PUBLISHED = {
    "designed_s": {
        "hop_home": "cca4bd9fd969",
        "drag_cart": "83a4f255f3b9",
        "swing_up": "dffcdd7eb894",
        "kick": "873fa26cfe1b",
        "aim_rocket": "96534fca7b11",
    },
    "designed_m": {
        "ramp_car": "2c2277887063",
        "two_jets": "3035440d50ce",
        "seesaw": "3bf0e11b2258",
        "elbow": "f9a528cdbe93",
        "wrecking_ball": "90adf1afc513",
    },
    "designed_l": {
        "stair_truck": "430b7ad8d287",
        "walker": "ae3af92a0a56",
        "over_the_fence": "122f822f5b50",
        "cave": "70d536214343",
        "trapeze": "6354b9e58967",
    },
    "sliders": {
        "lift": "60279d9f8568",
    },
}


@pytest.mark.parametrize("size", SIZES)
def test_the_collection_holds_all_levels_of_a_size(size: str) -> None:
    files = files_of_set(f"all_designed_{size}")
    assert sorted(files) == sorted((levels_root() / size).glob("*.json"))
    assert len(set(files)) == NUM_LEVELS[size]


@pytest.mark.parametrize("size", SIZES)
def test_levels_say_what_they_are(size: str) -> None:
    titles = []
    for file in files_of_set(f"all_designed_{size}"):
        _, info = load_level(file)
        assert info.name == file.stem and info.size == size
        assert info.title and info.description.endswith(".") and info.difficulty and info.tags, info.name
        titles.append(info.title)
    assert len(set(titles)) == len(titles)


@pytest.mark.parametrize("size", SIZES)
def test_nothing_overlaps_at_the_start(size: str) -> None:
    files = files_of_set(f"all_designed_{size}")
    levels = stack_worlds([load_level(file)[0] for file in files])
    capacity = capacity_of(levels)

    def gaps(level: Level) -> jax.Array:
        shapes = level.scene.shapes
        vertices = jnp.concatenate([shapes.vertices, jnp.zeros((capacity.circles, capacity.vertices, 2))])
        radius = jnp.concatenate([jnp.zeros(capacity.polygons), shapes.radius])
        corners = world_corners(level.position, level.angle, vertices)
        against = jax.vmap(separation, in_axes=(None, None, 0, 0))
        return jax.vmap(lambda own, r: against(own, r, corners, radius))(corners, radius)

    gap = np.asarray(jax.jit(jax.vmap(gaps))(levels))
    overlapping = np.argwhere((gap < -TOUCHING_M) & levels.scene.shapes.can_touch)
    assert not [(files[level].stem, a, b) for level, a, b in overlapping.tolist()]


@pytest.mark.parametrize("name", ["designed_s", "designed_m", "designed_l", "sliders"])
def test_sets_that_results_are_published_on_stay_as_they_are(name: str) -> None:
    hashes = {file.stem: level_hash(read_document(file))[:12] for file in files_of_set(name)}
    assert hashes == PUBLISHED[name]
