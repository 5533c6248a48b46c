"""Programs of several devices use every input, and no input holds nothing: jax 0.11 cannot compile others."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from kinetix_dist.learner.sharding import DATA_AXIS, data_mesh, on_devices
from kinetix_dist.learner.update import make_update
from kinetix_dist.runtime.cores.learner_core import LearnerCore
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.rollout_core import Players, RolloutCore
from tests.runtime.runs import tiny_config


def shard_maps(jaxpr: Any) -> Iterator[Any]:
    """The bodies of all shard_maps in a program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "shard_map":
            yield equation.params["jaxpr"]
        else:
            for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
                yield from shard_maps(getattr(inner, "jaxpr", inner)) if hasattr(inner, "eqns") else ()


def faults_of(program: Any, *arguments: Any) -> list[str]:
    """Inputs of the shard_maps of a program that hold nothing or are not used."""
    (body,) = shard_maps(jax.make_jaxpr(program)(*arguments).jaxpr)
    used = {id(variable) for equation in body.eqns for variable in equation.invars}
    return [
        f"{number}: {variable.aval}"
        for number, variable in enumerate(body.invars)
        if 0 in variable.aval.shape or id(variable) not in used
    ]


@pytest.mark.parametrize("recurrent", ["none", "gru"])
def test_of_playing_and_of_learning(recurrent):
    config = tiny_config(num_updates=1)
    config = dataclasses.replace(config, policy=dataclasses.replace(config.policy, recurrent=recurrent))
    mesh = data_mesh(jax.devices()[:1])
    playing, groups = Playing(config, mesh), range(config.rollout.num_groups)
    env, policy, curriculum = playing.environment(config), playing.policy, playing.curriculum(config)
    # Traced ones: an exported program hides what it was made from.
    players = Players(env, policy, curriculum)
    play = RolloutCore(config, players, mesh, groups=groups).program
    update = make_update(policy, env.observation, env.action_distribution, config.ppo, mesh)
    state = LearnerCore(config, env, policy, mesh).shapes
    played = state.params, jax.eval_shape(curriculum.init), jnp.uint32(0)
    assert faults_of(play, *played) == []
    batch, _, _ = jax.eval_shape(play, *played)
    assert faults_of(update, state, *batch) == []
    # Worlds that go on: resets, and what is played from one update to the next.
    longer = dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, reset_every=2))
    goes_on = RolloutCore(longer, players, mesh, groups=groups)
    assert faults_of(goes_on._reset, *played[1:]) == []
    worlds = jax.eval_shape(goes_on._reset, *played[1:])
    assert faults_of(goes_on.program, *played[:2], worlds, played[2]) == []
    batch, _, _ = jax.eval_shape(goes_on.program, *played[:2], worlds, played[2])
    assert faults_of(update, state, *batch) == []


def test_inputs_that_are_empty_or_not_used_stay_what_they_were():
    mesh, whole, worlds = data_mesh(jax.devices()[:1]), PartitionSpec(), PartitionSpec(DATA_AXIS)

    def sizes(tree: dict[str, Any], rows: Any) -> Any:
        return rows + tree["used"], tree["empty"]

    call = on_devices(sizes, mesh, in_specs=(whole, worlds), out_specs=(worlds, whole))
    tree = {"used": jnp.float32(2), "unused": jnp.ones(3), "empty": jnp.zeros((3, 0), jnp.int8)}
    assert faults_of(call, tree, jnp.arange(4.0)) == []
    found, empty = call(tree, jnp.arange(4.0))
    np.testing.assert_array_equal(found, [2, 3, 4, 5])
    assert empty.shape == (3, 0) and empty.dtype == jnp.int8
