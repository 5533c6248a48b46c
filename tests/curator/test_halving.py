"""Successive halving on candidates of known chances, against a simulation in numpy that shares no code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.curator.config import SlicesConfig
from kinetix_dist.curator.halving import Halving, _best, num_launches

SIZE = 384
ATTEMPTS, KEPT = (2, 8, 24), SlicesConfig().num_in_rounds(SIZE)


def _chances(rng, shape):
    """Chances of random levels: most are never solved, some always, p(1 - p) has a mean of about .06."""
    kind = rng.random(shape)
    return np.where(kind < 0.55, 0.0, np.where(kind < 0.72, 1.0, rng.beta(0.6, 0.9, shape)))


@pytest.fixture(scope="module")
def tried():
    """(chances, solved, attempts, kept) of 12 batches."""
    halving, chances = Halving(SIZE, ATTEMPTS, KEPT), _chances(np.random.default_rng(0), (12, SIZE))

    @jax.jit
    def play(p, number, key):
        return (jax.random.uniform(key, (SIZE,)) < p[number]).astype(jnp.int32)

    def one(p, key):
        found = halving(lambda number, key: play(p, number, key), key)
        return found.num_solved, found.num_attempts, found.finalists

    keys = jax.random.split(jax.random.key(1), len(chances))
    found = [one(jnp.asarray(p), key) for p, key in zip(chances, keys, strict=True)]
    return chances, *(np.stack(part) for part in zip(*found, strict=True))


def test_the_better_ones_go_on_however_often_they_were_tried():
    """s (f - s) (f + 1) is more than an int32 holds."""
    chosen, solved = jnp.arange(4, dtype=jnp.int32), jnp.array([1, 1024, 2976, 2000], jnp.int32)
    assert _best(solved, chosen, 3, 4000).tolist() == [3, 2, 1]
    with pytest.raises(ValueError, match="to 65536 or less"):
        SlicesConfig(attempts=(2, 8, 65_537))


def test_a_third_and_then_half_of_it_go_on(tried):
    _, _, attempts, kept = tried
    assert KEPT == (384, 128, 64)
    for batch, slots in zip(attempts, kept, strict=True):
        assert {count: int((batch == count).sum()) for count in ATTEMPTS} == {2: 256, 8: 64, 24: 64}
        assert sorted(slots) == np.flatnonzero(batch == 24).tolist()


def test_certain_levels_are_counted_exactly(tried):
    chances, solved, attempts, _ = tried
    assert (solved[chances == 0] == 0).all() and (solved[chances == 1] == attempts[chances == 1]).all()


def _numpy_halving(p, rng):
    """(mean true p (1 - p) of the best 32 after halving, the same by two attempts alone)."""
    first = rng.binomial(2, p)
    order = np.lexsort((np.arange(SIZE), -first, -first * (2 - first)))
    two_alone = order[:32]
    eight = first[order[:128]] + rng.binomial(6, p[order[:128]])
    chosen = order[:128][np.argsort(-(eight * (8 - eight) * 9 + eight), kind="stable")[:64]]
    all_eight = dict(zip(order[:128].tolist(), eight.tolist(), strict=True))
    last = np.array([all_eight[c] for c in chosen.tolist()]) + rng.binomial(16, p[chosen])
    best = chosen[np.argsort(-last * (24 - last), kind="stable")[:32]]
    return tuple((p[slots] * (1 - p[slots])).mean() for slots in (best, two_alone))


def test_what_is_chosen_is_as_learnable_as_in_a_simulation_and_more_than_by_two_attempts(tried):
    chances, solved, attempts, _ = tried
    true = []
    for p, s, n in zip(chances, solved, attempts, strict=True):
        best = np.argsort(-np.where(n == 24, s * (n - s), -1), kind="stable")[:32]
        true.append((p[best] * (1 - p[best])).mean())
    rng = np.random.default_rng(2)
    expected, by_two = np.array([_numpy_halving(_chances(rng, SIZE), rng) for _ in range(200)]).T
    # One batch differs from another by a standard deviation of .01; that of 12 is .003.
    assert np.mean(true) == pytest.approx(expected.mean(), abs=4 * expected.std() / np.sqrt(len(true)))
    assert expected.mean() == pytest.approx(0.220, abs=0.003) and by_two.mean() == pytest.approx(0.180, abs=0.003)
    claimed = np.mean([np.sort((s * (n - s) / n**2)[n == 24])[-32:].mean() for s, n in zip(solved, attempts)])
    assert 0 < claimed - np.mean(true) < 0.02  # by two attempts it would be .05


def test_attempts_that_candidates_had_before_are_not_played_again():
    requested = []

    def play(number, key):
        del key
        requested.append(np.asarray(number))
        return jnp.zeros(len(number), jnp.int32)

    found = Halving(6, (2, 4), (6, 2))(play, jax.random.key(0), num_solved=1, num_known=1)
    # One attempt of all six, then two more of the two that are kept: four worlds, of a launch of six.
    assert [launch.tolist() for launch in requested] == [[0, 1, 2, 3, 4, 5], [0, 0, 1, 1, 0, 0]]
    np.testing.assert_array_equal(found.num_attempts, [4, 4, 2, 2, 2, 2])
    np.testing.assert_array_equal(found.num_solved, 1)
    assert num_launches((2, 4), (6, 2)) == 2 + 1
    assert num_launches(ATTEMPTS, KEPT) == 2 + 2 + 3
