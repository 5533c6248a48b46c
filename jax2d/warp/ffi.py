"""The kernel as a JAX function: packs Scene and State into worlds-last tables and calls it through XLA's FFI.

Works inside jit, scan, shard_map and vmap on CPU and CUDA. Batches are explicit (leading world axis on every
field of Scene and State); axes that `vmap` maps are folded into the worlds. There are no gradients.

A program names the kernels that it launches, and Warp knows the launches that were traced in its process. So a program
that another process traced (`jax.export`) needs `Launch.register` first.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp

from jax2d.contact_report import ContactReport, contact_report
from jax2d.effects import Effects
from jax2d.fields import Array, Field, fields_of, num_elements
from jax2d.scene import BackendReport, Capacity, Controls, Scene, State, only_what_acts, pack_bits
from jax2d.settings import Settings
from jax2d.solver_numbers import flat, solver_numbers
from jax2d.warp.kernel import make_kernel
from jax2d.warp.layout import (
    REPORT_ROWS,
    Layout,
    bit_sets,
    cpp_name,
    packed_words,
    scene_floats,
    state_floats,
    whole_numbers,
)
from jax2d.warp.source import PARAMETERS
from jax2d.warp.startup import start
from jax2d.warp.variant import CompileOptions, KernelVariant

# The kernel's tables of the state, which come after four others.
STATE_ARGUMENT = 4
STATE_TABLES = ("state_table", "impulse_table", "key_table")

_STEPS_SHIFT = 32  # of the number of a launch: steps of physics, and below them worlds
_WORLDS = (1 << _STEPS_SHIFT) - 1
_IN_PROGRAM = re.compile(r"custom_call @(\w+)\(.*?\blaunch_id = (\d+)")
_VARIANTS: dict[str, KernelVariant] = {}  # of this process, by the name that programs call them by
_TRACING = threading.Lock()  # several threads may trace programs, but share a kernel and the number of its launch


class KernelCall(Protocol):
    """A kernel as a JAX function, as `wp.jax_kernel` makes it."""

    name: str  # by which programs call it
    input_output_aliases: dict[int, int]
    launch_id: int  # of the launch that is traced next

    def __call__(self, *tables: Array, launch_dims: int, output_dims: dict[str, tuple[int, ...]]) -> Any: ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneTables:
    """Scene tables of the kernel, worlds last."""

    floats: Array  # [rows, num_worlds] float32
    ints: Array  # [rows, num_worlds] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class StateTables:
    """State tables of the kernel, worlds last."""

    bodies: Array  # [6 n, num_worlds] float32: position, angle, velocity, angular velocity
    impulses: Array  # [5 J + 2 K + R, num_worlds] float32
    keys: Array  # [K, num_worlds] int32


def solver_parameters(settings: Settings) -> np.ndarray:
    """The run-time numbers of a settings object in the order of `source.PARAMETERS`, float32."""
    values = flat(solver_numbers(settings))
    return np.array([values[name] for name in PARAMETERS], np.float32)


def _worlds_last(x: Array, dtype: Any) -> jax.Array:
    """[num_worlds, ...] -> [rows, num_worlds]."""
    if 0 in np.shape(x):  # not captured by the program: jax 0.11 cannot compile some that capture what holds nothing
        return jnp.zeros((math.prod(np.shape(x)[1:]), np.shape(x)[0]), dtype)
    x = jnp.asarray(x)
    return x.reshape(x.shape[0], math.prod(x.shape[1:])).astype(dtype).T


def _bit_rows(matrix: Array) -> jax.Array:
    """[num_worlds, m, n] bool -> [m * words, num_worlds] int32 with a bit for each of n."""
    return _worlds_last(jax.lax.bitcast_convert_type(pack_bits(matrix), jnp.int32), jnp.int32)


def _packed_word(scene: Scene, word: dict[Field, int]) -> jax.Array:
    """[num_worlds, slots] int32 of the fields of a part, each at its position."""
    parts = [jnp.asarray(field.get(scene)).astype(jnp.int32) << shift for field, shift in word.items()]
    return functools.reduce(jnp.bitwise_or, parts)


def _worlds_first(rows: Array, *shape: int) -> jax.Array:
    return rows.T.reshape(rows.shape[1], *shape)


# One program each, also outside of jit, where every operation in them would be a program of its own to compile.


@jax.jit
def _scene_tables(scene: Scene) -> SceneTables:
    scene = only_what_acts(scene)
    words = {part: _packed_word(scene, word) for part, word in packed_words().items()}
    return SceneTables(
        floats=jnp.concatenate([_worlds_last(field.get(scene), jnp.float32) for field in scene_floats()]),
        ints=jnp.concatenate(
            [
                *(_bit_rows(field.get(scene)) for field in bit_sets()),
                *(_worlds_last(field.get(scene), jnp.int32) for field in whole_numbers()),
                *(_worlds_last(word, jnp.int32) for word in words.values()),
            ]
        ),
    )


@jax.jit
def _state_tables(state: State) -> StateTables:
    bodies, impulses = (
        jnp.concatenate([_worlds_last(field.get(state), jnp.float32) for field in state_floats(table)])
        for table in ("STATE", "IMPULSE")
    )
    return StateTables(bodies=bodies, impulses=impulses, keys=_worlds_last(state.contact_key, jnp.int32))


@jax.jit
def _control_table(controls: Controls) -> jax.Array:
    return jnp.concatenate([_worlds_last(field.get(controls), jnp.float32) for field in fields_of(Controls)])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _quantities(capacity: Capacity, table: str, rows: Array) -> list[jax.Array]:
    """[W, ...] of each quantity of a table of states."""
    first, sizes = Layout(capacity).rows()[table], capacity.sizes
    found = []
    for field in state_floats(table):
        start = first[cpp_name(field)]
        found.append(_worlds_first(rows[start : start + num_elements(field, sizes)], *field.shape(sizes)))
    return found


class WarpBackend:
    """Steps batches of worlds of one capacity with one kernel launch a call."""

    def __init__(
        self,
        capacity: Capacity,
        settings: Settings,
        dtype: np.dtype,
        effects: Effects,
        *,
        numbers: Any = None,
        report_contacts: bool = False,
        options: CompileOptions | None = None,
    ):
        if dtype != np.float32:
            raise ValueError(f"backend 'warp' computes in float32, not {dtype}; use backend='xla'")
        if settings.solver_batch_size > 1:
            raise ValueError(
                f"Settings.solver_batch_size is {settings.solver_batch_size}; backend 'warp' solves contacts one after "
                "another: use 1, or backend='xla'"
            )
        self.capacity = capacity
        self.num_contact_slots = capacity.contact_slots
        self.rows = Layout(capacity, report_contacts).rows()
        self.report_contacts = report_contacts
        self.numbers = solver_parameters(settings) if numbers is None else numbers
        start()
        variant = KernelVariant.of(capacity, settings, effects, options, report_contacts=report_contacts)

        def call_for(worlds: int) -> tuple[KernelCall, int]:
            chosen = variant.for_worlds(worlds) if jax.default_backend() == "gpu" else variant
            return _jax_call(chosen), chosen.threads(worlds)

        self._launch = functools.cache(lambda num_steps: _launch(call_for, self.rows["OUT"]["ROWS"], num_steps))

    def pack_scene(self, scene: Scene) -> SceneTables:
        """Tables of a batch of scenes. Inactive shapes get no mass and no partners, so that they do nothing."""
        tables = _scene_tables(scene)
        assert tables.floats.shape[0] == self.rows["SCENE"]["ROWS"], tables.floats.shape
        assert tables.ints.shape[0] == self.rows["INTS"]["ROWS"], tables.ints.shape
        return tables

    def pack_state(self, state: State) -> StateTables:
        return _state_tables(state)

    def bodies(self, packed: StateTables) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(position [W, n, 2], angle [W, n], velocity [W, n, 2], angular velocity [W, n])."""
        position, angle, velocity, angular_velocity = _quantities(self.capacity, "STATE", packed.bodies)
        return position, angle, velocity, angular_velocity

    def unpack_state(self, packed: StateTables) -> State:
        floats = {
            field.name: values
            for table, rows in (("STATE", packed.bodies), ("IMPULSE", packed.impulses))
            for field, values in zip(state_floats(table), _quantities(self.capacity, table, rows), strict=True)
        }
        return State(contact_key=packed.keys.T, **floats)

    def step_packed(
        self, scene: SceneTables, state: StateTables, controls: Controls, num_steps: int
    ) -> tuple[StateTables, BackendReport]:
        c, rows = self.capacity, self.rows["OUT"]
        worlds = state.bodies.shape[1]
        control_table = _control_table(controls)
        if control_table.shape[0] == 0:  # a table needs a row
            control_table = jnp.zeros((1, worlds), jnp.float32)
        bodies, impulses, keys, out = self._launch(num_steps)(
            scene.floats,
            scene.ints,
            control_table,
            jnp.asarray(self.numbers),
            state.bodies,
            state.impulses,
            state.keys,
        )
        bits = jax.lax.bitcast_convert_type(out, jnp.uint32)
        height = c.shapes * c.touch_words
        report = BackendReport(
            at_end=_worlds_first(bits[rows["AT_END"] : rows["AT_END"] + height], c.shapes, c.touch_words),
            during=_worlds_first(bits[rows["DURING"] : rows["DURING"] + height], c.shapes, c.touch_words),
            overflow=out[rows["OVERFLOW"]],
            limited=out[rows["LIMITED"]],
            open_joints=out[rows["OPEN_JOINTS"]],
            contacts=self._contacts(out) if self.report_contacts else None,
        )
        return StateTables(bodies=bodies, impulses=impulses, keys=keys), report

    def _contacts(self, out: Array) -> ContactReport:
        first, slots = self.rows["OUT"], self.capacity.contact_slots
        rows = {name: out[first[name] : first[name] + height * slots] for name, height in REPORT_ROWS}
        keys = rows.pop("CONTACT_KEY").T
        floats = {name: jax.lax.bitcast_convert_type(x, jnp.float32) for name, x in rows.items()}
        return contact_report(
            keys,
            point=_worlds_first(floats["CONTACT_POINT"], slots, 2),
            normal=_worlds_first(floats["CONTACT_NORMAL"], slots, 2),
            separation=floats["CONTACT_SEPARATION"].T,
            impulse=_worlds_first(floats["CONTACT_IMPULSE"], slots, 2),
            dropped=out[first["CONTACT_DROPPED"]],
        )


