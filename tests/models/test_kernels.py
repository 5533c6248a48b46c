"""The gate's kernels compared with the formula in float64, as is XLA's bfloat16; where they are refused.

In the CPU interpreter everything but the products is what runs on a GPU: tiles, halves, rings, barriers, formulas.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.learner_traffic import COMPILER_OPTIONS, h200
from kinetix_dist.level.level import SIZES
from kinetix_dist.models import gate as xla
from kinetix_dist.models.kernels import nvrtc, support
from kinetix_dist.models.policy import PolicyConfig
from tests.helpers import present

E = support.WIDTH
has_pallas = pytest.mark.skipif(
    not jax.__version__.startswith(support.JAX_VERSIONS), reason=f"jax {jax.__version__} has other kernels"
)
for_h200 = pytest.mark.skipif(
    importlib.util.find_spec("jax_cuda13_plugin") is None,
    reason="compiling for an H200 needs the wheels of jax[cuda13]",
)
NAMES = ("out", "x", "y", "kernel_y", "kernel_x", "kernel_h", "bias")


def inputs(num_rows: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Arguments of the gate, and the gradient of its result; bfloat16 and float32 numbers as they are."""
    rng = np.random.default_rng(0)

    def rounded(*shape: int, scale: float = 1.0) -> np.ndarray:
        return np.asarray(jnp.asarray(scale * rng.standard_normal(shape), jnp.bfloat16).astype(jnp.float32))

    kernels = [rounded(E, n * E, scale=E**-0.5) for n in (3, 2, 1)]
    return [rounded(num_rows, E), rounded(num_rows, E), *kernels, rounded(E)], rounded(num_rows, E)


def in_float64(arguments: list[np.ndarray], grad: np.ndarray) -> list[np.ndarray]:
    """NAMES: result and gradients, by hand."""
    x, y, kernel_y, kernel_x, kernel_h, bias = (a.astype(np.float64) for a in arguments)
    (w_r, w_z, w_h), (u_r, u_z) = np.split(kernel_y, 3, axis=1), np.split(kernel_x, 2, axis=1)
    r = 1 / (1 + np.exp(-(y @ w_r + x @ u_r)))
    z = 1 / (1 + np.exp(-(y @ w_z + x @ u_z - bias)))
    h = np.tanh(y @ w_h + (r * x) @ kernel_h)
    grad_z = grad * (h - x) * z * (1 - z)
    grad_h = grad * z * (1 - h * h)
    grad_rx = grad_h @ kernel_h.T
    grad_r = grad_rx * x * r * (1 - r)
    return [
        (1 - z) * x + z * h,
        grad * (1 - z) + grad_rx * r + grad_r @ u_r.T + grad_z @ u_z.T,
        grad_r @ w_r.T + grad_z @ w_z.T + grad_h @ w_h.T,
        y.T @ np.concatenate([grad_r, grad_z, grad_h], axis=1),
        x.T @ np.concatenate([grad_r, grad_z], axis=1),
        (r * x).T @ grad_h,
        -grad_z.sum(axis=0),
    ]


def result_and_gradients(gate, arguments: list[np.ndarray], grad: np.ndarray) -> list[np.ndarray]:
    def both(x, y, *parameters):
        out, back = jax.vjp(gate, x.astype(jnp.bfloat16), y.astype(jnp.bfloat16), *parameters)
        return out, *back(grad.astype(jnp.bfloat16))

    return [np.asarray(a.astype(jnp.float32)) for a in jax.jit(both)(*map(jnp.asarray, arguments))]


def assert_no_worse_than_xla(found: list[np.ndarray], arguments: list[np.ndarray], grad: np.ndarray) -> None:
    wanted = in_float64(arguments, grad)
    today = result_and_gradients(xla.gate, arguments, grad)
    for name, a, b, exact in zip(NAMES, found, today, wanted):
        error, allowed = (np.linalg.norm(v - exact) / np.linalg.norm(exact) for v in (a, b))
        assert error <= allowed < 0.01, f"{name}: {error:.2%}, XLA {allowed:.2%}"


