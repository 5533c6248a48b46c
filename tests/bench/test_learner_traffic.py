"""Bytes and launches of compiled programs: counted by hand in a text, and of programs compiled for an H200."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import SingleDeviceSharding

from bench import learner_traffic
from bench.compiled_traffic import CompiledText, launches_of, loop_body
from bench.learner_traffic import COMPILER_OPTIONS, by_part, h200, part_of

CAN_COMPILE = importlib.util.find_spec("jax_cuda13_plugin") is not None
for_h200 = pytest.mark.skipif(not CAN_COMPILE, reason="compiling for an H200 needs the wheels of jax[cuda13]")

# A loop of three iterations: each adds row i of b [3, 256] to 1,024 bytes of a, then a product with work space.
TEXT = """HloModule small

FileNames
1 "models/gate.py"
2 "models/entity_transformer.py"

FunctionNames
1 "EntityTransformer._attention"
2 "_gate_forward"

FileLocations
1 {file_name_id=2 function_name_id=1 line=1 end_line=1 column=1 end_column=2}
2 {file_name_id=1 function_name_id=2 line=1 end_line=1 column=1 end_column=2}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=1}

%fused (p0: f32[256], p1: f32[3,256], p2: s32[]) -> f32[256] {
  %p0 = f32[256]{0} parameter(0)
  %p1 = f32[3,256]{1,0} parameter(1)
  %p2 = s32[] parameter(2)
  %zero = s32[] constant(0)
  %row = f32[1,256]{1,0} dynamic-slice(%p1, %p2, %zero), dynamic_slice_sizes={1,256}
  %flat = f32[256]{0} bitcast(%row)
  ROOT %sum = f32[256]{0} add(%p0, %flat)
}

%body (arg: (s32[], f32[256], f32[3,256])) -> (s32[], f32[256], f32[3,256]) {
  %arg = (s32[], f32[256]{0}, f32[3,256]{1,0}) parameter(0)
  %i = s32[] get-tuple-element(%arg), index=0
  %a = f32[256]{0} get-tuple-element(%arg), index=1
  %b = f32[3,256]{1,0} get-tuple-element(%arg), index=2
  %step = f32[256]{0} fusion(%a, %b, %i), kind=kLoop, calls=%fused, metadata={stack_frame_id=2}
  %square = f32[16,16]{1,0} bitcast(%step)
  %product = (f32[16,16]{1,0}, s8[4194304]{0}) custom-call(%square, %square), \
custom_call_target="__cublas$gemm", metadata={stack_frame_id=1}
  %next = f32[16,16]{1,0} get-tuple-element(%product), index=0
  %next_flat = f32[256]{0} bitcast(%next)
  ROOT %out = (s32[], f32[256]{0}, f32[3,256]{1,0}) tuple(%i, %next_flat, %b)
}

