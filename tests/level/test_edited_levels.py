"""Levels of the generator of which a share is changed by mutators (`GeneratorConfig.edited_share`)."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from kinetix_dist.config import from_dict, to_dict
from kinetix_dist.env.action_spaces.colours import bound_colours
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.roles import Role
from kinetix_dist.recipes import recipe

PLAIN = GeneratorConfig(locomotion_share=0.5, locomotion_kinds=("arm", "pendulum"))
NUM_LEVELS = 256


def _levels(**config):
    return jax.device_get(
        generate_levels(jax.random.key(5), NUM_LEVELS, capacity_of_size("s"), dataclasses.replace(PLAIN, **config))
    )


@pytest.fixture(scope="module")
def plain():
    return _levels()


@pytest.fixture(scope="module")
def edited():
    return _levels(edited_share=0.5)


def _same(one, other) -> np.ndarray:
    """[n] bool, but for the rounding of another program."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    close = [np.isclose(a, b, rtol=1e-5, atol=1e-6).reshape(NUM_LEVELS, -1).all(1) for a, b in pairs]
    return np.logical_and.reduce(close)


def test_a_share_of_the_levels_is_changed_and_the_others_are_what_they_were(plain, edited):
    same = _same(plain, edited)
    # Changes that leave nothing to control are not made: at S every fifth level.
    assert 0.50 < same.mean() < 0.72
    assert _same(plain, _levels(edited_share=1.0)).mean() < 0.35


def test_changed_levels_are_levels(edited):
    scene, roles = edited.scene, edited.shape_role
    for role in (Role.GREEN, Role.BLUE):
        assert ((roles == role) & scene.shapes.active).sum(1).tolist() == [1] * NUM_LEVELS
    for leaf in jax.tree.leaves(edited):
        assert np.isfinite(leaf).all()
    masses = scene.shapes.inverse_mass
    assert (masses >= 0).all()
    assert bound_colours(edited).any(1).all()  # something is left to control
    # Derived after the changes: thrusters push shapes that are there and move.
    bodies = np.take_along_axis(np.asarray(masses), np.asarray(scene.thrusters.body), axis=1)
    assert (bodies[np.asarray(scene.thrusters.active)] > 0).all()


def test_every_kind_of_change_is_made(plain, edited):
    # S is full of shapes, so that one has to be removed before one is added.
    for before, after in (
        (plain.scene.shapes.active, edited.scene.shapes.active),
        (plain.scene.joints.active, edited.scene.joints.active),
        (plain.scene.thrusters.active, edited.scene.thrusters.active),
    ):
        assert (after.sum(1) < before.sum(1)).any()
    assert (edited.scene.thrusters.active.sum(1) > plain.scene.thrusters.active.sum(1)).any()
    assert (edited.shape_role != plain.shape_role).any()
    moved = np.abs(plain.position - edited.position).max((1, 2))
    gravity = np.abs(np.asarray(plain.scene.gravity) - np.asarray(edited.scene.gravity)).reshape(NUM_LEVELS, -1).max(1)
    assert (moved > 0).any() and (gravity > 0).any()


def test_more_changes_change_more(plain, edited):
    def changed(levels) -> int:
        pairs = zip(jax.tree.leaves(plain), jax.tree.leaves(levels), strict=True)
        return sum(int((~np.isclose(a, b, rtol=1e-5, atol=1e-6)).sum()) for a, b in pairs)

    assert changed(_levels(edited_share=0.5, num_changes=6)) > 1.3 * changed(edited)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("edited_share", 1.5, r"edited_share is 1\.5; chances are 0 to 1"),
        ("edited_share", float("nan"), "edited_share is nan; chances are 0 to 1"),
        ("num_changes", 0, "num_changes is 0; change 1 thing at least"),
    ],
)
def test_what_cannot_be_drawn_is_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        GeneratorConfig(**{field: value})


def test_edited_levels_change_the_hash():
    config = recipe("tiny")
    generator = dataclasses.replace(config.curriculum.generator, edited_share=0.3)
    with_edits = dataclasses.replace(config, curriculum=dataclasses.replace(config.curriculum, generator=generator))
    assert with_edits.hash != config.hash and from_dict(to_dict(with_edits)) == with_edits
