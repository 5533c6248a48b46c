"""The policy networks: sizes, what they may not depend on, types, and refused configurations."""

from __future__ import annotations

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Capacity
from kinetix_dist.env.observations.flat import flatten
from kinetix_dist.models.entity_transformer import limit_queries_and_keys
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy, num_parameters
from tests.models.synthetic import random_obs

HEAD_SIZES = (3, 3, 3, 3, 2, 2)
CAPACITY = Capacity(polygons=3, circles=2, joints=2, thrusters=2)
SMALL = PolicyConfig(
    encoder_size=16, attention_features=8, num_heads=4, num_layers=2, hidden_size=16, hidden_layers=2, flat_size=16
)


@pytest.fixture(
    scope="module",
    params=[("transformer", "pooled"), ("transformer_lean", "pooled"), ("transformer_lean", "colour")],
    ids="-".join,
)
def small(request):
    obs = random_obs(6, CAPACITY)
    network, read_out = request.param
    policy = make_policy(dataclasses.replace(SMALL, network=network, read_out=read_out), HEAD_SIZES)
    return policy, _perturbed(init_params(policy, obs, jax.random.key(0))), obs


@functools.cache
def _apply(policy):
    return jax.jit(policy.apply)


def _perturbed(params):
    """Random numbers everywhere, so that biases and the near-zero actor output show in results."""
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    return jax.tree.unflatten(structure, [x + 0.2 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves)])


def _as_vector(output) -> np.ndarray:
    logits, value = output
    return np.concatenate([*[np.asarray(head) for head in logits], np.asarray(value)[:, None]], axis=1)


def test_the_transformer_has_the_parameters_of_the_paper_and_those_for_sliders():
    """Counted term by term, too: the paper's table of sizes leaves open where layers are counted."""
    obs = random_obs(1, CAPACITY)
    shapes = jax.eval_shape(make_policy(PolicyConfig(), HEAD_SIZES).init, jax.random.key(0), obs)
    encoders = sum((features + 1) * 128 for features in (27, 19, 22, 8)) + 3 * 128
    gate = 6 * 128 * 128 + 128
    attention = 3 * (128 + 1) * 16 + (16 + 1) * 128
    messages = (3 * 128 + 1) * 128 + (2 * 128 + 1) * 128
    layer = attention + 2 * gate + 2 * 2 * 128 + (128 + 1) * 128 + messages
    towers = 2 * 5 * (128 + 1) * 128 + (128 + 1) * (16 + 1)
    assert num_parameters(shapes) == encoders + 2 * layer + towers == 786_417 + 3 * 128


@pytest.mark.long
@pytest.mark.parametrize(("read_out", "max_qk_norm"), [("pooled", 0.0), ("colour", 0.0), ("pooled", 1.7)])
def test_a_lean_layer_is_what_its_formula_says(read_out, max_qk_norm):
    """Computed in numpy, in float64, world by world and token by token."""
    obs = random_obs(4, CAPACITY, seed=3)
    config = dataclasses.replace(
        SMALL, network="transformer_lean", num_layers=1, read_out=read_out, max_qk_norm=max_qk_norm
    )
    policy = make_policy(config, HEAD_SIZES)
    params = _perturbed(init_params(policy, obs, jax.random.key(0)))
    found = _as_vector(policy.apply(params, obs))
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params["params"])
    o = jax.tree.map(np.asarray, obs)
    if max_qk_norm:
        p = _with_short_queries_and_keys(p, max_qk_norm)
    for world in range(4):
        np.testing.assert_allclose(found[world], _lean_world(p, jax.tree.map(operator.itemgetter(world), o)), atol=2e-5)


