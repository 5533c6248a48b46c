"""Features of levels against what their documents say, which share no code with the counts."""

import json

import numpy as np
import pytest

from jax2d.scene import stack_worlds
from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.level.features import FEATURES, features_of_arrays, level_features
from kinetix_dist.level.sets import designed_sets, read_level
from tests.helpers import REPOSITORY

FILES = [REPOSITORY / "levels" / file for file in designed_sets()["designed_m"]["levels"]]


def _from_document(document):
    shapes, joints = document["shapes"], document.get("joints", [])
    return {
        "shapes": len(shapes),
        "joints": len(joints),
        "motors": sum(joint["type"] != "fixed" and "motor" in joint for joint in joints),
        "thrusters": len(document.get("thrusters", [])),
        "fixed_shapes": sum(shape.get("fixed", False) for shape in shapes),
        "red_shapes": sum(shape.get("role") == "red" for shape in shapes),
    }


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_features_are_what_the_file_of_a_level_says(file):
    (counts,) = level_features(stack_worlds([read_level(file)[0]]))
    document = json.loads(file.read_text())
    assert dict(zip(FEATURES, counts.tolist(), strict=True)) == _from_document(document)


def test_arrays_of_a_checkpoint_give_the_same():
    levels = stack_worlds([read_level(file)[0] for file in FILES if read_level(file)[1].size == "m"])
    expected = level_features(levels)
    found = features_of_arrays(flatten_arrays(levels))
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)