ENTRY %main (a: f32[256], b: f32[3,256]) -> f32[256] {
  %a.1 = f32[256]{0} parameter(0)
  %b.1 = f32[3,256]{1,0} parameter(1)
  %start = s32[] constant(0)
  %state = (s32[], f32[256]{0}, f32[3,256]{1,0}) tuple(%start, %a.1, %b.1)
  %loop = (s32[], f32[256]{0}, f32[3,256]{1,0}) while(%state), condition=%cond, body=%body, \
backend_config={"known_trip_count":{"n":"3"}}
  ROOT %end = f32[256]{0} get-tuple-element(%loop), index=1
}
"""


def test_a_launch_is_counted_by_what_it_takes_and_gives():
    program = CompiledText(TEXT)
    step, product = launches_of(program, loop_body(program))
    # The fusion reads a, one row of b and the index; the product both operands, without its work space.
    assert (step.read_bytes, step.written_bytes) == (1024 + 1024 + 4, 1024)
    assert (product.read_bytes, product.written_bytes) == (2 * 1024, 1024)


def test_a_launch_beside_others_is_counted_as_any():
    """What is started and awaited later has its operands in its result, too."""
    beside = TEXT.replace(
        "%step = f32[256]{0} fusion(",
        "%begun = ((f32[256]{0}, f32[3,256]{1,0}, s32[]), f32[256]{0}, u32[]) fusion-start(",
    ).replace(
        "  %square = f32[16,16]{1,0} bitcast(%step)",
        "  %step = f32[256]{0} fusion-done(%begun)\n  %square = f32[16,16]{1,0} bitcast(%step)",
    )
    program = CompiledText(beside)
    begun, _ = launches_of(program, loop_body(program))
    assert (begun.name, begun.read_bytes, begun.written_bytes) == ("begun", 1024 + 1024 + 4, 1024)


def test_a_loop_counts_its_iterations():
    assert [launch.times for launch in launches_of(CompiledText(TEXT))] == [3, 3]
    endless = TEXT.replace('{"known_trip_count":{"n":"3"}}', "{}")
    with pytest.raises(ValueError, match="loop: a loop of an unknown number of iterations"):
        launches_of(CompiledText(endless))


def test_parts_are_those_of_the_innermost_function():
    launches = launches_of(CompiledText(TEXT))
    assert [part_of(launch) for launch in launches] == ["gates", "attention"]
    gates, attention = by_part(launches)
    assert (gates.launches, gates.bytes) == (3, 3 * 3076)
    assert (attention.launches, attention.bytes) == (3, 3 * 3072)


def test_a_text_that_is_no_program_is_refused():
    with pytest.raises(ValueError, match="no computation ENTRY"):
        CompiledText("nothing")


def compiled(function, *shapes: tuple[tuple[int, ...], jnp.dtype]) -> CompiledText:
    sharding = SingleDeviceSharding(h200())
    arguments = [jax.ShapeDtypeStruct(shape, dtype, sharding=sharding) for shape, dtype in shapes]
    lowered = jax.jit(function, out_shardings=sharding).lower(*arguments)
    text = lowered.compile(compiler_options=COMPILER_OPTIONS).as_text()
    assert text is not None
    return CompiledText(text)


@for_h200
def test_an_elementwise_program_is_one_launch_that_reads_and_writes_once():
    x = ((4096, 128), jnp.bfloat16)
    (launch,) = launches_of(compiled(lambda x, y: jnp.tanh(x) * y + x, x, x))
    size = 4096 * 128 * 2
    assert (launch.read_bytes, launch.written_bytes) == (2 * size, size)


@for_h200
def test_a_loop_over_minibatches_reads_the_rows_it_gathers():
    """Three minibatches of 512 of 8,192 rows of 4 kB: no launch of an iteration reads more than these."""

    def sums(rows, index):
        return jax.lax.scan(lambda total, at: (total + jnp.sin(rows[at]).sum(axis=0), None), jnp.zeros(1024), index)[0]

    program = compiled(sums, ((8192, 1024), jnp.float32), ((3, 512), jnp.int32))
    launches = launches_of(program, loop_body(program))
    taken = 512 * 1024 * 4
    assert taken <= max(launch.read_bytes for launch in launches) < 1.01 * taken


@for_h200
def test_kernels_of_a_layer_move_less_than_xla():
    """The whole update with each of them compiles for a GPU that this machine does not have."""
    options = SimpleNamespace(dtype="bfloat16", encoder_size=128, minibatch=4096)
    moved = {}
    for kernels in ("xla", "fused"):
        options.kernels = kernels
        record = learner_traffic.measure("s", "transformer", options, h200())
        moved[kernels] = {row["part"]: row["read_bytes"] + row["written_bytes"] for row in record["parts"]}
    for part in ("gates", "attention", "feed forward", "messages", "encoders"):
        assert 0 < moved["fused"][part] < 0.8 * moved["xla"][part], part


@pytest.mark.skipif(CAN_COMPILE, reason="jax can compile for CUDA here")
def test_without_the_wheels_of_cuda_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["learner_traffic"])
    with pytest.raises(SystemExit) as end:
        learner_traffic.main()
    (line,) = capsys.readouterr().err.splitlines()
    assert end.value.code == 2
    assert 'install "jax[cuda13]"' in line
