"""Policies of the public package: its parameters in our network give what they give in its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.checkpoint.arrays import read_safetensors
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.env.observations.kinetix_entities import NUM_FEATURES
from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.models.kinetix_parameters import (
    FeatureCounts,
    ParameterTreeError,
    from_package,
    layout,
    num_package_parameters,
)
from kinetix_dist.models.policy import PolicyConfig, make_policy, num_parameters
from tests.kinetix_package import (
    HEAD_SIZES,
    STORED_POLICIES,
    formula,
    observed,
    run_package,
    stored_answer,
    stored_levels,
    write_formula_policy,
)

FEATURES = FeatureCounts(**NUM_FEATURES)
NETWORKS = ("transformer_kinetix", "transformer_kinetix_paper")  # as in STORED_POLICIES
ATOL = 1e-5  # float32 sums of 128 terms in two orders; 1.4e-6 was found, and log-probabilities vary by 0.3


def outputs(network: str, arrays: Mapping[str, np.ndarray], obs: EntityObs) -> tuple[np.ndarray, np.ndarray]:
    """(log-probabilities of all choices [B, 16], value [B])."""
    config = PolicyConfig(network=network)
    policy = make_policy(config, HEAD_SIZES)
    logits, value = jax.jit(policy.apply)(from_package(arrays, config, FEATURES, HEAD_SIZES), obs)
    return np.concatenate([jax.nn.log_softmax(head) for head in logits], axis=-1), np.asarray(value)


def test_the_tree_has_786_369_numbers_and_each_has_a_place_in_ours() -> None:
    config = PolicyConfig(network="transformer_kinetix")
    places = layout(config, FEATURES, HEAD_SIZES)
    assert num_package_parameters(places) == 786_369
    leaves = {leaf.name: np.zeros(leaf.shape, np.float32) for place in places for leaf in place.parts}
    params = from_package(leaves, config, FEATURES, HEAD_SIZES)
    assert num_parameters(params) == 786_369
    some = observed(stored_levels(), stored_answer())
    shapes = jax.eval_shape(make_policy(config, HEAD_SIZES).init, jax.random.key(0), some)
    assert jax.tree.map(np.shape, params) == jax.tree.map(lambda x: x.shape, shapes)


@pytest.mark.parametrize("number", range(len(STORED_POLICIES)), ids=STORED_POLICIES)
def test_log_probabilities_and_values_are_those_that_the_package_computed(number: int, tmp_path: Path) -> None:
    answer, name = stored_answer(), list(STORED_POLICIES)[number]
    arrays = read_safetensors(write_formula_policy(tmp_path / name, **STORED_POLICIES[name]) / "params.safetensors")
    log_probs, value = outputs(NETWORKS[number], arrays, observed(stored_levels(), answer))
    np.testing.assert_allclose(log_probs, answer[f"log_probs.{number}"], atol=ATOL)
    np.testing.assert_allclose(value, answer[f"value.{number}"], atol=ATOL)
    wrong = 1 - number
    assert np.abs(value - answer[f"value.{wrong}"]).max() > 100 * ATOL  # the number of a kind has influence


@pytest.mark.parametrize("number", range(len(STORED_POLICIES)), ids=STORED_POLICIES)
def test_a_policy_that_the_package_made_and_saved_acts_as_in_the_package(
    number: int, public_levels: Path, tmp_path: Path
) -> None:
    files = sorted((public_levels / "m").glob("*.json"))[:8]
    made = {str(tmp_path / name): options | {"seed": 3} for name, options in STORED_POLICIES.items()}
    answer = run_package(
        tmp_path,
        {
            "levels": [str(file) for file in files],
            "moments": [60],
            "seed": 0,
            "create": made,
            "checkpoints": list(made),
        },
    )
    arrays = read_safetensors(Path(list(made)[number]) / "params.safetensors")
    obs = observed([load_kinetix(file) for file in files], answer)
    log_probs, value = outputs(NETWORKS[number], arrays, obs)
    np.testing.assert_allclose(log_probs, answer[f"log_probs.{number}"], atol=ATOL)
    np.testing.assert_allclose(value, answer[f"value.{number}"], atol=ATOL)


SMALL = PolicyConfig(
    network="transformer_kinetix", encoder_size=8, attention_features=8, num_layers=1, hidden_size=8, hidden_layers=1
)


def small_leaves() -> dict[str, np.ndarray]:
    places = layout(SMALL, FEATURES, HEAD_SIZES)
    return {leaf.name: formula(leaf.name, leaf.shape) for place in places for leaf in place.parts}


@pytest.mark.parametrize(
    ("name", "leaf", "message"),
    [
        ("params/Dense_1/kernel", None, r"leaf params/Dense_1/kernel is missing \(1 of 48 are\)"),
        ("params/Dense_9/kernel", np.zeros(1, np.float32), r"leaf params/Dense_9/kernel is not expected"),
        ("params/Dense_0/bias", np.zeros(8, np.float32), r"leaf params/Dense_0/bias is \[8\], expected \[7\]"),
        ("params/Dense_0/bias", np.full(7, np.nan, np.float32), "leaf params/Dense_0/bias holds a number that is not"),
    ],
)
def test_a_leaf_that_is_wrong_is_named(name: str, leaf: np.ndarray | None, message: str) -> None:
    leaves = dict(small_leaves())
    if leaf is None:
        del leaves[name]
    else:
        leaves[name] = leaf
    with pytest.raises(ParameterTreeError, match=message):
        from_package(leaves, SMALL, FEATURES, HEAD_SIZES)