def _launch(
    call_for: Callable[[int], tuple[KernelCall, int]], out_rows: int, num_steps: int
) -> Callable[..., tuple[Array, ...]]:
    """The launch of a kernel and its threads, `call_for` a number of worlds, as a function of tables:

    (floats, ints, controls, parameters, bodies, impulses, keys) -> (bodies, impulses, keys, out), tables of
    [rows, num_worlds] but for the parameters."""

    @jax.custom_batching.custom_vmap
    def launch(*tables: Array) -> tuple[Array, ...]:
        state = tables[STATE_ARGUMENT:]
        worlds = state[0].shape[1]
        if worlds == 0:  # the kernel cannot be launched for 0 worlds
            return *state, jnp.zeros((out_rows, 0), jnp.int32)
        shapes = dict(zip(STATE_TABLES, (table.shape for table in state))) | {"out_table": (out_rows, worlds)}
        with _TRACING:
            call, threads = call_for(worlds)
            # Warp numbers launches in the order they are traced, and the number becomes part of the program: named by
            # what it says instead, equal programs are equal in every process and found in the compile cache.
            call.launch_id = (num_steps << _STEPS_SHIFT) | worlds
            return tuple(call(*tables, num_steps, launch_dims=threads, output_dims=shapes))

    @launch.def_vmap
    def launch_folded(axis_size: int, is_mapped: Sequence[bool], *tables: Array) -> tuple[tuple, tuple]:
        def fold(table: Array, mapped: bool) -> Array:
            """[mapped, rows, worlds], or [rows, worlds] for all alike -> [rows, mapped * worlds]."""
            if table.ndim == 1:  # the parameters, which are the engine's
                return table
            table = table if mapped else jnp.broadcast_to(table, (axis_size, *table.shape))
            return jnp.moveaxis(table, 0, 1).reshape(table.shape[1], axis_size * table.shape[2])

        def unfold(table: Array) -> Array:
            return jnp.moveaxis(table.reshape(table.shape[0], axis_size, worlds), 1, 0)

        worlds = tables[-1].shape[-1]
        out = tuple(map(unfold, launch(*map(fold, tables, is_mapped))))
        return out, (True,) * len(out)

    @jax.custom_jvp
    def without_gradient(*tables: Array) -> tuple[Array, ...]:
        return launch(*tables)

    @without_gradient.defjvp
    def no_gradient(primals: tuple, tangents: tuple) -> Any:
        del primals, tangents
        raise NotImplementedError("backend 'warp' has no gradients; build the engine with backend='xla'")

    return without_gradient


