"""`jax.lax.scan` that computes before the loop what is the same in all of its steps.

XLA leaves it in the loop on a GPU. In a rollout that is what depends on levels and parameters alone: parameters cast
and packed for products, the encoders of joints and thrusters and their share of messages, masks.

The step is traced once. Its operations are then gone through twice in the same order, those of called functions
included: before the loop those are computed whose operands are known there, in the loop the others. What only repeats
its operand is done in the loop again: stored, it would be read from memory. A jitted function in which nothing can be
computed before stays one call: of several calls the function is lowered once, and lowering a kernel takes a tenth of a
second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

# Primitives that stand for their operations, and the parameter that holds these.
_JITTED = {"jit": "jaxpr", "pjit": "jaxpr"}
_CALLS = _JITTED | dict.fromkeys(("closed_call", "custom_jvp_call", "custom_vjp_call"), "call_jaxpr")
_REPEATS = frozenset({"broadcast_in_dim", "iota"})


UNKNOWN = object()  # stands for a value that differs from step to step


def scan(step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, xs: Any) -> tuple[Any, Any]:
    """`jax.lax.scan(step, carry, xs)`. It has no gradient: asking for one raises TypeError."""
    of_one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
    traced, shapes = jax.make_jaxpr(step, return_shape=True)(carry, of_one)
    structure = jax.tree.structure(shapes)
    known: list[list[Any] | None] = []  # results of each operation, in order
    opened: list[bool] = []  # of each call of a jitted function, in order

    def before_loop(operation: JaxprEqn, operands: list[Any]) -> list[Any]:
        known.append(_computed(operation, operands) if _is_known(operation, operands) else None)
        return known[-1] or [UNKNOWN] * len(operation.outvars)

    def is_opened(called: ClosedJaxpr, operands: list[Any]) -> bool:
        opened.append(_gives_known(called, operands))
        return opened[-1]

    _go_through(traced, [UNKNOWN] * len(traced.in_avals), before_loop, is_opened)

    def body(carry: Any, x: Any) -> tuple[Any, Any]:
        remaining: Iterator[list[Any] | None] = iter(known)
        remaining_calls = iter(opened)

        def in_loop(operation: JaxprEqn, operands: list[Any]) -> list[Any]:
            results = next(remaining)
            is_stored = results is not None and operation.primitive.name not in _REPEATS
            return results if is_stored else _computed(operation, operands)

        given = jax.tree.leaves((carry, x))
        results = _go_through(traced, given, in_loop, lambda called, operands: next(remaining_calls))
        return jax.tree.unflatten(structure, results)

    return _without_gradient(jax.lax.scan(body, carry, xs))


@jax.custom_jvp
def _without_gradient(values: Any) -> Any:
    """`values`. Functions of the step are taken apart, so that rules of their own for a gradient would be left out."""
    return values


@_without_gradient.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    raise TypeError("a scan without invariants has no gradient; use jax.lax.scan")


def _go_through(
    traced: ClosedJaxpr,
    given: Sequence[Any],
    compute: Callable[[JaxprEqn, list[Any]], list[Any]],
    is_opened: Callable[[ClosedJaxpr, list[Any]], bool],
    caller: Any = None,
) -> list[Any]:
    """The results of what was traced, each operation by `compute(operation, operands)`.

    is_opened: whether a jitted function is gone through, too; else the call of it is an operation like others.
    caller: where the function was called that these operations stand for, for those without a place of their own.
    """
    inner: Jaxpr = traced.jaxpr
    values = dict(zip([*inner.constvars, *inner.invars], [*traced.consts, *given], strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else values[variable]

    for operation in inner.eqns:
        operands = [read(variable) for variable in operation.invars]
        name = operation.primitive.name
        names = source_info_util.current_name_stack() + operation.source_info.name_stack
        traceback = operation.source_info.traceback or caller
        with source_info_util.user_context(traceback, name_stack=names), operation.ctx.manager:
            called = operation.params[_CALLS[name]] if name in _CALLS else None
            if called is None or (name in _JITTED and not is_opened(called, operands)):
                results = compute(operation, operands)
            else:
                results = _go_through(called, operands, compute, is_opened, traceback)
        values.update(zip(operation.outvars, results, strict=True))
    return [read(variable) for variable in inner.outvars]


def _gives_known(called: ClosedJaxpr, operands: Sequence[Any]) -> bool:
    """Says whether an operation of a function, or a result of it, is known before the loop."""
    found = False

    def look(operation: JaxprEqn, operands: list[Any]) -> list[Any]:
        nonlocal found
        is_known = _is_known(operation, operands)
        found |= is_known and operation.primitive.name not in _REPEATS
        return [None if is_known else UNKNOWN] * len(operation.outvars)

    results = _go_through(called, operands, look, lambda called, operands: True)
    return found or any(value is not UNKNOWN for value in results)


def _is_known(operation: JaxprEqn, operands: list[Any]) -> bool:
    """Says whether an operation can be computed before the loop."""
    return not operation.effects and not any(value is UNKNOWN for value in operands)


def _computed(operation: JaxprEqn, operands: list[Any]) -> list[Any]:
    results = operation.primitive.bind(*operands, **operation.primitive.get_bind_params(operation.params))
    return list(results) if operation.primitive.multiple_results else [results]
