"""A scan whose loop lacks what is the same in all of its steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.actors import invariants


@jax.custom_vjp
def product(x, kernel):
    return x @ jnp.sin(kernel)


product.defvjp(lambda x, kernel: (product(x, kernel), None), lambda _, grad: (grad, grad))


def a_step(kernel, table, key):
    """Parts that are known before the loop: sin and cos of arrays, one within a function with a gradient of its own."""

    @jax.jit
    def inside(x, number):
        known = jnp.cos(table) * jnp.where(table > 0, 2.0, 3.0)
        return jnp.tanh(product(x, kernel)) + known + number.astype(jnp.float32)

    def step(carry, number):
        x, count = carry
        noise = jax.random.uniform(jax.random.fold_in(key, number), x.shape)
        return (inside(x, number) + noise, count + 1), (x.sum(), jnp.float32(7.0))

    return step


def arguments():
    rng = np.random.default_rng(0)
    return jnp.float32(rng.standard_normal((4, 4))), jnp.float32(rng.standard_normal((3, 4))), jax.random.key(3)


def rolled(scan):
    def run(kernel, table, key):
        carry = (jnp.zeros((3, 4)), jnp.int32(0))
        return scan(a_step(kernel, table, key), carry, jnp.arange(5, dtype=jnp.uint32))

    return run


def primitives_in_loops(jaxpr) -> set[str]:
    found: set[str] = set()

    def visit(inner, is_in_loop: bool) -> None:
        for operation in inner.eqns:
            if is_in_loop:
                found.add(operation.primitive.name)
            for value in operation.params.values():
                if isinstance(value, jax.extend.core.ClosedJaxpr):
                    visit(value.jaxpr, is_in_loop or operation.primitive.name == "scan")

    visit(jaxpr.jaxpr, False)
    return found


@pytest.mark.parametrize("jitted", [True, False])
def test_results_are_those_of_a_scan(jitted):
    ours, plain = (jax.jit(rolled(scan)) if jitted else rolled(scan) for scan in (invariants.scan, jax.lax.scan))
    for found, wanted in zip(jax.tree.leaves(ours(*arguments())), jax.tree.leaves(plain(*arguments())), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-6)  # compiled apart, some sums round otherwise


def test_what_is_known_before_is_not_in_the_loop():
    before = primitives_in_loops(jax.make_jaxpr(rolled(jax.lax.scan))(*arguments()))
    after = primitives_in_loops(jax.make_jaxpr(rolled(invariants.scan))(*arguments()))
    assert {"sin", "cos", "gt"} <= before
    assert not {"sin", "cos", "gt"} & after
    assert {"tanh", "dot_general"} <= after


def test_what_repeats_its_operand_is_done_in_the_loop():
    """Stored it would be as large as what it is added to."""
    row = jnp.arange(1000.0)

    def run(row):
        return invariants.scan(
            lambda x, _: (x + jnp.broadcast_to(row, x.shape), None), jnp.zeros((64, 1000)), jnp.arange(2)
        )

    [loop] = [each for each in jax.make_jaxpr(run)(row).jaxpr.eqns if each.primitive.name == "scan"]
    shapes = [each.aval.shape for each in loop.invars if isinstance(each.aval, jax.core.ShapedArray)]
    assert shapes == [(1000,), (64, 1000), (2,)]  # known, carried, steps
    np.testing.assert_array_equal(run(row)[0][5], 2 * row)


def test_effects_stay_in_the_loop(capfd):
    def step(x, _):
        jax.debug.print("a step")
        return x + 1, None

    x, _ = jax.jit(lambda: invariants.scan(step, jnp.int32(0), jnp.arange(3)))()
    jax.effects_barrier()
    assert int(x) == 3
    assert capfd.readouterr().out.count("a step") == 3


@jax.jit
def twice(x, known):
    return 2.0 * x + known


@jax.jit
def with_more_inside(x, known):
    return twice(x, known) * jnp.exp(known)


@jax.jit
def passed_on(x, known):
    return 3.0 * x, known


def test_a_function_in_which_nothing_is_known_before_stays_one_call_and_others_are_opened():
    """So that it is lowered once: three calls in the loop, one function."""

    def run(known):
        def step(x, _):
            x = twice(twice(x, known), known)
            x = with_more_inside(x, known)  # exp(known) comes before
            x, same = passed_on(x, known)
            return x, x + jnp.log(same)  # so does this

        return invariants.scan(step, jnp.ones(3), jnp.arange(2))

    known = jnp.array([2.0, 2.0, 2.0])
    traced = jax.make_jaxpr(run)(known)
    [loop] = [each for each in traced.jaxpr.eqns if each.primitive.name == "scan"]
    operations = loop.params["jaxpr"].jaxpr.eqns
    called = [each.params["jaxpr"] for each in operations if each.primitive.name in ("jit", "pjit")]
    assert len(called) == 3 and called[0] is called[1] is called[2]
    assert not {"exp", "log"} & primitives_in_loops(traced)
    x, y, expected = 1.0, [], run(known)
    for _ in range(2):
        x = 3.0 * ((2.0 * (2.0 * (2.0 * x + 2.0) + 2.0) + 2.0) * np.exp(2.0))
        y.append(x + np.log(2.0))
    np.testing.assert_allclose(expected[0], x, rtol=1e-5)
    np.testing.assert_allclose(expected[1][:, 0], y, rtol=1e-5)


@pytest.mark.parametrize("by", [0, 1, 2])
def test_a_gradient_is_refused(by):
    """The gradient would lack the rule of `product`, without a word."""

    def total(x, kernel, table):
        step = a_step(kernel, table, jax.random.key(0))
        return invariants.scan(step, (x, jnp.int32(0)), jnp.arange(3, dtype=jnp.uint32))[0][0].sum()

    with pytest.raises(TypeError, match="has no gradient"):
        jax.grad(total, argnums=by)(jnp.ones((3, 4)), *arguments()[:2])
