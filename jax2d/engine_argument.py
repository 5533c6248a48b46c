"""Engines as arguments of compiled programs, which share a program where they share what is compiled in.

    program = jax.jit(lambda argument, scene, state, controls: argument.engine().step_packed(scene, state, controls))
    program(VariantEngine.of(engine, "warp"), scene, state, controls)

A kernel is compiled for its `KernelVariant`, a program of the reference for its `Rules`. The numbers that settings
amount to (`solver_numbers`) come at run time: a study of many dt, sub-steps and stiffnesses compiles few programs.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any, Protocol

import jax

from jax2d.effects import Effects
from jax2d.engine import BACKENDS, Engine
from jax2d.scene import Capacity
from jax2d.settings import Settings
from jax2d.xla.rules import Rules, rules_of

if TYPE_CHECKING:
    from jax2d.warp.variant import KernelVariant


class EngineArgument(Protocol):
    """A pytree; its leaves are what a program takes at run time."""

    def engine(self) -> Engine: ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FixedEngine:
    """Any engine, compiled in with its numbers."""

    compiled: Engine = dataclasses.field(metadata={"static": True})

    def engine(self) -> Engine:
        return self.compiled


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """Choices that are compiled in."""

    capacity: Capacity
    backend: str  # of `jax2d.engine.BACKENDS`
    dtype: str
    program: KernelVariant | Rules
    settings: Settings = dataclasses.field(compare=False)  # any that lead to this program


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantEngine:
    """An engine of a variant, with the numbers of any settings that lead to it."""

    numbers: Any  # as the backend takes them
    variant: Variant = dataclasses.field(metadata={"static": True})

    @classmethod
    def of(cls, engine: Engine, backend: str) -> VariantEngine:
        """`engine` was built with this name of a backend, and for all effects; ValueError if for some of them."""
        if engine.effects != Effects.full(engine.capacity).known_to(engine.settings.solver):
            raise ValueError("the engine was compiled for some effects alone; use FixedEngine")
        if engine.report_contacts:
            raise ValueError("the engine reports contacts; use FixedEngine")
        variant = Variant(
            capacity=engine.capacity,
            backend=backend,
            dtype=engine.dtype.name,
            program=_program(engine, backend),
            settings=engine.settings,
        )
        return cls(numbers=engine.backend.numbers, variant=variant)

    def engine(self) -> Engine:
        """Inside a program the numbers are traced."""
        variant = self.variant
        backend = functools.partial(BACKENDS[variant.backend], numbers=self.numbers)
        return Engine(variant.capacity, settings=variant.settings, backend=backend, dtype=variant.dtype)


def _program(engine: Engine, backend: str) -> KernelVariant | Rules:
    if backend == "xla":
        return rules_of(engine.settings)
    from jax2d.warp.variant import KernelVariant

    return KernelVariant.of(engine.capacity, engine.settings, engine.effects)