@has_pallas
@pytest.mark.parametrize("num_rows", [1, 335, 640])
def test_kernels_in_the_interpreter_are_no_worse_than_xla_in_bfloat16(num_rows: int, monkeypatch):
    """335 rows are no whole tiles; with two pairs of blocks some warpgroups have two tiles and some have one."""
    from kinetix_dist.models.kernels import gate_weights, tiles
    from kinetix_dist.models.kernels.gate import gate

    monkeypatch.setattr(tiles, "PAIRS", 2)
    monkeypatch.setattr(gate_weights, "PAIRS", 2)
    arguments, grad = inputs(num_rows)
    found = result_and_gradients(lambda *a: gate(*a, True), arguments, grad)
    assert_no_worse_than_xla(found, arguments, grad)


@pytest.mark.skipif(
    importlib.util.find_spec("jax_cuda13_plugin") is None,
    reason="compiling for an H200 needs the wheels of jax[cuda13]",
)
@has_pallas
def test_kernels_compile_for_an_h200():
    from kinetix_dist.models.kernels.gate import gate

    sharding = jax.sharding.SingleDeviceSharding(h200())

    def of(dtype, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype, sharding=sharding)

    rows, parameters = of(jnp.bfloat16, 1_000, E), [of(jnp.float32, E, n * E) for n in (3, 2, 1)]

    def both(grad, *arguments):
        out, back = jax.vjp(gate, *arguments)
        return out, back(grad)

    lowered = jax.jit(both, out_shardings=sharding).lower(rows, rows, rows, *parameters, of(jnp.float32, E))
    compiled = present(lowered.compile(compiler_options=COMPILER_OPTIONS).as_text())
    assert compiled.count('"mosaic_gpu') == 3


@has_pallas
def test_a_program_with_kernels_does_not_depend_on_what_was_traced_before():
    """Else a process that does things in another order would not find it in the compile cache."""
    from kinetix_dist.models.kernels.gate import pack
    from kinetix_dist.models.kernels.gate_backward import gate_backward
    from kinetix_dist.models.kernels.gate_forward import gate_forward

    rows = jax.ShapeDtypeStruct((128, E), jnp.bfloat16)
    weights = jax.eval_shape(pack, *inputs(1)[0][2:])
    forward = functools.partial(inspect.unwrap(gate_forward), keep=True)  # not behind its jit: traced by every call

    def program(kernel, *arguments) -> str:
        return jax.jit(lambda *arrays: kernel(*arrays)).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()

    def from_elsewhere() -> str:
        return program(forward, rows, rows, weights)

    first = program(forward, rows, rows, weights)
    assert "mosaic_gpu" in first
    program(inspect.unwrap(gate_backward), *[rows] * 5, weights)
    assert from_elsewhere() == first


@has_pallas
@pytest.mark.gpu
@pytest.mark.parametrize("num_rows", [64, 20_000, 163_840])
def test_kernels_on_a_gpu_are_no_worse_than_xla_and_the_same_every_time(num_rows: int):
    if why_not := support.why_no_device():
        pytest.skip(why_not)
    from kinetix_dist.models.kernels.gate import gate

    arguments, grad = inputs(num_rows)
    found = result_and_gradients(gate, arguments, grad)
    assert_no_worse_than_xla(found, arguments, grad)
    for _ in range(9):
        for first, again in zip(found, result_and_gradients(gate, arguments, grad)):
            np.testing.assert_array_equal(first, again)


