"""Layers added to a network that has learned: it begins as the same function, and each added part can learn."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Capacity
from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.models.added_layers import GATE_BIAS, num_layers_of, with_added_layers
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy
from tests.models.synthetic import random_obs

HEAD_SIZES = (3, 3, 3, 3, 2, 2)
CAPACITY = Capacity(polygons=3, circles=2, joints=2, thrusters=2)
SHALLOW = PolicyConfig(
    encoder_size=16, attention_features=8, num_heads=4, num_layers=1, hidden_size=16, hidden_layers=2, max_qk_norm=4.0
)
OBS = random_obs(6, CAPACITY)


def _network(**policy):
    module = make_policy(dataclasses.replace(SHALLOW, **policy), HEAD_SIZES)
    return module, init_params(module, OBS, jax.random.key(policy.get("num_layers", 1)))


def _learned(params):
    """Numbers as large as those of a network that has learned: streams of tokens and outputs that are not near 0."""
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(7), len(leaves))
    return jax.tree.unflatten(structure, [x + 0.5 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves)])


@functools.cache
def _apply(module):
    return jax.jit(module.apply)


def _outputs(module, params) -> np.ndarray:
    logits, value = _apply(module)(params, OBS)
    return np.concatenate([*[np.asarray(head) for head in logits], np.asarray(value)[:, None]], axis=1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("network", "read_out", "tolerance"),
    [("transformer_lean", "colour", 1e-6), ("transformer", "colour", 0.15), ("transformer_kinetix", "pooled", 0.15)],
)
def test_the_deeper_network_begins_as_the_same_function_and_learns_in_every_part(network, read_out, tolerance):
    policy = {"network": network, "read_out": read_out}
    shallow, params = _network(**policy)
    params = _learned(params)
    deep, fresh = _network(**policy, num_layers=3)
    given, initial = flatten_arrays(params), flatten_arrays(fresh)
    assert (num_layers_of(given), num_layers_of(initial)) == (1, 3)
    grown = unflatten_arrays(fresh, with_added_layers(given, initial))
    before = _outputs(shallow, params)

    def changed(params) -> float:
        """Root mean square change of the outputs, of their standard deviation."""
        return np.sqrt(np.mean((_outputs(deep, params) - before) ** 2)) / before.std()

    assert changed(grown) < tolerance
    # As they are initialised, added layers make another function of it: the test would see that.
    assert changed(unflatten_arrays(fresh, initial | given)) > 0.5

    def loss(params):
        outputs: Any = deep.apply(params, OBS)
        logits, value = outputs
        return jnp.sum(value**2) + sum(jnp.sum(jax.nn.log_softmax(head)[:, 0]) for head in logits)

    # Where kernels of an output are zero the ones before it have no gradient yet: one step, then all have.
    gradient = jax.jit(jax.grad(loss))
    step = jax.tree.map(lambda x, grad: x - 1e-2 * grad, grown, gradient(grown))
    assert not [name for name, grad in flatten_arrays(gradient(step)).items() if not np.any(grad)]


def test_nothing_but_added_layers_is_taken_of_the_other_parameters():
    _, params = _network()
    _, fresh = _network(num_layers=2)
    given, initial = flatten_arrays(params), flatten_arrays(fresh)
    grown = with_added_layers(given, initial)
    assert grown.keys() == initial.keys()
    for name, array in given.items():
        assert grown[name] is array
    added = {name: array for name, array in grown.items() if name not in given}
    assert all("_1_" in name for name in added) and len(added) == len([name for name in given if "_0_" in name])
    width = SHALLOW.encoder_size
    for name, array in added.items():
        if name.endswith("gate_bias"):
            assert (array == GATE_BIAS).all()
        if name.endswith(("gate_update_kernel", "gate_stream_kernel")):
            z = array[:, width : 2 * width]
            assert not z.any() and array[:, :width].any()
        if "messages" in name:
            assert not array.any()


def test_an_equally_deep_network_and_one_without_layers_stay_what_they_are():
    _, params = _network()
    given = flatten_arrays(params)
    assert with_added_layers(given, given) == given
    module = make_policy(PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1), HEAD_SIZES)
    flat = flatten_arrays(init_params(module, jnp.ones((1, 5)), jax.random.key(0)))
    assert num_layers_of(flat) == 0 and with_added_layers(flat, flat) == flat