@functools.cache
def _jax_call(variant: KernelVariant) -> KernelCall:
    # Warp declares no type for a call without gradients.
    call = cast(KernelCall, wp.jax_kernel(make_kernel(variant), num_outputs=4, block_dim=variant.options.block_dim))
    # The state is stepped where it stands, which saves a copy in every pass of a loop. XLA does not always keep to it:
    # on a GPU it may let a call write straight into the stacked results of a scan, with other memory for the input. So
    # the kernel takes both, and copies where they differ; with `in_out_argnames` it would read what was never written.
    call.input_output_aliases = {STATE_ARGUMENT + table: table for table in range(len(STATE_TABLES))}
    _VARIANTS[call.name] = variant
    return call


@dataclasses.dataclass(frozen=True, kw_only=True)
class Launch:
    """A launch of a kernel in a program."""

    target: str  # by which the program calls the kernel
    variant: KernelVariant
    num_steps: int
    num_worlds: int

    def register(self) -> None:
        """Does what tracing would: loads the kernel, and registers its name and this launch."""
        start()
        call, c = _jax_call(self.variant), self.variant.capacity
        assert call.name == self.target, f"a program calls {self.target}, which is {call.name} here"
        rows = Layout(c, self.variant.report_contacts).rows()

        def table(name: str, dtype: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((max(1, rows[name]["ROWS"]), self.num_worlds), dtype)

        tables = [
            table("SCENE", jnp.float32),
            table("INTS", jnp.int32),
            table("CONTROLS", jnp.float32),
            jax.ShapeDtypeStruct((len(PARAMETERS),), jnp.float32),
            table("STATE", jnp.float32),
            table("IMPULSE", jnp.float32),
            jax.ShapeDtypeStruct((c.contact_slots, self.num_worlds), jnp.int32),
        ]
        launch = _launch(lambda worlds: (call, self.variant.threads(worlds)), rows["OUT"]["ROWS"], self.num_steps)
        jax.eval_shape(launch, *tables)


def targets() -> list[str]:
    """The names by which programs that were traced in this process may call kernels."""
    return list(_VARIANTS)


def launches_of(program: str) -> list[Launch]:
    """Launches in a program that this process lowered, given as text (MLIR), each once."""
    variants = dict(_VARIANTS)  # another thread may add one
    found = {(name, int(number)) for name, number in _IN_PROGRAM.findall(program) if name in variants}
    called = {name for name in variants if f"custom_call @{name}(" in program}
    assert called == {name for name, _ in found}, f"calls of {called} without the numbers of their launches"
    return [
        Launch(target=name, variant=variants[name], num_steps=number >> _STEPS_SHIFT, num_worlds=number & _WORLDS)
        for name, number in sorted(found)
    ]