LAYER = support.LayerShape(
    width=E,
    dtype="bfloat16",
    is_gated=True,
    num_heads=8,
    attention_features=16,
    num_tokens=10,
    num_joints=4,
    num_thrusters=2,
    num_features=27,
)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"width": 64}, "policy.encoder_size is 64"),
        ({"dtype": "float32"}, "policy.dtype is float32"),
        ({"num_heads": 4}, "policy.num_heads is 4"),
        ({"attention_features": 32}, "policy.attention_features is 32"),
        ({"is_gated": False}, "policy.network has no gates"),
        ({"num_tokens": 33}, "worlds have 33 tokens and the kernels take 32"),
        ({"num_joints": 30, "num_thrusters": 3}, "worlds have 33 ends of joints and thrusters and the kernels take 32"),
        ({"num_features": 128}, "entities have 128 features and the kernels take 127"),
        ({"num_joints": 0}, "worlds have no joints"),
        ({"num_thrusters": 0}, "worlds have no thrusters"),
    ],
)
def test_a_network_that_the_kernels_do_not_fit_is_refused(changed, says: str):
    layer = dataclasses.replace(LAYER, **changed)
    with pytest.raises(support.KernelError, match=says) as refused:
        support.uses_fused("fused", layer)
    assert str(refused.value).endswith("use 'auto' or 'xla'")
    assert not support.uses_fused("auto", layer)


def test_a_device_that_the_kernels_are_not_written_for_is_refused():
    if jax.local_devices()[0].platform == "gpu":
        pytest.skip("a GPU")
    with pytest.raises(support.KernelError, match=r"policy.kernels is 'fused', but (jax is|the device is a CPU)"):
        support.uses_fused("fused", LAYER)
    assert not support.uses_fused("auto", LAYER)


@pytest.mark.parametrize("size", SIZES)
def test_every_size_fits_the_kernels(size: str):
    capacity = SIZES[size]
    counts = {"num_tokens": capacity.shapes + 1, "num_joints": 2 * capacity.joints, "num_thrusters": capacity.thrusters}
    assert support.why_no_network(dataclasses.replace(LAYER, **counts)) == ""


def test_a_compiler_that_lacks_a_library_is_no_compiler(monkeypatch):
    """Some of its files are not installed: it loads, and takes no source."""

    class Incomplete:
        def __getattr__(self, name: str):
            return lambda *arguments: 11 if name == "nvrtcCompileProgram" else 0

    monkeypatch.setattr(nvrtc, "library", Incomplete)
    with pytest.raises(nvrtc.NvrtcError, match=r"nothing\.cu"):
        nvrtc.check_compiler.__wrapped__()


@has_pallas
def test_a_gate_is_the_same_whether_there_is_to_be_a_gradient(monkeypatch):
    """Rollouts, scoring and evaluation run a kernel that stores less."""
    from kinetix_dist.models.kernels import gate_weights, tiles
    from kinetix_dist.models.kernels.gate import gate

    monkeypatch.setattr(tiles, "PAIRS", 2)
    monkeypatch.setattr(gate_weights, "PAIRS", 2)
    arguments, _ = inputs(335)
    x, y = (jnp.asarray(each, jnp.bfloat16) for each in arguments[:2])
    parameters = list(map(jnp.asarray, arguments[2:]))
    alone = gate(x, y, *parameters, True)
    with_gradient, _ = jax.vjp(lambda *each: gate(x, y, *each, True), *parameters)
    # XLA compiles the interpreter's two programs differently: the last bit of a few numbers.
    np.testing.assert_allclose(alone.astype(jnp.float32), with_gradient.astype(jnp.float32), rtol=2**-7, atol=1e-6)


@pytest.mark.parametrize("network", ["transformer_lean", "flat", "cnn"])
def test_a_network_without_kernels_is_refused(network: str):
    with pytest.raises(ValueError, match=f"kernels is 'fused', but network '{network}' has no kernels"):
        PolicyConfig(network=network, kernels="fused")
    PolicyConfig(network=network, kernels="auto")


def test_kernels_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match=r"PolicyConfig.kernels is 'cuda'; choose one of auto, xla, fused"):
        PolicyConfig(kernels="cuda")
