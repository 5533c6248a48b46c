"""Measures of plasticity: their formulas in numpy, networks with known dormant units and rank, and runs."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from kinetix_dist.env.observations import Observation
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.plasticity import DELTA, NUM_SAMPLES, TAU, PlasticityConfig, effective_rank, make_measure
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.flat_mlp import FlatMlp
from kinetix_dist.models.hidden_units import COLLECTIONS
from kinetix_dist.models.policy import NETWORKS, PolicyConfig, make_policy
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import WorkerCurator
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from tests.learner.update_program import ACTIONS, OBSERVATIONS, make_problem
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config

STEPS, WORLDS, WIDTH = 5, 8, 6
DIVISION = Division(4, 1)


class _Vector(Observation):
    """A vector a world that changes from step to step."""

    gives = "vector"

    def static(self, levels):
        return None

    def dynamic(self, moving):
        return moving

    def join(self, static, dynamic):
        return dynamic


def _measure(policy, params, obs, memory=None):
    """obs: [T, W, features]; memory: [W, size] before them."""
    shape = obs.shape[:2]
    nothing = np.zeros(shape, np.float32)
    trajectory = Trajectory(
        dynamic_obs=obs, actions=nothing, log_probs=nothing, values=nothing, rewards=nothing, done_after=nothing > 0
    )
    measure = make_measure(policy, _Vector(), data_mesh(jax.devices()[:1]), division=DIVISION)
    static = StaticInput(obs=None, memory=memory)
    return {name: float(value) for name, value in measure(params, static, trajectory).items()}


def _policy(layers=1) -> tuple[FlatMlp, Any, np.ndarray]:
    policy = FlatMlp(flat_size=WIDTH, hidden_size=WIDTH, hidden_layers=layers, head_sizes=(3,), dtype=jnp.float32)
    obs = np.random.default_rng(0).normal(size=(STEPS, WORLDS, WIDTH)).astype(np.float32)
    return policy, policy.init(jax.random.key(0), obs[0]), obs


def _tower_params(params, layer):
    towers = params["params"]["towers"]
    return np.array(towers[f"kernel_{layer}"], np.float64), np.array(towers[f"bias_{layer}"], np.float64)


def _hidden(params, obs, layers):
    """Activations of each layer, float64: [samples, units]; actor and critic of the last one come last."""
    encoder = jax.tree.map(lambda x: np.array(x, np.float64), params["params"]["encoder"])
    x = np.tanh(obs.reshape(-1, WIDTH) @ encoder["kernel"] + encoder["bias"])
    found, both = [x], [x, x]
    for layer in range(layers):
        kernel, bias = _tower_params(params, layer)
        both = [np.tanh(one @ kernel[tower] + bias[tower]) for tower, one in enumerate(both)]
        found += both
    return found


def _dormant_share(layers):
    scores = [np.abs(layer).mean(axis=0) / np.abs(layer).mean() for layer in layers]
    return np.mean(np.concatenate(scores) <= TAU)


def _srank(features):
    values = np.linalg.svd(features, compute_uv=False)
    return next(k for k in range(1, len(values) + 1) if values[:k].sum() >= (1 - DELTA) * values.sum())


@pytest.mark.parametrize("layers", [1, 3])
def test_measures_are_the_formulas(layers):
    policy, params, obs = _policy(layers)
    params["params"]["towers"]["kernel_0"] = params["params"]["towers"]["kernel_0"].at[:, :, :2].multiply(1e-3)
    found, hidden = _measure(policy, params, obs), _hidden(params, obs, layers)
    assert found["dormant_share"] == pytest.approx(_dormant_share(hidden)) and found["dormant_share"] > 0
    assert found["actor_feature_rank"] == _srank(hidden[-2]) and found["critic_feature_rank"] == _srank(hidden[-1])
    squares = sum(np.square(np.array(leaf, np.float64)).sum() for leaf in jax.tree.leaves(params))
    assert found["weight_norm"] == pytest.approx(np.sqrt(squares), rel=1e-5)  # float32


def test_a_network_with_known_dormant_units_and_rank():
    """Actor: three independent units, a copy, one that is always zero and one a thousandth of the others. Critic: six
    copies of one."""
    policy, params, obs = _policy()
    kernel = np.zeros((2, WIDTH, WIDTH), np.float32)
    kernel[0, [0, 1, 2, 0], [0, 1, 2, 3]] = 1.0
    kernel[0, 3, 5] = 1e-3
    kernel[1, 0] = 1.0
    params["params"]["towers"]["kernel_0"] = jnp.asarray(kernel)
    params["params"]["encoder"] = {"kernel": jnp.eye(WIDTH), "bias": jnp.zeros(WIDTH)}
    found = _measure(policy, params, obs)
    assert found["dormant_share"] == pytest.approx(2 / 18)
    assert (found["actor_feature_rank"], found["critic_feature_rank"]) == (3, 1)


def test_a_layer_that_is_zero_is_dormant_and_has_no_rank():
    policy, params, obs = _policy()
    params["params"]["towers"]["kernel_0"] = jnp.zeros((2, WIDTH, WIDTH))
    found = _measure(policy, params, obs)
    assert found["dormant_share"] == pytest.approx(12 / 18)
    assert (found["actor_feature_rank"], found["critic_feature_rank"]) == (0, 0)


@pytest.mark.parametrize(("values", "rank"), [([1, 1, 1, 1], 4), ([98, 1.5, 0.4, 0.1], 2), ([99.5, 0.5, 0, 0], 1)])
def test_effective_rank_of_known_singular_values(values, rank):
    rng = np.random.default_rng(1)
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for size in (9, 4))
    features = left[:, :4] @ np.diag(np.asarray(values, float)) @ right
    assert float(effective_rank(jnp.asarray(features, jnp.float32))) == rank == _srank(features)


def test_a_large_batch_gives_a_part_of_its_samples():
    policy, params, obs = _policy()
    steps = 2 * NUM_SAMPLES // WORLDS
    obs = np.random.default_rng(2).normal(size=(steps, WORLDS, WIDTH)).astype(np.float32)
    found = _measure(policy, params, obs)
    # Each part of two worlds gives 512 samples, evenly over its steps and worlds.
    place = np.arange(NUM_SAMPLES // 4) * 2 * steps // (NUM_SAMPLES // 4)
    chosen = np.concatenate([obs[place // 2, 2 * part + place % 2] for part in range(4)])
    assert found["actor_feature_rank"] == _srank(_hidden(params, chosen, 1)[-2])


@pytest.mark.parametrize("network", sorted(set(NETWORKS) & {"transformer", "transformer_lean"}))
def test_a_transformer_notes_its_layers_and_computes_the_same(network):
    config = PolicyConfig(
        network=network, encoder_size=8, attention_features=8, num_layers=2, hidden_size=8, hidden_layers=2
    )
    _, state, (static, trajectory, _) = make_problem(data_mesh(jax.devices()[:1]), policy_config=config)
    policy = make_policy(config, ACTIONS.head_sizes)
    obs = OBSERVATIONS["entity"].join(static.obs, jax.tree.map(lambda x: x[0], trajectory.dynamic_obs))
    outputs, noted = policy.apply(state.params, obs, mutable=list(COLLECTIONS))
    jax.tree.map(np.testing.assert_array_equal, outputs, policy.apply(state.params, obs))
    layers = len(jax.tree.leaves(noted["hidden_units"]))
    assert layers == 2 * 2 + (4 if network == "transformer" else 2)  # towers; attention is a layer where it is gated
    measure = make_measure(policy, OBSERVATIONS["entity"], data_mesh(jax.devices()[:1]), division=DIVISION)
    found = measure(state.params, static, trajectory)
    assert 0 <= float(found["dormant_share"]) < 0.5 and 1 <= float(found["actor_feature_rank"]) <= 8


def test_a_memory_goes_on_from_that_of_the_policy_which_acted():
    """A given memory of zeros is the start of an episode, and another one is not."""
    config = PolicyConfig(network="flat", flat_size=WIDTH, hidden_size=WIDTH, recurrent="gru", memory_size=WIDTH)
    policy, obs = make_policy(config, (3,)), _policy()[2]
    is_first = np.zeros((STEPS, WORLDS), bool)
    params = policy.init(jax.random.key(0), obs.reshape(-1, WIDTH), is_first=is_first)
    begins = _measure(policy, params, obs)
    assert _measure(policy, params, obs, jnp.zeros((WORLDS, WIDTH))) == begins
    memory = np.random.default_rng(3).normal(size=(WORLDS, WIDTH)).astype(np.float32)
    goes_on = _measure(policy, params, obs, jnp.asarray(memory))
    _, noted = policy.apply(params, obs.reshape(-1, WIDTH), memory, is_first=is_first, mutable=list(COLLECTIONS))
    assert goes_on["dormant_share"] == pytest.approx(_dormant_share(jax.tree.leaves(noted["hidden_units"])))
    (actor,) = jax.tree.leaves(noted["features"])[:1]
    assert goes_on["actor_feature_rank"] == _srank(np.asarray(actor))


def test_a_network_that_notes_nothing_is_refused():
    class Silent(nn.Module):
        @nn.compact
        def __call__(self, obs):
            return (nn.Dense(3)(obs),), nn.Dense(1)(obs)[..., 0]

    policy, obs = Silent(), _policy()[2]
    with pytest.raises(
        ValueError, match=r"network Silent notes no hidden units, .*; set plasticity.every to 0, or let"
    ):
        _measure(policy, policy.init(jax.random.key(0), obs[0]), obs)


def test_a_run_reports_them_at_its_interval_and_has_the_same_parameters(tmp_path):
    rows = {}
    for every in (0, 2):
        config = dataclasses.replace(
            tiny_config(num_updates=3, num_curators=0), plasticity=PlasticityConfig(every=every)
        )
        trainer = ColocatedTrainer(config, LocalBackend(), [ProcessPlan(role="worker", index=0)])
        reporter = QuietReporter()
        run_updates(config, tmp_path / str(every), trainer, WorkerCurator(trainer), reporter=reporter)
        rows[every] = reporter.rows
    assert_same_bits(final_arrays(tmp_path / "2"), final_arrays(tmp_path / "0"))
    names = ("dormant_share", "actor_feature_rank", "critic_feature_rank", "weight_norm")
    assert [[f"learner/{name}" in row for name in names] for row in rows[2]] == [4 * [False], 4 * [True], 4 * [False]]
    assert not any(f"learner/{name}" in row for row in rows[0] for name in names)
    assert config.hash == tiny_config(num_updates=3).hash
    assert rows[2][1]["learner/weight_norm"] > 1