def _with_short_queries_and_keys(p, max_norm):
    """The same layer with the norm's scale and offset in the weights, and these scaled head by head."""
    scale, offset = p["attention_0_norm_scale"], p["attention_0_norm_offset"]
    kernel = scale[:, None] * p["attention_0_qkv_kernel"]
    bias = p["attention_0_qkv_bias"] + offset @ p["attention_0_qkv_kernel"]
    features, width = SMALL.attention_features, SMALL.attention_features // SMALL.num_heads
    bias[features : 2 * features] = 0.0  # of keys
    norms = []
    for start in range(0, 2 * features, width):  # heads of queries, then of keys
        of_head = slice(start, start + width)
        norms.append(np.sqrt((kernel[:, of_head] ** 2).sum() + (bias[of_head] ** 2).sum()))
        factor = min(1.0, max_norm / norms[-1])
        kernel[:, of_head], bias[of_head] = factor * kernel[:, of_head], factor * bias[of_head]
    assert min(norms) < max_norm < max(norms)  # some are scaled and some are not
    plain = {"attention_0_norm_scale": np.ones_like(scale), "attention_0_norm_offset": np.zeros_like(offset)}
    return p | plain | {"attention_0_qkv_kernel": kernel, "attention_0_qkv_bias": bias}


def test_beyond_its_limit_a_query_is_turned_and_not_stretched():
    rng = np.random.default_rng(0)
    kernel, bias = rng.standard_normal((16, 24)).astype(np.float32), rng.standard_normal(24).astype(np.float32)
    kernel[:, 2:4] *= 0.1  # the queries of the second head, within the limit
    bias[2:4] *= 0.1
    weights, limited = (kernel, bias), functools.partial(limit_queries_and_keys, num_heads=4, max_norm=2.0)
    np.testing.assert_array_equal(limited(*weights)[0][:, 2:4], kernel[:, 2:4])
    np.testing.assert_array_equal(limited(*weights)[0][:, 16:], kernel[:, 16:])  # values
    wanted = rng.standard_normal((17, 24)).astype(np.float32)

    def loss(kernel, bias):
        kernel, bias = limited(kernel, bias)
        return (jnp.concatenate([kernel, bias[None]]) * wanted).sum()

    of_kernel, of_bias = jax.grad(loss, argnums=(0, 1))(*weights)
    gradient = np.concatenate([of_kernel, of_bias[None]])
    along = (gradient * np.concatenate([kernel, bias[None]])).reshape(17, 3, 4, 2).sum(axis=(0, 3))
    np.testing.assert_allclose(np.delete(along[:2].reshape(-1), 1), 0.0, atol=1e-4)
    np.testing.assert_array_equal(gradient[:, 2:4], wanted[:, 2:4])
    assert np.abs(gradient[:, :2]).max() > 0.1
    zeros = jax.grad(loss, argnums=(0, 1))(0 * kernel, 0 * bias)
    assert all(np.isfinite(x).all() for x in zeros)


def _norm(x, p, name):
    centred = x - x.mean(-1, keepdims=True)
    scale, offset = p[f"{name}_norm_scale"], p[f"{name}_norm_offset"]
    return centred / np.sqrt(np.square(centred).mean(-1, keepdims=True) + 1e-6) * scale + offset


