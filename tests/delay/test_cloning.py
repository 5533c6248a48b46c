"""A chunk policy learns actions that follow from what is seen, and comes back from its checkpoint."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from kinetix_dist import prng
from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.delay.chunk_policy import (
    ChunkPolicy,
    FlowConfig,
    load_chunk_policy,
    make_chunk_policy,
    save_chunk_policy,
)
from kinetix_dist.delay.cloning import CloningConfig, Progress, clone
from kinetix_dist.delay.methods import Params, Plain, Plan, Seen, TrainingTimeRtc
from kinetix_dist.delay.windows import Samples, observations, steps_left
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.flow_network import FlowNetwork
from kinetix_dist.models.policy import PolicyConfig, make_encoder
from kinetix_dist.setting import ConfigError

ENCODER = PolicyConfig(network="flat", flat_size=32)
FLOW = FlowConfig(horizon=4, max_delay=2, width=32, token_width=8, num_layers=2, encoder=ENCODER)
CONFIG = CloningConfig(steps=300, report_every=100, batch=64, learning_rate=3e-3, warmup_steps=20, held_out=0.2)
ROWS_PER_EPISODE = 10


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", action_space="continuous", observation="flat"))


@pytest.fixture(scope="module")
def samples(env: Environment) -> Samples:
    """Two levels with an action each; numbers that nothing obeys are noise."""
    levels, _ = load_level_set("designed_s")
    prepared = env.prepare(jax.tree.map(lambda x: np.asarray(x)[:2], levels))
    rows = 40 * ROWS_PER_EPISODE
    episode = np.arange(rows) // ROWS_PER_EPISODE
    level = (episode % 2).astype(np.int32)
    bound = np.asarray(prepared.bound_heads)
    value = np.where(level == 0, -0.5, 0.3)[:, None] + np.zeros(6)
    noise = np.random.default_rng(0).uniform(-1, 1, value.shape)
    actions = np.where(bound[level], value, noise).astype(np.float32)
    return Samples(
        static_obs=prepared.static_obs,
        bound=bound,
        dynamic_obs=jax.tree.map(lambda x: np.asarray(x)[level], prepared.initial_obs),
        level=level,
        actions=actions,
        left=steps_left(episode),
        counts=np.ones(rows, bool),
    )


@pytest.fixture(scope="module")
def trained(env: Environment, samples: Samples) -> tuple[ChunkPolicy, Params, list[Progress]]:
    policy, reports = make_chunk_policy(FLOW, env), []
    return (
        policy,
        Params(clone(policy, env, samples, CONFIG, max_delay=FLOW.max_delay, on_report=reports.append)),
        reports,
    )


def test_the_policy_gives_the_actions_of_each_level(env: Environment, samples: Samples, trained: tuple) -> None:
    policy, params, reports = trained
    rows = jnp.array([0, ROWS_PER_EPISODE] * 8)
    obs, bound = observations(env, jax.tree.map(jnp.asarray, samples), rows)
    seen = Seen(obs, bound, prng.split(prng.key(5), len(rows)))
    nothing = Plan(jnp.zeros((len(rows), 4, 6)), 0, 0)
    for method in (Plain(), TrainingTimeRtc()):
        chunk = np.asarray(jax.jit(lambda m=method: m.plan(policy, params, seen, nothing))())
        for world, row in enumerate(np.asarray(rows)):
            is_bound = np.asarray(bound[world])
            expected = samples.actions[row][is_bound][0]
            assert np.abs(chunk[world][:, is_bound] - expected).mean() < 0.15
            assert (chunk[world][:, ~is_bound] == 0).all()
    assert [each.steps for each in reports] == [100, 200, 300]
    assert reports[-1].held_out_loss < 0.1 and reports[-1].loss < 0.5 * reports[0].loss


def test_what_follows_from_the_action_before_is_learned_with_history_alone(env: Environment, samples: Samples) -> None:
    """Actions alternate between -0.5 and 0.5, whatever is seen; half of the episodes begin with either."""
    rows = np.arange(len(samples.level))
    signs = np.where((rows + rows // ROWS_PER_EPISODE // 2) % 2, 0.5, -0.5).astype(np.float32)
    alternating = samples._replace(actions=np.broadcast_to(signs[:, None], samples.actions.shape))
    losses = []
    for history in (0, 1):
        policy, reports = make_chunk_policy(dataclasses.replace(FLOW, history=history), env), []
        clone(policy, env, alternating, CONFIG, on_report=reports.append)
        losses.append(reports[-1].held_out_loss)
    assert losses[1] < 0.5 * losses[0]


def test_cloning_again_gives_the_same_bits(env: Environment, samples: Samples) -> None:
    config = dataclasses.replace(CONFIG, steps=4, report_every=2)
    policy = make_chunk_policy(FLOW, env)
    first, again = (clone(policy, env, samples, config) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    other = clone(policy, env, samples, config, max_delay=2)  # with the same program
    differs = jax.tree.map(lambda x, y: (np.asarray(x) != np.asarray(y)).any(), first, other)
    assert any(jax.tree.leaves(differs))


def test_a_checkpoint_holds_the_policy_and_its_environment(env: Environment, trained: tuple, tmp_path: Path) -> None:
    policy, params, _ = trained
    save_chunk_policy(tmp_path / "run" / "checkpoints", 100, params.strong, FLOW, env.config, notes={"data": "d"})
    save_chunk_policy(tmp_path / "run" / "checkpoints", 200, params.strong, FLOW, env.config, notes={"data": "d"})
    loaded = load_chunk_policy(tmp_path / "run")
    assert loaded.path.name == "00000200" and loaded.config == FLOW and loaded.env == env.config
    assert load_chunk_policy(tmp_path / "run" / "checkpoints" / "00000100").num_updates == 100
    again, its_params = loaded.player(env)
    assert again == policy
    jax.tree.map(np.testing.assert_array_equal, its_params, params.strong)
    with pytest.raises(ValueError, match="encoder"):  # a flat network is of one size
        loaded.player(Environment(dataclasses.replace(env.config, size="m")))


def test_a_checkpoint_of_single_actions_is_no_chunk_policy() -> None:
    with pytest.raises(CheckpointError, match="is no policy of action chunks"):
        load_chunk_policy(Path("generalist"))


def test_actions_and_their_units() -> None:
    policy = make_chunk_policy(FLOW, Environment(EnvConfig(size="s", action_space="continuous")))
    np.testing.assert_allclose(policy.actions(jnp.full(6, -1.0)), [-1] * 4 + [0] * 2)
    np.testing.assert_allclose(policy.actions(jnp.full(6, 3.0)), [1] * 6)
    actions = jnp.array([0.2, -0.9, 1.0, 0.0, 0.25, 0.5])
    np.testing.assert_allclose(policy.actions(policy.units(actions)), actions, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: make_chunk_policy(FLOW, Environment(EnvConfig(size="s"))), "'continuous'"),
        (lambda: FlowConfig(horizon=4, max_delay=4), "a chunk has 4 actions"),
        (lambda: FlowConfig(width=33), "must be even"),
        (lambda: FlowConfig(horizon=0), "FlowConfig.horizon is 0"),
        (lambda: CloningConfig(steps=101, report_every=100), "multiple of report_every"),
        (lambda: make_encoder(PolicyConfig(recurrent="gru")), "recurrent 'none'"),
        (lambda: make_encoder(PolicyConfig(read_out="colour")), "'pooled'"),
    ],
)
def test_settings_that_cannot_be(make, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()


def test_a_network_without_an_embedding_is_named() -> None:
    class Alone(nn.Module):
        """A network of one's own that ends with outputs and value, whatever it is asked for."""

        @nn.compact
        def __call__(self, obs: jax.Array) -> tuple[tuple, jax.Array]:
            return (), nn.Dense(1)(obs)[..., 0]

    network = FlowNetwork(encoder=Alone(), horizon=2, num_dimensions=6, width=4, token_width=2, num_layers=1)
    with pytest.raises(ValueError, match="network Alone gives no embedding"):
        network.init(prng.key(0), jnp.zeros((1, 3)), jnp.zeros((1, 2, 6)), jnp.zeros((1, 2)))
