"""Steps a batch of worlds with one engine, or in groups whose engines have only the effects that the group calls for.

    worlds sorted by the cheapest engine that suffices -> `num_groups` equal groups -> the cheapest engine for each

Levels are drawn inside jit, so which engine a group gets is known only there: all of them (a few, `effect_variants.py`)
are compiled into the program and `lax.switch` picks one; shapes are static. The last engine is the full one, so that
nothing is refused. Worlds go in and come out in the order of the batch, and engines agree bit for bit within their
effects: results do not depend on the grouping. Under shard_map the order is that of one device's worlds.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.effects import called_for
from jax2d.engine import Engine
from jax2d.scene import Array, Controls, Scene, State, Touching
from kinetix_dist.env.autoreset import select_worlds_last


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Grouping:
    """Which world stands where, and who steps it. `G` groups of W_0 + W_1 + ... = W worlds."""

    world: Array  # [W] int32, number in the batch of the world at each place
    place: Array  # [W] int32, the inverse: where each world of the batch stands
    engine: Array  # [G] int32, which of the engines steps a group


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupedScene:
    """Packed scenes of the groups."""

    grouping: Grouping
    tables: tuple[Any, ...]  # G packed scenes, [field, W_g]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupedState:
    """Packed states of the groups."""

    tables: tuple[Any, ...]  # G packed states, [field, W_g]


class Stepper:
    """One engine and one group: packed tables as they are, worlds last."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def pack(self, scene: Scene, state: State) -> tuple[Any, Any]:
        """(packed scene, packed state) of a batch, [W, ...] on every field."""
        return self._engine.pack_scene(scene), self._engine.pack_state(state)

    def step(self, scene: Any, state: Any, controls: Controls, num_steps: int) -> tuple[Any, Touching]:
        return self._engine.step_packed(scene, state, controls, num_steps)

    def bodies(self, scene: Any, state: Any) -> tuple[Array, Array, Array, Array]:
        """(position [W, n, 2], angle [W, n], velocity [W, n, 2], angular velocity [W, n])."""
        del scene
        return self._engine.bodies(state)

    def select(self, scene: Any, mask: Array, chosen: Any, other: Any) -> Any:
        """`chosen` in worlds where mask [W], else `other`, both packed states."""
        del scene
        return select_worlds_last(mask, chosen, other)


class GroupedStepper:
    """The same for `num_groups` groups and engines of one capacity and solver, cheapest first, the last one full."""

    def __init__(self, engines: Sequence[Engine], num_groups: int) -> None:
        self._engines = tuple(engines)
        self._num_groups = num_groups

    def pack(self, scene: Scene, state: State) -> tuple[GroupedScene, GroupedState]:
        grouping = self._group(scene)
        scene, state = jax.tree.map(lambda x: jnp.asarray(x)[grouping.world], (scene, state))
        # All engines share one layout of their tables.
        packed_scene, packed_state = self._engines[-1].pack_scene(scene), self._engines[-1].pack_state(state)
        bounds = self._bounds(grouping.world.shape[0])
        return (
            GroupedScene(grouping=grouping, tables=_split_worlds_last(packed_scene, bounds)),
            GroupedState(tables=_split_worlds_last(packed_state, bounds)),
        )

    def step(
        self, scene: GroupedScene, state: GroupedState, controls: Controls, num_steps: int
    ) -> tuple[GroupedState, Touching]:
        grouping = scene.grouping
        bounds = self._bounds(grouping.world.shape[0])
        in_order = jax.tree.map(lambda x: x[grouping.world], controls)
        branches = [
            lambda scene, state, controls, engine=engine: engine.step_packed(scene, state, controls, num_steps)
            for engine in self._engines
        ]
        tables, parts = [], []
        for group, (start, end) in enumerate(itertools.pairwise(bounds)):
            after, touching = jax.lax.switch(
                grouping.engine[group],
                branches,
                scene.tables[group],
                state.tables[group],
                jax.tree.map(lambda x: x[start:end], in_order),  # noqa: B023 (called at once)
            )
            tables.append(after)
            parts.append(touching)
        touching = jax.tree.map(lambda *xs: jnp.concatenate(xs)[grouping.place], *parts)
        return GroupedState(tables=tuple(tables)), touching

    def bodies(self, scene: GroupedScene, state: GroupedState) -> tuple[Array, Array, Array, Array]:
        parts = [self._engines[-1].bodies(tables) for tables in state.tables]
        return jax.tree.map(lambda *xs: jnp.concatenate(xs)[scene.grouping.place], *parts)

    def select(self, scene: GroupedScene, mask: Array, chosen: GroupedState, other: GroupedState) -> GroupedState:
        bounds = self._bounds(scene.grouping.world.shape[0])
        masks = jnp.split(mask[scene.grouping.world], bounds[1:-1])
        return GroupedState(
            tables=tuple(select_worlds_last(*group) for group in zip(masks, chosen.tables, other.tables, strict=True))
        )

    def _group(self, scene: Scene) -> Grouping:
        asked = called_for(scene)
        is_covered = jnp.stack([engine.effects.covers_worlds(asked) for engine in self._engines], axis=1)  # [W, V]
        world = jnp.argsort(jnp.argmax(is_covered, axis=1), stable=True).astype(jnp.int32)
        num_worlds = world.shape[0]
        bounds = self._bounds(num_worlds)
        sorted_covered = is_covered[world]
        engine = [jnp.argmax(sorted_covered[a:b].all(axis=0)) for a, b in itertools.pairwise(bounds)]
        place = jnp.zeros_like(world).at[world].set(jnp.arange(num_worlds, dtype=jnp.int32))
        return Grouping(world=world, place=place, engine=jnp.stack(engine).astype(jnp.int32))

    def _bounds(self, num_worlds: int) -> list[int]:
        """First world of each group, then the number of worlds. Groups differ by one world at most."""
        groups = min(self._num_groups, num_worlds)
        return [group * num_worlds // groups for group in range(groups + 1)]


def _split_worlds_last(tree: Any, bounds: list[int]) -> tuple[Any, ...]:
    return tuple(jax.tree.map(lambda x, a=a, b=b: x[..., a:b], tree) for a, b in itertools.pairwise(bounds))
