"""PAIRED: what its teacher comes to build, who plays what, and what regret is, with students that are scripted."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.actors.outcomes import no_outcomes
from kinetix_dist.config import ConfigError
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.paired import PairedSummary
from kinetix_dist.learner.sharding import data_mesh, replicate
from kinetix_dist.level.level import SIZES, Role
from kinetix_dist.messages import Trajectory
from kinetix_dist.models.several_policies import SeveralPolicies, joined_shares, share_of
from kinetix_dist.runtime.cores.curriculum_state import PpoAgents
from tests.curator.made import curriculum_of
from tests.runtime.runs import tiny_config

CAPACITY = SIZES["s"]
GROUPS, PER_GROUP = 4, 24
NUM_LEVELS = GROUPS * PER_GROUP // 2


class _Scripted:
    """A student that learns nothing."""

    def init(self):
        return jnp.zeros(())

    def learn(self, state, static, trajectory, last_value):
        return state, {"skipped_steps": jnp.zeros(())}


class _Agents(PpoAgents):
    """The teacher is that of a run, with its PPO."""

    def student(self) -> Any:
        return _Scripted()

    def static_input(self, levels) -> Any:
        return None


def _paired(**paired):
    none: Any = None  # no environment and no policy
    agents = _Agents(tiny_config(num_updates=1), none, none, data_mesh())
    config = CurriculumConfig(name="paired", paired=PairedConfig(hidden_size=32, **paired))
    return curriculum_of(config, PER_GROUP, capacity=CAPACITY, agents=agents)


def _propose(curriculum, state, update, groups=tuple(range(GROUPS))):
    key, groups = jax.random.fold_in(jax.random.key(0), update), jnp.asarray(groups)
    return curriculum.propose(state, jax.vmap(lambda group: jax.random.fold_in(key, group))(groups), groups)


@functools.cache
def _compiled():
    """(init, propose(state, groups)) of a teacher; what it learns from, and how, is not part of them."""
    curriculum = _paired()
    return jax.jit(curriculum.init), jax.jit(lambda state, groups: _propose(curriculum, state, 9, groups))


def _start():
    """A state that lies where a run has it: on the devices of a mesh."""
    return replicate(_compiled()[0](), data_mesh())


ALL_GROUPS = jnp.arange(GROUPS)


def _outcome(mean_return, max_return, num_episodes=2):
    """Outcome of worlds [W] whose students are scripted; a second student's trajectory of no steps."""
    none, no_steps = no_outcomes(mean_return.size), jnp.zeros((mean_return.size // 2, 0))
    trajectory = Trajectory(
        dynamic_obs=no_steps,
        actions=no_steps,
        log_probs=no_steps,
        values=no_steps,
        rewards=no_steps,
        done_after=no_steps > 0,
    )
    summary = PairedSummary(max_return=max_return, trajectory=trajectory, last_value=no_steps.sum(1))
    return dataclasses.replace(
        none, num_finished=none.num_finished + num_episodes, return_sum=num_episodes * mean_return, summary=summary
    )


def _has_red(levels):
    return (levels.scene.shapes.active & (levels.shape_role == Role.RED)).any(1)


def _has_joint(levels):
    return levels.scene.joints.active.any(1)


def _has_wide_green(levels):
    """Green is a circle, or its longer side is above the middle of what there is."""
    shapes = levels.scene.shapes
    reach = jnp.concatenate([jnp.abs(shapes.vertices).max((2, 3)), shapes.radius], axis=1)
    return (shapes.active & (levels.shape_role == Role.GREEN) & (reach > 0.36)).any(1)


@pytest.mark.long
@pytest.mark.parametrize(
    "feature", [_has_red, *(pytest.param(f, marks=pytest.mark.slow) for f in (_has_joint, _has_wide_green))]
)
def test_the_teacher_comes_to_build_what_the_antagonist_alone_can_do(feature):
    """The antagonist solves levels with the feature, the protagonist none: their share rises, and falls without."""
    curriculum = _paired(learning_rate=3e-3)

    @jax.jit
    def update(state, number, is_wanted):
        proposal = _propose(curriculum, state, number)
        is_it = feature(proposal.levels)
        is_antagonist = jnp.arange(GROUPS * PER_GROUP) % PER_GROUP >= PER_GROUP // 2
        gained = 1.0 * is_antagonist * (is_it == is_wanted)
        return curriculum.observe(state, proposal, _outcome(gained, gained)), is_it.mean()

    start = _start()
    last_quarter = {}
    for is_wanted in (True, False):
        state, shares = start, []
        for number in range(50):
            state, share = update(state, number, is_wanted)
            shares.append(float(share))
        last_quarter[is_wanted] = np.mean(shares[-10:])
    assert last_quarter[True] > 0.8 and last_quarter[False] < 0.15, last_quarter


@pytest.mark.long
@pytest.mark.parametrize(("antagonist_return", "regret"), [("max", 4.0 - 1.5), ("mean", 3.0 - 1.5)])
def test_regret_is_what_the_antagonist_got_more_on_the_same_level(antagonist_return, regret):
    """Protagonists have a mean of 1.5, antagonists of 3 and at best 4; what is best of the protagonist has no part."""
    curriculum = _paired(antagonist_return=antagonist_return, epochs=1)
    state = _start()
    is_antagonist = jnp.arange(GROUPS * PER_GROUP) % PER_GROUP >= PER_GROUP // 2
    mean, best = jnp.where(is_antagonist, 3.0, 1.5), jnp.where(is_antagonist, 4.0, 9.0)
    proposal = _compiled()[1](state, ALL_GROUPS)
    after = jax.jit(curriculum.observe)(state, proposal, _outcome(mean, best))
    metrics = curriculum.metrics(after, 1)
    assert metrics["curriculum/regret"] == pytest.approx(regret)
    assert metrics["curriculum/protagonist_return"] == pytest.approx(1.5)
    assert all(np.isnan(value) for value in curriculum.metrics(state, 0).values())


def test_both_students_play_the_same_levels_and_no_two_levels_are_alike():
    levels = _compiled()[1](_start(), ALL_GROUPS).levels
    ours, theirs = (share_of(levels, student, 2, PER_GROUP) for student in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)
    assert len(np.unique(np.asarray(ours.position).reshape(NUM_LEVELS, -1), axis=0)) == NUM_LEVELS


def test_levels_of_a_group_do_not_depend_on_which_other_groups_are_drawn():
    state, propose = _start(), _compiled()[1]
    together = propose(state, ALL_GROUPS)
    among_others = [propose(state, jnp.asarray(groups)) for groups in ((0, 1, 8, 9), (7, 6, 2, 3))]

    def joined(one, other):
        half = len(one) // 2
        return np.concatenate([one[:half], other[half:]])

    jax.tree.map(
        np.testing.assert_array_equal, together.levels, jax.tree.map(joined, *(p.levels for p in among_others))
    )
    actions = [proposal.tags.actions for proposal in among_others]
    np.testing.assert_array_equal(together.tags.actions, joined(*actions))
    assert not np.array_equal(actions[0][: NUM_LEVELS // 2], actions[1][: NUM_LEVELS // 2])


def test_each_student_acts_with_its_own_parameters():
    """Two groups of four worlds, whose policy multiplies what it sees."""

    class Policy:
        def apply(self, params, obs):
            return (obs * params,), obs[:, 0] + params

    obs = jnp.arange(16.0).reshape(8, 2)
    (outputs,), values = SeveralPolicies(Policy(), 2, 4).apply((10.0, -1.0), obs)
    own = np.array([10.0, 10.0, -1.0, -1.0] * 2)
    np.testing.assert_array_equal(outputs, obs * own[:, None])
    np.testing.assert_array_equal(values, obs[:, 0] + own)
    np.testing.assert_array_equal(joined_shares([share_of(obs, i, 2, 4) for i in (0, 1)], 4), obs)


def _config(num_steps=8, max_steps=8, **curriculum):
    config = tiny_config(num_updates=1)
    return dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, max_steps=max_steps),
        curriculum=CurriculumConfig(**curriculum),
        rollout=dataclasses.replace(config.rollout, num_steps=num_steps),
    )


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (
            lambda: curriculum_class(CurriculumConfig(name="paired"), 5),
            ValueError,
            r"^'paired' shares the worlds of a group between two students, but a group has 5; change rollout.num_envs",
        ),
        (
            lambda: _config(name="paired", max_steps=9),
            ConfigError,
            r"rollout.num_steps is 8 and env.max_steps 9; raise the one or lower the other$",
        ),
        (lambda: PairedConfig(antagonist_return="best"), ValueError, r"is 'best'; choose one of mean, max$"),
        (lambda: PairedConfig(epochs=0), ValueError, r"^PairedConfig.epochs is 0; it must be 1 or more$"),
        (lambda: PairedConfig(learning_rate=0.0), ValueError, r"learning_rate is 0.0; it must be above 0$"),
        (lambda: PairedConfig(entropy_coefficient=-1.0), ValueError, r"-1.0; it must be 0 or more$"),
    ],
)
def test_wrong_settings_are_refused(make, error, said):
    with pytest.raises(error, match=said):
        make()


def test_its_settings_are_part_of_the_hash_of_its_own_runs_alone():
    changed = PairedConfig(epochs=3)
    assert _config(name="sfl").hash == _config(name="sfl", paired=changed).hash
    assert _config(name="paired").hash != _config(name="paired", paired=changed).hash
