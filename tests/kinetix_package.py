"""The public Kinetix package, asked in its own environment: $KINETIX_PACKAGE_PYTHON (kinetix-env 3.0.2).

Tests that need it are skipped where there is none. What it once computed of levels of ours is stored in
tests/env/kinetix_policy.npz; `python -m tests.kinetix_package` writes that file again.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import tempfile
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jax2d.scene import Array, pack_bits, stack_worlds
from kinetix_dist.env.observations import OBSERVATIONS, Moving
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.env.observations.kinetix_entities import NUM_FEATURES
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.kinetix_format import export_kinetix
from kinetix_dist.level.level import NUM_WALLS, SIZES, Level
from kinetix_dist.level.schema import level_as_written
from kinetix_dist.level.structure import read_document
from kinetix_dist.models.kinetix_parameters import FeatureCounts, layout
from kinetix_dist.models.policy import PolicyConfig
from tests.helpers import REPOSITORY

PROGRAM = REPOSITORY / "bench" / "peers" / "kinetix_policy.py"
VARIABLE = "KINETIX_PACKAGE_PYTHON"
STORED = REPOSITORY / "tests" / "env" / "kinetix_policy.npz"
STORED_LEVELS = ("car_flip", "rocket_car", "wrecking_ball", "rocket_shot", "push_block", "seesaw")  # of size M


def run_package(folder: Path, request: dict[str, Any]) -> dict[str, np.ndarray]:
    """What `bench/peers/kinetix_policy.py` answers. Skips the test without the package."""
    if not (python := os.environ.get(VARIABLE)):
        pytest.skip(f"the public package is not here: set {VARIABLE} to a Python with kinetix-env 3.0.2")
    (folder / "request.json").write_text(json.dumps({"recalculate": False, "checkpoints": []} | request))
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHONPATH", "XLA_FLAGS", "JAX_"))
    }
    ended = subprocess.run(
        [python, str(PROGRAM), str(folder / "request.json"), str(folder / "answer.npz")],
        env=environment | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    with np.load(folder / "answer.npz") as archive:
        return {name: archive[name] for name in archive.files}


STORED_POLICIES = {"policy": {}, "paper": {"legacy_entity_id": True}}  # by `write_formula_policy`
# Option of the package's network: field of PolicyConfig.
PACKAGE_SIZES = {
    "transformer_encoder_size": "encoder_size",
    "transformer_size": "attention_features",
    "num_heads": "num_heads",
    "transformer_depth": "num_layers",
    "actor_width": "hidden_size",
    "actor_depth": "hidden_layers",
}
HEAD_SIZES = (3, 3, 3, 3, 2, 2)


def stored_answer() -> dict[str, np.ndarray]:
    """What the package answered of `stored_levels`."""
    with np.load(STORED) as archive:
        return {name: archive[name] for name in archive.files}


def stored_levels() -> list[Level]:
    """With the signs of their files, which the package was given."""
    documents = [read_document(REPOSITORY / f"levels/m/{name}.json") for name in STORED_LEVELS]
    return [fit_level(level_as_written(document), SIZES["m"]) for document in documents]


def write_stored() -> None:
    """Exports the levels, with side walls as public files have them, and asks the package."""
    with tempfile.TemporaryDirectory() as name:
        folder, files = Path(name), []
        for level, title in zip(stored_levels(), STORED_LEVELS, strict=True):
            document = export_kinetix(level)
            for wall, left in ((1, -5.0), (2, 5.0)):
                corners = ((left, 5.0), (left + 5.0, 5.0), (left + 5.0, 0.0), (left, 0.0))
                polygon = document["env_state"]["polygon"][wall]
                polygon["position"] = {"0": 0.0, "1": 0.0}
                polygon["vertices"] = {str(i): {"0": x, "1": y} for i, (x, y) in enumerate(corners)}
            files.append(folder / f"{title}.json")
            files[-1].write_text(json.dumps(document))
        request = {"levels": [str(file) for file in files], "moments": [40, 160], "seed": 7, "recalculate": True}
        checkpoints = [write_formula_policy(folder / name, **options) for name, options in STORED_POLICIES.items()]
        run_package(folder, request | {"checkpoints": [str(checkpoint) for checkpoint in checkpoints]})
        shutil.copy(folder / "answer.npz", STORED)


def write_formula_policy(folder: Path, **model: Any) -> Path:
    """A policy as the package saves it, whose parameters follow from names and indices; model: options of it."""
    model = {"legacy_entity_id": False, **model}
    sizes: dict[str, Any] = {field: model[name] for name, field in PACKAGE_SIZES.items() if name in model}
    places = layout(PolicyConfig(**sizes), FeatureCounts(**NUM_FEATURES), HEAD_SIZES)
    leaves = {leaf.name: formula(leaf.name, leaf.shape) for place in places for leaf in place.parts}
    write_policy(folder, leaves, model)
    return folder


def formula(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers that look random, so large that activations keep their size from layer to layer."""
    x = np.sin(12.9898 * np.arange(math.prod(shape)) + zlib.crc32(name.encode()) % 1000) * 43758.5453
    noise = (2.0 * (x - np.floor(x)) - 1.0).reshape(shape)  # from -1 to 1
    if name.endswith("kernel"):
        num_inputs = shape[0] if name.split("/")[-2] in ("query", "key", "value") else math.prod(shape[:-1])
        return (noise * math.sqrt(3.0 / num_inputs)).astype(np.float32)
    return (float(name.endswith("scale")) + 0.1 * noise).astype(np.float32)