def _lean_world(p, o) -> np.ndarray:
    size, features, heads = SMALL.encoder_size, SMALL.attention_features, SMALL.num_heads

    def encode(name, x):
        return np.tanh(x @ p[name]["kernel"] + p[name]["bias"])

    seen = o
    if "read_out" in p["towers"]:  # nothing but the read-out sees colours
        seen = jax.tree.map(np.copy, o)
        seen.joints[:, 12:16], seen.thrusters[:, 3:5] = 0.0, 0.0
    x = np.concatenate([encode("polygon_encoder", o.polygons), encode("circle_encoder", o.circles), np.ones((1, size))])
    joints, thrusters = encode("joint_encoder", seen.joints), encode("thruster_encoder", seen.thrusters)
    exists = np.append(o.shape_mask, True)
    sees = np.zeros((4, len(x), len(x)), bool)
    sees[:, :-1, :-1] = o.attention_masks
    sees[:, :, -1] = exists  # everyone sees the dummy, and the dummy everyone
    sees[:, -1, :] = exists

    qkv = _norm(x, p, "attention_0") @ p["attention_0_qkv_kernel"] + p["attention_0_qkv_bias"]
    query, key, value = qkv.reshape(len(x), 3, heads, -1).transpose(1, 2, 0, 3)  # [heads, n, d]
    out = np.zeros((len(x), heads, features // heads))
    for head in range(heads):
        score = query[head] @ key[head].T / np.sqrt(features // heads)
        weight = np.where(sees[head * 4 // heads], np.exp(score - score.max()), 0.0)
        total = weight.sum(1, keepdims=True)
        out[:, head] = weight @ value[head] / np.where(total == 0, 1.0, total)
    x = x + out.reshape(len(x), -1) @ p["attention_0_out_kernel"] + p["attention_0_out_bias"]

    hidden = np.maximum(_norm(x, p, "feed_forward_0") @ p["feed_forward_0_kernel"] + p["feed_forward_0_bias"], 0)
    x = x + hidden @ p["feed_forward_0_out_kernel"] + p["feed_forward_0_out_bias"]

    before = x.copy()
    for kind, entities, mask, ends in (
        ("joint", joints, o.joint_mask, np.stack([o.joint_from, o.joint_to], axis=1)),
        ("thruster", thrusters, o.thruster_mask, o.thruster_owner[:, None]),
    ):
        for number in np.flatnonzero(mask):
            given = np.concatenate([*before[ends[number]], entities[number]])
            x[ends[number][0]] += given @ p[f"{kind}_messages_0_kernel"] + p[f"{kind}_messages_0_bias"]

    pooled = _norm(x, p, "pooling")[exists].mean(0)
    towers, both = p["towers"], np.stack([pooled, pooled])
    for layer in range(SMALL.hidden_layers):
        kernel, bias = towers[f"kernel_{layer}"], towers[f"bias_{layer}"]
        both = np.tanh(np.einsum("ti,tio->to", both, kernel) + bias)
    value = both[1] @ towers["critic_output"]["kernel"] + towers["critic_output"]["bias"]
    if "read_out" in towers:
        return np.append(_read_by_colour(p, o, x, joints, thrusters, actor=both[0]), value)
    logits = both[0] @ towers["actor_output"]["kernel"] + towers["actor_output"]["bias"]
    return np.append(logits, value)


def _read_by_colour(p, o, x, joints, thrusters, *, actor):
    normal = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    logits, q = [], p["towers"]["read_out"]
    for kind, entity, count in (("motor", "joint", 4), ("thruster", "thruster", 2)):
        for colour in range(count):
            total = np.zeros(SMALL.hidden_size)
            for row in range(len(joints) if entity == "joint" else len(thrusters)):
                if entity == "joint":
                    exists, is_mine = o.joint_mask[row], o.joints[row, 12 + colour]
                    given = np.concatenate([normal[o.joint_from[row]], normal[o.joint_to[row]], joints[row]])
                else:
                    exists, is_mine = o.thruster_mask[row], o.thrusters[row, 3 + colour]
                    given = np.concatenate([normal[o.thruster_owner[row]], thrusters[row]])
                total += exists * is_mine * np.tanh(given @ p[f"{entity}_told_kernel"] + p[f"{entity}_told_bias"])
            hidden = np.tanh(total @ q[f"{kind}_sum_kernel"] + actor @ q[f"{kind}_actor_kernel"] + q[f"{kind}_bias"])
            logits.append(hidden @ q[f"{kind}_output"]["kernel"] + q[f"{kind}_output"]["bias"])
    return np.concatenate(logits)


def test_the_cnn_has_the_convolutions_of_the_paper():
    pictures = jax.ShapeDtypeStruct((1, 125, 125, 3), jnp.uint8)
    policy = make_policy(PolicyConfig(network="cnn"), HEAD_SIZES)
    shapes = jax.eval_shape(policy.init, jax.random.key(0), pictures)
    convolutions = (8 * 8 * 3 + 1) * 16 + (4 * 4 * 16 + 1) * 32
    embedding = 16 * 16 * 32  # 125 / 4 / 2, rounded up
    towers = 2 * ((embedding + 1) * 128 + 4 * (128 + 1) * 128) + (128 + 1) * (16 + 1)
    assert num_parameters(shapes) == convolutions + towers


@pytest.mark.parametrize("network", ["transformer", "transformer_lean", "flat", "cnn"])
def test_outputs_are_float32_heads_and_values_in_both_types(network):
    obs = random_obs(6, CAPACITY)
    obs = flatten(obs) if network == "flat" else obs
    if network == "cnn":
        obs = jnp.asarray(np.random.default_rng(0).integers(0, 256, (6, 33, 33, 3)), jnp.uint8)
    outputs = []
    for dtype in ("float32", "bfloat16"):
        policy = make_policy(dataclasses.replace(SMALL, network=network, dtype=dtype), HEAD_SIZES)
        params = init_params(policy, obs, jax.random.key(0))
        assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(params))
        logits, value = _apply(policy)(params, obs)
        assert [head.shape for head in logits] == [(6, n) for n in (3, 3, 3, 3, 2, 2)]
        assert value.shape == (6,) and value.dtype == logits[0].dtype == jnp.float32
        outputs.append(_as_vector((logits, value)))
    np.testing.assert_allclose(outputs[0], outputs[1], atol=0.05)  # bfloat16 has 8 bits; values are of order one


def test_first_policy_is_nearly_uniform():
    obs = random_obs(6, CAPACITY)
    policy = make_policy(SMALL, HEAD_SIZES)
    logits, _ = _apply(policy)(init_params(policy, obs, jax.random.key(0)), obs)
    assert max(float(jnp.max(jnp.abs(head))) for head in logits) < 0.1


@pytest.mark.long
def test_nothing_moves_what_is_the_same_for_all_keys(small):
    """Softmax ignores it (the formula above has it). The rounding of a gradient that should be zero let it grow."""
    policy, params, obs = small

    def loss(params):
        logits, value = policy.apply(params, obs)
        return sum((head**2).sum() for head in logits) + (value**2).sum()

    gradient = jax.grad(loss)(params)["params"]
    for layer in range(SMALL.num_layers):
        query, key, value = np.split(np.asarray(gradient[f"attention_{layer}_qkv_bias"]), 3)
        assert (key == 0).all() and np.abs(query).max() > 0 and np.abs(value).max() > 0


def test_order_of_entities_does_not_matter(small):
    policy, params, obs = small
    polygons, circles = np.array([2, 0, 1]), np.array([1, 0])
    shapes = np.concatenate([polygons, 3 + circles])
    new_slot = np.argsort(shapes)
    joints, thrusters = np.array([3, 1, 0, 2]), np.array([1, 0])
    shuffled = dataclasses.replace(
        obs,
        polygons=obs.polygons[:, polygons],
        circles=obs.circles[:, circles],
        joints=obs.joints[:, joints],
        thrusters=obs.thrusters[:, thrusters],
        shape_mask=obs.shape_mask[:, shapes],
        joint_mask=obs.joint_mask[:, joints],
        thruster_mask=obs.thruster_mask[:, thrusters],
        joint_from=new_slot[obs.joint_from[:, joints]],
        joint_to=new_slot[obs.joint_to[:, joints]],
        thruster_owner=new_slot[obs.thruster_owner[:, thrusters]],
        attention_masks=obs.attention_masks[:, :, shapes][:, :, :, shapes],
    )
    expected = _as_vector(_apply(policy)(params, obs))
    np.testing.assert_allclose(_as_vector(_apply(policy)(params, shuffled)), expected, atol=1e-5)  # order of sums


def test_what_does_not_exist_has_no_influence(small):
    policy, params, obs = small

    def noise(features, mask):
        return jnp.where(mask[..., None], features, 1e3)

    noisy = dataclasses.replace(
        obs,
        polygons=noise(obs.polygons, obs.shape_mask[:, :3]),
        circles=noise(obs.circles, obs.shape_mask[:, 3:]),
        thrusters=noise(obs.thrusters, obs.thruster_mask),
        joints=noise(obs.joints, obs.joint_mask),
    )
    # Joints and thrusters that exist are fixed to shapes that exist in real levels: drop the others here.
    exists = jnp.take_along_axis
    ends_exist = exists(obs.shape_mask, obs.joint_from, 1) & exists(obs.shape_mask, obs.joint_to, 1)
    owner_exists = exists(obs.shape_mask, obs.thruster_owner, 1)
    masks = {"joint_mask": obs.joint_mask & ends_exist, "thruster_mask": obs.thruster_mask & owner_exists}
    plain, noisy = dataclasses.replace(obs, **masks), dataclasses.replace(noisy, **masks)
    np.testing.assert_allclose(
        _as_vector(_apply(policy)(params, noisy)), _as_vector(_apply(policy)(params, plain)), atol=1e-6
    )


def test_each_mask_joint_and_thruster_has_influence(small):
    policy, params, obs = small
    everyone = jnp.ones_like(obs.shape_mask)
    both = jnp.ones_like(obs.attention_masks)
    full = dataclasses.replace(
        obs,
        shape_mask=everyone,
        attention_masks=both,
        joint_mask=jnp.ones_like(obs.joint_mask),
        thruster_mask=jnp.ones_like(obs.thruster_mask),
    )
    base = _as_vector(_apply(policy)(params, full))
    alone = jnp.eye(5, dtype=bool)
    changed = [dataclasses.replace(full, attention_masks=both.at[:, mask].set(alone)) for mask in range(4)]
    changed += [dataclasses.replace(full, joint_mask=full.joint_mask.at[:, 1].set(False))]
    changed += [dataclasses.replace(full, joint_to=(full.joint_to + 1) % 5)]
    changed += [dataclasses.replace(full, thruster_mask=full.thruster_mask.at[:, 1].set(False))]
    for other in changed:
        assert np.all(np.max(np.abs(_as_vector(_apply(policy)(params, other)) - base), axis=1) > 1e-5)


@pytest.mark.parametrize("network", ["transformer", "transformer_lean"])
def test_read_by_colour_no_colour_is_another_one(network):
    """Levels that differ by a permutation of colours have the same logits, permuted, and the same value."""
    obs = random_obs(6, CAPACITY)
    policy = make_policy(dataclasses.replace(SMALL, network=network, read_out="colour"), HEAD_SIZES)
    params = _perturbed(init_params(policy, obs, jax.random.key(0)))
    motors, thrusters = np.array([2, 0, 3, 1]), np.array([1, 0])
    swapped = dataclasses.replace(
        obs,
        joints=obs.joints.at[..., 12:16].set(obs.joints[..., 12 + motors]),
        thrusters=obs.thrusters.at[..., 3:5].set(obs.thrusters[..., 3 + thrusters]),
    )
    (logits, value), (others, other_value) = (_apply(policy)(params, x) for x in (obs, swapped))
    np.testing.assert_allclose(other_value, value, atol=1e-6)
    for head, source in enumerate([*motors, *(4 + thrusters)]):
        np.testing.assert_allclose(others[head], logits[source], atol=1e-5)
    assert float(jnp.abs(logits[0] - logits[1]).max()) > 1e-2  # or all heads could be alike


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("network", "lstm", "'lstm'; choose one of transformer, transformer_lean"),
        ("dtype", "float16", "'float16'; choose one of float32, bfloat16"),
        ("num_heads", 6, "6; it must be a multiple of 4"),
        ("attention_features", 12, "12; it must be a multiple of num_heads, 8"),
        ("encoder_size", 0, "0; it must be from 1 to 65536"),
        ("num_layers", 0, "0; it must be from 1 to 256"),
        ("read_out", "entity", "'entity'; choose one of pooled, colour"),
        ("max_qk_norm", -1.0, "-1.0; it must be 0 or more"),
        ("max_qk_norm", float("nan"), "nan; it must be a finite number"),
    ],
)
def test_a_bad_configuration_is_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        PolicyConfig(**{field: value})


def test_a_limit_of_queries_is_refused_where_there_are_none():
    with pytest.raises(ValueError, match=r"max_qk_norm is 4.0, but network 'flat' has no attention; set it to 0"):
        PolicyConfig(network="flat", max_qk_norm=4.0)


def test_reading_by_colour_is_refused_where_there_is_nothing_to_read():
    with pytest.raises(ValueError, match=r"network 'flat' has no tokens to read; .*'transformer_lean'"):
        PolicyConfig(network="flat", read_out="colour")
    with pytest.raises(ValueError, match=r"\(6, 6\) numbers and not one a colour .*use env.action_space"):
        make_policy(PolicyConfig(read_out="colour"), (6, 6))
