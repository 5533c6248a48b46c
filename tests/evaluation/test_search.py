"""Searches find what can be found, say what they tried where nothing was, and are confirmed by the environment."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.evaluation.proofs import replay
from kinetix_dist.evaluation.search.best_first import Archive
from kinetix_dist.evaluation.search.polish import polish
from kinetix_dist.evaluation.search.sampling import MAX_HOLD, held_choices
from kinetix_dist.evaluation.search.solve import METHODS, Solved, Target, solve
from kinetix_dist.evaluation.search.worlds import Budget, Worlds, useful_actions
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import read_proof
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.validate import read_document
from tests.level.documents import cart_document

NUM_WORLDS = 64


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s"))


def document_of(name: str) -> dict:
    return read_document(levels_root() / "s" / f"{name}.json")


def solved(env: Environment, document: dict, *, player: object = None, stored: object = None, **options) -> Solved:
    level = level_from_json(document)
    target = Target(name="a", level=level, document=document, player=player, stored=stored)  # type: ignore[arg-type]
    return solve(env, target, num_worlds=NUM_WORLDS, **options)


@pytest.mark.parametrize(
    "method",
    [pytest.param(method, marks=[] if method in ("random", "best_first") else pytest.mark.long) for method in METHODS],
)
def test_every_method_opens_the_trapdoor(env: Environment, method: str) -> None:
    player = Player(RandomPolicy(env.action_space)) if method == "policy" else None
    shipped = read_proof(levels_root() / "proofs" / "s" / "trapdoor.json").actions
    too_late = np.concatenate([np.zeros((40, 6), np.int32), shipped]) if method == "stored" else None
    found = solved(env, document_of("trapdoor"), seconds=60.0, methods=[method], player=player, stored=too_late)
    assert found.proof is not None and found.proof.method == method
    rollout = replay(env, [level_from_json(document_of("trapdoor"))], [found.proof])[0]
    assert rollout.solved and rollout.num_steps == found.proof.num_steps


def test_a_level_out_of_reach_is_not_solved_and_all_methods_say_how_near_they_came(env: Environment) -> None:
    """A cart that cannot fly, and a goal at the ceiling: nearly 4 m apart."""
    document = document_of("drag_cart")
    document["shapes"][2]["position"] = [4.5, 4.5]
    found = solved(env, document, seconds=3.0)
    assert found.proof is None and [line.split(":")[0] for line in found.tried] == ["random", "cem", "best_first"]
    near = [float(line.split("within ")[1].split(" m")[0]) for line in found.tried]
    assert all(2.5 < metres < 4.5 for metres in near)


def test_how_near_green_came_is_the_distance_of_the_surfaces(env: Environment) -> None:
    """Distance of a disc and the corner of a box that is as high as the middle of the disc."""
    document = {
        "format": "kinetix-dist-level", "version": 1, "name": "near", "size": "s", "gravity": [0.0, 0.0],
        "shapes": [
            {"id": "disc", "type": "circle", "radius": 0.3, "position": [1.0, 2.0], "role": "green"},
            {"id": "box", "type": "box", "width": 1.0, "height": 1.0, "position": [3.0, 1.5], "role": "blue"},
        ],
        "thrusters": [{"shape": "disc", "position": [0.0, 0.0], "angle": 3.14159265, "power": 0.01}],
    }  # fmt: skip
    worlds = Worlds(env, level_from_json(document), NUM_WORLDS)
    played = worlds.play(worlds.start, np.zeros((1, NUM_WORLDS, 6), np.int32), budget := Budget(1.0))
    np.testing.assert_allclose(played.min_gap, 3.0 - 0.5 - 1.0 - 0.3, atol=1e-5)  # from the disc to the corner
    np.testing.assert_allclose(played.min_distance, np.hypot(2.0, 0.5), atol=1e-5)
    assert budget.min_gap == pytest.approx(1.2, abs=1e-5)


def test_a_motor_without_a_speed_brakes_both_ways_alike() -> None:
    document = cart_document()
    document["joints"][0]["motor"]["speed"] = 0.0
    actions = useful_actions(level_from_json(document))
    assert len(actions) == 4 and sorted(set(actions[:, 3].tolist())) == [0, 1]  # the brake, and a thruster


def test_only_actions_that_differ_in_effect_are_tried() -> None:
    def of(document: dict) -> np.ndarray:
        return useful_actions(level_from_json(document))

    assert of(document_of("kick")).tolist() == [[0] * 6, [1, 0, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0]]
    assert of(document_of("hop_home")).tolist() == [[0] * 6, [0, 0, 0, 0, 1, 0]]
    assert len(of(cart_document())) == 6  # a motor and a thruster
    document = document_of("kick")
    document["joints"][0]["motor"]["auto"] = True
    with pytest.raises(ValueError, match="no action moves anything in it"):
        of(document)


def test_held_choices_are_held_between_two_and_64_steps_on_average() -> None:
    choices = held_choices(np.random.default_rng(0), 4096, 256, 50)
    changes = (np.diff(choices, axis=0) != 0).mean(axis=0) * 50 / 49  # one in 50 draws is what it was
    holds = 1.0 / changes
    assert holds.min() > 1.8 and holds.max() < 1.3 * MAX_HOLD and np.median(holds) == pytest.approx(11.3, rel=0.2)


def test_polish_shortens_what_was_found_and_keeps_it_a_solution(env: Environment) -> None:
    """Nothing for 20 steps, then to the right: backward, as every wheel has a positive speed."""
    level: Level = level_from_json(document_of("drag_cart"))
    worlds = Worlds(env, level, NUM_WORLDS)
    rng = np.random.default_rng(0)
    detour = np.zeros((240, 6), np.int32)
    detour[20:] = worlds.actions[2]
    played = worlds.episodes(np.repeat(np.pad(detour, ((0, 16), (0, 0)))[:, None], NUM_WORLDS, axis=1))
    length = int(played.solved_after[0])
    assert length > 20
    shorter, robustness = polish(worlds, [detour[:length]], rng, Budget(60.0))
    assert len(shorter) < length - 10 and robustness > 0.9


def test_the_path_to_a_stored_state_leads_there_also_where_a_shorter_way_to_its_origin_was_found(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit. In the third round world 0 finds a shorter way to the cell that all others have just left."""
    worlds = Worlds(env, level_from_json(document_of("hop_home")), NUM_WORLDS)
    archive, rng = Archive(worlds), np.random.default_rng(0)
    rounds = [(np.zeros(NUM_WORLDS, int), [b"near"] * NUM_WORLDS)]
    rounds += [(np.ones(NUM_WORLDS, int), [b"far"] * NUM_WORLDS)]
    rounds += [(np.array([0, *[2] * (NUM_WORLDS - 1)]), [b"far", *[b"farther"] * (NUM_WORLDS - 1)])]
    for origin, cells in rounds:
        monkeypatch.setattr(archive, "_cells", lambda played, cells=cells: cells)
        actions = worlds.actions[rng.integers(len(worlds.actions), size=(8, NUM_WORLDS))]
        archive.add(origin, actions, worlds.play(archive.states(origin), actions))
    assert [len(archive.path(slot)) for slot in range(4)] == [0, 8, 8, 24]
    for slot in (1, 2, 3):
        state, path = worlds.start, archive.path(slot)
        for start in range(0, len(path), 8):
            state = worlds.play(state, np.repeat(path[start : start + 8, None], NUM_WORLDS, axis=1)).packed_state
        stored = archive.states(np.full(NUM_WORLDS, slot))
        jax.tree.map(np.testing.assert_array_equal, state, stored)
