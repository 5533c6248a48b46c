"""Planning at test time: what a search finds solves in the environment, is repeated by its seed, and is executed in
closed loop."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import index_worlds, stack_worlds
from kinetix_dist import prng
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.planning.execution import execute, judged, problems_of
from kinetix_dist.evaluation.planning.explore_round import explore_round
from kinetix_dist.evaluation.planning.held_round import held_round
from kinetix_dist.evaluation.planning.planner import Budget, Plan, Planner, PlannerSize
from kinetix_dist.evaluation.planning.problems import Candidates
from kinetix_dist.evaluation.planning.proposals import variants
from kinetix_dist.evaluation.planning.search_rates import SearchOptions, SearchRates, search_rates
from kinetix_dist.evaluation.policies import NoopPolicy, Player
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import load_level
from tests.helpers import num_compiled

SIZE = PlannerSize(num_slots=2, num_worlds=32)
MAX_STEPS = 64


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=MAX_STEPS))


@pytest.fixture(scope="module")
def levels() -> Level:
    """The trapdoor, which is soon solved, and a cart whose goal is out of its reach."""
    trapdoor, _ = load_level(levels_root() / "s" / "trapdoor.json")
    cart, _ = load_level(levels_root() / "s" / "drag_cart.json")
    position = np.array(cart.position)
    position[np.asarray(cart.shape_role) == 2] = 4.5  # blue, at the ceiling
    return stack_worlds([trapdoor, dataclasses.replace(cart, position=position)])


@pytest.fixture(scope="module")
def player(env: Environment) -> Player:
    """A policy that never solves anything."""
    return Player(NoopPolicy(env.action_space))


@pytest.fixture(scope="module")
def planner(env: Environment, player: Player) -> Planner:
    return Planner(env, player, size=SIZE)


@pytest.fixture(scope="module")
def plans(planner: Planner, levels: Level) -> list[Plan]:
    return planner.plan(problems_of(planner.env, levels), Budget.of(2, rounds=4))


def confirmed(env: Environment, levels: Level, candidates: Candidates, slot: int) -> list[bool]:
    """Of each solution of a slot: the environment solves the level in exactly as many steps."""
    number = candidates.solved_after.shape[1]
    episodes = judged(env, index_worlds(levels, np.full(number, slot)), candidates.actions[:, slot])
    after = np.asarray(candidates.solved_after[slot])
    claimed = after > 0
    return (np.asarray(episodes.solved) & (np.asarray(episodes.episode_length) == after))[claimed].tolist()


def test_rounds_hand_on_actions_that_solve_the_level_in_the_environment(
    env: Environment, levels: Level, player: Player
) -> None:
    """Also those of populations, whose actions are read backwards along the parents. Bit for bit, step for step."""
    problems, slots = problems_of(env, levels), jnp.arange(2)
    for number in range(2):
        key = prng.key(number)
        problems, held = held_round(env, problems, slots, key, SIZE.num_worlds)
        problems, explored = explore_round(env, player.policy, None, problems, slots, key, SIZE.num_worlds)
        for candidates in (held, explored):
            solutions = confirmed(env, levels, candidates, 0)
            assert solutions and all(solutions)
            assert not np.asarray(candidates.solved_after[1]).any()  # the cart cannot fly
    # The base leads as near to blue as it says.
    state, obs = env.reset(prepared := env.prepare(index_worlds(levels, np.array([1]))))
    del obs
    for step in np.asarray(problems.base[: int(problems.base_length[1]), 1:2]):
        state, *_ = env.transition(prepared, state, jnp.asarray(step))
    np.testing.assert_array_equal(state.distance[0], problems.base_cost[1])
    assert problems.base_cost[1] < prepared.initial_distance[0]


def test_variants_keep_replace_leave_out_and_stretch_the_base(env: Environment) -> None:
    """A base that counts its steps, in the first number of an action: what is left of it stays in order."""
    count = jnp.broadcast_to(jnp.arange(MAX_STEPS)[:, None, None], (MAX_STEPS, 256, 6))
    length = jnp.full(256, 40)
    drawn = np.asarray(variants(env.action_space, prng.key(0), count + 10, length))[..., 0] - 10
    untouched = (drawn[:40] == np.arange(40)[:, None]).all(axis=0)
    assert 0.15 < untouched.mean() < 0.6  # one of four has no patch, and a patch may be short or late
    assert drawn[0].max() <= 3 * 64 and (drawn[45:] < 40).all()
    for world in range(256):
        followed = drawn[drawn[:, world] >= 0, world]
        assert (np.diff(followed) >= 0).all()


def test_a_plan_is_repeated_by_its_seed_and_only_found_where_there_is_one(
    planner: Planner, plans: list[Plan], levels: Level
) -> None:
    trapdoor, cart = plans
    assert trapdoor.actions is not None and trapdoor.rounds <= 4 and trapdoor.robustness > 0.5
    assert cart.actions is None and cart.rounds == 4 and cart.used == 4.0
    again = planner.plan(problems_of(planner.env, levels), Budget.of(2, rounds=4))[0]
    assert again.actions is not None and (again.method, again.rounds) == (trapdoor.method, trapdoor.rounds)
    np.testing.assert_array_equal(again.actions, trapdoor.actions)


def test_what_is_found_too_late_does_not_count(planner: Planner, levels: Level) -> None:
    [late] = planner.plan(problems_of(planner.env, index_worlds(levels, np.array([0]))), Budget.of(1, seconds=1e-6))
    assert late.actions is None and late.rounds == 1 and late.used > 1e-6


def test_execution_replans_where_the_state_deviates_and_the_rest_of_the_plan_fails(
    planner: Planner, player: Player, plans: list[Plan], levels: Level
) -> None:
    """A plan that does not hold, as of another world: the first steps of the plan are turned around."""
    trapdoor = index_worlds(levels, np.array([0]))
    moved = dataclasses.replace(trapdoor, position=trapdoor.position + np.float32(1e-3) * (trapdoor.position > 3.5))
    wrong = dataclasses.replace(plans[0], actions=np.zeros_like(plans[0].actions))
    key = prng.key(0)
    as_planned = execute(planner, player, (trapdoor, trapdoor), plans[:1], Budget.of(1, rounds=8), key)
    assert as_planned.episodes.solved[0] and as_planned.num_replans[0] == 0 and as_planned.was_confirmed.all()
    assert as_planned.episodes.episode_length[0] == len(plans[0].actions)  # type: ignore[arg-type]
    replanned = execute(planner, player, (trapdoor, moved), [wrong], Budget.of(1, rounds=8), key)
    assert replanned.num_replans[0] == 1 and replanned.episodes.solved[0] and 1 <= replanned.used[0] <= 8
    spent = Budget(left=np.zeros(1), in_rounds=True)
    assert not execute(planner, player, (trapdoor, moved), [wrong], spent, key).episodes.solved[0]


@pytest.fixture(scope="module")
def rates(env: Environment, player: Player, levels: Level) -> SearchRates:
    options = SearchOptions(rounds=3, size=SIZE, num_starts=2)
    return search_rates(env, player, levels, ["trapdoor", "cart"], options)


def test_rates_with_search_are_apart_from_those_of_the_policy(rates: SearchRates) -> None:
    assert (rates.alone.total.solved, rates.rate.total.solved) == (0, 1) and rates.num_unconfirmed == 0
    assert rates.starts is not None and [level.attempts for level in rates.starts.levels] == [2, 2]
    assert rates.starts.levels[0].solved == 2 and rates.starts.levels[1].solved == 0
    assert (rates.at(0.0), rates.at(rates.plans[0].used), rates.at(3.0)) == (0.0, 0.5, 0.5)
    content = rates.to_dict(["trapdoor", "cart"])
    assert content["solve_rate"]["policy_alone"]["rate"] == 0.0 and content["solve_rate"]["with_search"]["rate"] == 0.5
    assert [level["solved"] for level in content["levels"]] == [True, False]
    assert content["levels"][1]["found_after_seconds"] is None and content["rate_after"][-1]["rate"] == 0.5


@pytest.mark.parametrize("given", [{}, {"seconds": 0.0}, {"seconds": float("nan")}, {"rounds": 0}, {"seconds": -1.0}])
def test_a_search_without_time_is_refused(given: dict) -> None:
    with pytest.raises(ValueError, match="takes seconds or rounds, more than 0"):
        Budget.of(1, **given)


def test_a_planner_needs_as_many_worlds_as_candidates() -> None:
    with pytest.raises(ValueError, match="8 worlds are too few"):
        PlannerSize(num_slots=1, num_worlds=8)
    with pytest.raises(ValueError, match="0 problems at once"):
        PlannerSize(num_slots=0, num_worlds=64)


def test_the_programs_are_compiled_once_for_all_levels(planner: Planner, plans: list[Plan], levels: Level) -> None:
    del plans  # whose search has compiled them
    before = num_compiled(held_round), num_compiled(explore_round)
    planner.plan(problems_of(planner.env, jax.tree.map(lambda x: x[::-1], levels)), Budget.of(2, rounds=3))
    assert (num_compiled(held_round), num_compiled(explore_round)) == before