def write_policy(folder: Path, leaves: dict[str, np.ndarray], model: dict[str, Any]) -> None:
    """params.safetensors and config.json, which leaves out the options that are the paper's."""
    folder.mkdir(exist_ok=True)
    header, data = {}, b""
    for name, leaf in leaves.items():
        dtype = {"float32": "F32", "float16": "F16"}[leaf.dtype.name]
        header[name] = {"dtype": dtype, "shape": leaf.shape, "data_offsets": [len(data), len(data) + leaf.nbytes]}
        data += leaf.tobytes()
    text = json.dumps(header).encode()
    (folder / "params.safetensors").write_bytes(len(text).to_bytes(8, "little") + text + data)
    (folder / "config.json").write_text(json.dumps({"model": model}))


def observed(levels: list[Level], answer: dict[str, np.ndarray]) -> EntityObs:
    """Our `entity_kinetix` of the states in an answer, with the touches that our engine would report of them."""
    batch = stack_worlds([levels[i] for i in answer["level"]])
    one_way = answer["obs.attention_mask"][:, 3]
    touching = (one_way | one_way.swapaxes(1, 2)) & np.asarray(batch.scene.shapes.can_touch)
    observation = OBSERVATIONS["entity_kinetix"]

    @jax.jit
    def observe(batch: Level, moving: Moving) -> EntityObs:
        return observation.join(observation.static(batch), observation.dynamic(moving))

    names = ("angle", "velocity", "angular_velocity", "has_stepped")
    # Walls stand where they stand: the package has the frames of two of them elsewhere.
    is_wall = np.arange(batch.angle.shape[1])[:, None] < NUM_WALLS
    position = np.where(is_wall, batch.position, answer["position"])
    moving = Moving(**{name: answer[name] for name in names}, position=position, touching=pack_bits(touching))
    return observe(jax.tree.map(jax.numpy.asarray, batch), moving)


def assert_same_observation(ours: EntityObs, answer: dict[str, np.ndarray], *, atol: float) -> None:
    """Masks, indices and the features of all that exists."""
    theirs = {name.removeprefix("obs."): array for name, array in answer.items() if name.startswith("obs.")}
    num_polygons = theirs["polygons"].shape[1]
    shape_mask = np.asarray(ours.shape_mask)
    np.testing.assert_array_equal(shape_mask[:, :num_polygons], theirs["polygon_mask"])
    np.testing.assert_array_equal(shape_mask[:, num_polygons:], theirs["circle_mask"])
    for name in ("joint_mask", "thruster_mask"):
        np.testing.assert_array_equal(getattr(ours, name), theirs[name], err_msg=name)
    masks = {
        "polygons": theirs["polygon_mask"],
        "circles": theirs["circle_mask"],
        "joints": theirs["joint_mask"],
        "thrusters": theirs["thruster_mask"],
    }
    for name, mask in masks.items():
        found = np.asarray(getattr(ours, name))
        assert found.shape == theirs[name].shape, name
        np.testing.assert_allclose(found[mask], theirs[name][mask], atol=atol, rtol=1e-5, err_msg=name)
        assert not found[~mask].any(), name
    ends = theirs["joint_indexes"]
    _assert_equal_where(theirs["joint_mask"], ours.joint_from, ends[..., 0])
    _assert_equal_where(theirs["joint_mask"], ours.joint_to, ends[..., 1])
    _assert_equal_where(theirs["thruster_mask"], ours.thruster_owner, theirs["thruster_indexes"])
    for number in range(4):
        np.testing.assert_array_equal(
            np.asarray(ours.attention_masks)[:, number], theirs["attention_mask"][:, number], err_msg=f"mask {number}"
        )


def _assert_equal_where(mask: np.ndarray, ours: Array, theirs: np.ndarray) -> None:
    np.testing.assert_array_equal(np.asarray(ours)[mask], theirs[mask])


if __name__ == "__main__":
    write_stored()
