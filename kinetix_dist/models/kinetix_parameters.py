"""The parameters of the public package's transformer, as those of ours: every one of its leaves has one place here.

Ours has the same numbers grouped by input (`entity_transformer.py`): queries, keys and values of a layer are one
kernel, the six products of a gate three, actor and critic one stack. A leaf of ours is a row of leaves of the package,
each reshaped to two dimensions (or one) and joined along the last axis, or stacked along a new first one.

Names are those of the package's saved trees, "params/Transformer_0/tf_layers_0/ln1/scale": flax numbers layers of a
kind in the order in which they are called.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from kinetix_dist.models.policy import PolicyConfig

_TRANSFORMER, _TOWERS = "params/Transformer_0", "params/GeneralActorCriticRNN_0"
_GATE = {"update": (0, 2, 4), "stream": (1, 3), "reset": (5,)}  # r, z, h; r, z; h: Dense_K of the package


class ParameterTreeError(ValueError):
    """A tree of parameters that is not the package's: which leaf, and how it differs."""


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One leaf of the package."""

    name: str
    shape: tuple[int, ...]
    shape_here: tuple[int, ...] | None = None  # None: as it is


@dataclasses.dataclass(frozen=True)
class Place:
    """A leaf of ours and what it is made of."""

    name: str
    parts: tuple[Leaf, ...]
    stacked: bool = False  # along a new first axis, instead of joined along the last one


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureCounts:
    """Numbers in a row of each kind of entity."""

    polygon: int
    circle: int
    joint: int
    thruster: int


def from_package(
    arrays: Mapping[str, np.ndarray], config: PolicyConfig, features: FeatureCounts, head_sizes: tuple[int, ...]
) -> dict[str, Any]:
    """Parameters of `make_policy(config, head_sizes)`, {"params": ...}, from a tree of the package by name.

    Raises ParameterTreeError for the first leaf that is missing, not expected, of another shape or not finite.
    """
    places = layout(config, features, head_sizes)
    expected = {leaf.name: leaf.shape for place in places for leaf in place.parts}
    if missing := sorted(set(expected) - set(arrays)):
        raise ParameterTreeError(f"leaf {missing[0]} is missing ({len(missing)} of {len(expected)} are)")
    if extra := sorted(set(arrays) - set(expected)):
        raise ParameterTreeError(f"leaf {extra[0]} is not expected ({len(extra)} are not)")
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ParameterTreeError(f"leaf {name} is {list(arrays[name].shape)}, expected {list(shape)}")
        if not np.isfinite(arrays[name]).all():
            raise ParameterTreeError(f"leaf {name} holds a number that is not finite")
    params: dict[str, Any] = {}
    for place in places:
        parts = [arrays[leaf.name].reshape(leaf.shape_here or leaf.shape) for leaf in place.parts]
        *folders, name = place.name.split("/")
        inner = params
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[name] = np.stack(parts) if place.stacked else np.concatenate(parts, axis=-1)
    return {"params": params}


def layout(config: PolicyConfig, features: FeatureCounts, head_sizes: tuple[int, ...]) -> list[Place]:
    """Every leaf of ours. Together their parts are every leaf of the package."""
    size = config.encoder_size
    places = [
        *_dense("circle_encoder", "params/Dense_0", features.circle, size - 1),
        *_dense("polygon_encoder", "params/Dense_1", features.polygon, size - 1),
        *_dense("joint_encoder", "params/Dense_2", features.joint, size),
        *_dense("thruster_encoder", "params/Dense_3", features.thruster, size),
    ]
    for layer in range(config.num_layers):
        theirs = f"{_TRANSFORMER}/tf_layers_{layer}"
        places += [
            *_attention(f"attention_{layer}", f"{theirs}/attention1", config),
            *_norm(f"attention_{layer}_norm", f"{theirs}/ln1", size),
            *_gate(f"attention_{layer}_gate", f"{theirs}/gate1", size),
            *_dense(f"feed_forward_{layer}", f"{theirs}/dense1", size, size, separator="_"),
            *_norm(f"feed_forward_{layer}_norm", f"{theirs}/ln2", size),
            *_gate(f"feed_forward_{layer}_gate", f"{theirs}/gate2", size),
            *_dense(f"joint_messages_{layer}", f"{_TRANSFORMER}/joint_layers_{layer}", 3 * size, size, separator="_"),
            *_dense(
                f"thruster_messages_{layer}", f"{_TRANSFORMER}/thruster_layers_{layer}", 2 * size, size, separator="_"
            ),
        ]
    return places + _towers(config, head_sizes)


def num_package_parameters(places: list[Place]) -> int:
    return sum(math.prod(leaf.shape) for place in places for leaf in place.parts)


def _dense(ours: str, theirs: str, inputs: int, outputs: int, *, separator: str = "/") -> list[Place]:
    return [
        Place(f"{ours}{separator}kernel", (Leaf(f"{theirs}/kernel", (inputs, outputs)),)),
        Place(f"{ours}{separator}bias", (Leaf(f"{theirs}/bias", (outputs,)),)),
    ]


def _norm(ours: str, theirs: str, size: int) -> list[Place]:
    return [
        Place(f"{ours}_scale", (Leaf(f"{theirs}/scale", (size,)),)),
        Place(f"{ours}_offset", (Leaf(f"{theirs}/bias", (size,)),)),
    ]


def _gate(ours: str, theirs: str, size: int) -> list[Place]:
    kernels = [
        Place(f"{ours}_{name}_kernel", tuple(Leaf(f"{theirs}/Dense_{i}/kernel", (size, size)) for i in numbers))
        for name, numbers in _GATE.items()
    ]
    return [*kernels, Place(f"{ours}_bias", (Leaf(f"{theirs}/gating_bias", (size,)),))]


def _attention(ours: str, theirs: str, config: PolicyConfig) -> list[Place]:
    size, features = config.encoder_size, config.attention_features
    heads = (config.num_heads, features // config.num_heads)
    kinds = ("query", "key", "value")
    kernels = tuple(Leaf(f"{theirs}/{kind}/kernel", (size, *heads), (size, features)) for kind in kinds)
    biases = tuple(Leaf(f"{theirs}/{kind}/bias", heads, (features,)) for kind in kinds)
    return [
        Place(f"{ours}_qkv_kernel", kernels),
        Place(f"{ours}_qkv_bias", biases),
        Place(f"{ours}_out_kernel", (Leaf(f"{theirs}/out/kernel", (*heads, size), (features, size)),)),
        Place(f"{ours}_out_bias", (Leaf(f"{theirs}/out/bias", (size,)),)),
    ]


def _towers(config: PolicyConfig, head_sizes: tuple[int, ...]) -> list[Place]:
    """The package calls the layers of the actor first, then those of the critic."""
    places, width = [], config.encoder_size
    for layer in range(config.hidden_layers):
        both = [f"{_TOWERS}/DenseAndActivation_{i}/Dense_0" for i in (layer, config.hidden_layers + layer)]
        for name, shape in (("kernel", (width, config.hidden_size)), ("bias", (config.hidden_size,))):
            leaves = tuple(Leaf(f"{theirs}/{name}", shape) for theirs in both)
            places.append(Place(f"towers/{name}_{layer}", leaves, stacked=True))
        width = config.hidden_size
    return [
        *places,
        *_dense("towers/actor_output", f"{_TOWERS}/Dense_0", width, sum(head_sizes)),
        *_dense("towers/critic_output", f"{_TOWERS}/Dense_1", width, 1),
    ]
