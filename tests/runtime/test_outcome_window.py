"""Windows of outcomes.jsonl, by hand-worked cases."""

import numpy as np
import pytest

from kinetix_dist.runtime.driver.run_data import OutcomeWindow

SOURCES = ("fresh",)


def _attempts(attempts, solved=None):
    return {"attempts": np.array(attempts, np.int32), "solved": np.array(solved or [0] * len(attempts), np.int32)}


def test_a_window_ends_after_every_n_updates_of_the_run():
    window = OutcomeWindow(every=2)
    assert window.add(1, _attempts([1, 2, 3], [1, 0, 2]), 0, SOURCES) == []
    (line,) = window.add(2, _attempts([1, 1, 1]), 0, SOURCES)
    assert line == {
        "format": 2,
        "update": 2,
        "from_update": 0,
        "buffer": 0,
        "attempts": [3, 4],
        "solved": [0, 2],
        "sources": {"fresh": {"attempts": 2, "solved": 1}},
    }
    assert window.add(3, _attempts([5, 0, 0]), 0, SOURCES) == []
    assert window.end(3)[0] | {"from_update": 2, "attempts": [0, 0]} == window_line(2, 3, 5)
    assert window.end(3) == []


def window_line(from_update, update, fresh):
    return {
        "format": 2,
        "update": update,
        "from_update": from_update,
        "buffer": 0,
        "attempts": [0, 0],
        "solved": [0, 0],
        "sources": {"fresh": {"attempts": fresh, "solved": 0}},
    }


def test_a_window_ends_before_a_batch_of_another_buffer():
    window = OutcomeWindow(every=10)
    window.add(1, _attempts([1, 1]), 0, SOURCES)
    (line,) = window.add(2, _attempts([1, 7]), 3, SOURCES)
    assert (line["update"], line["buffer"], line["attempts"]) == (1, 0, [1])
    (line,) = window.end(4)
    assert (line["from_update"], line["update"], line["buffer"], line["attempts"]) == (1, 4, 3, [7])


def test_a_curriculum_without_a_buffer_has_sources_alone():
    window = OutcomeWindow(every=1)
    (line,) = window.add(1, _attempts([3, 4]), None, ("fresh", "replayed"))
    assert "attempts" not in line and "buffer" not in line
    assert line["sources"] == {"fresh": {"attempts": 3, "solved": 0}, "replayed": {"attempts": 4, "solved": 0}}


def test_a_window_ends_before_a_batch_of_another_curriculum():
    window = OutcomeWindow(every=10)
    window.add(1, _attempts([5]), None, SOURCES)
    (line,) = window.add(2, _attempts([2, 3]), None, ())  # of a set of two levels
    assert line["sources"] == {"fresh": {"attempts": 5, "solved": 0}} and line["update"] == 1
    (line,) = window.add(3, _attempts([2, 3, 4]), None, ())  # of three
    assert (line["from_update"], line["update"], line["attempts"]) == (1, 2, [2, 3])


@pytest.mark.parametrize("cut", range(1, 12))
def test_a_window_that_goes_on_from_a_checkpoint_gives_the_same_lines(cut):
    rng = np.random.default_rng(1)
    attempts = [_attempts(rng.integers(0, 9, 4).tolist(), rng.integers(0, 9, 4).tolist()) for _ in range(12)]

    def lines(window, start, stop):
        return [line for u in range(start, stop) for line in window.add(u + 1, attempts[u], u // 5, SOURCES)]

    unbroken = OutcomeWindow(every=4)
    expected = lines(unbroken, 0, 12) + unbroken.end(12)
    first = OutcomeWindow(every=4)
    before = lines(first, 0, cut)
    second = OutcomeWindow(every=4)
    second.start(first.description(), first.in_flight(), num_updates=cut, sources=SOURCES)
    assert before + lines(second, cut, 12) + second.end(12) == expected
    assert sum(sum(line["attempts"]) + line["sources"]["fresh"]["attempts"] for line in expected) == sum(
        int(one["attempts"].sum()) for one in attempts
    )


def test_pairs_of_fresh_levels_are_counted_by_how_many_of_the_two_attempts_were_solved():
    def attempts(none, one, both):
        return {**_attempts([8, 4]), "fresh_pairs": np.array([none, one, both], np.int32)}

    window = OutcomeWindow(every=2)
    window.add(1, attempts(3, 1, 0), 0, SOURCES)
    (line,) = window.add(2, attempts(1, 1, 2), 0, SOURCES)
    assert line["fresh_pairs"] == {"both": 2, "one": 2, "none": 4}
    assert (line["attempts"], line["sources"]) == ([8], {"fresh": {"attempts": 16, "solved": 0}})
    window.add(3, attempts(4, 0, 0), 0, SOURCES)
    resumed = OutcomeWindow(every=2)
    resumed.start(window.description(), window.in_flight(), num_updates=3, sources=SOURCES)
    assert resumed.add(4, attempts(0, 4, 0), 0, SOURCES)[0]["fresh_pairs"] == {"both": 0, "one": 4, "none": 4}


def test_a_window_that_an_earlier_version_began_ends_before_the_first_pairs():
    """Its counts have none: they are a line of their own."""
    window = OutcomeWindow(every=4)
    window.add(1, _attempts([2, 2]), 0, SOURCES)
    (line,) = window.add(2, {**_attempts([2, 2]), "fresh_pairs": np.array([0, 1, 0])}, 0, SOURCES)
    assert line["update"] == 1 and "fresh_pairs" not in line
    (line,) = window.end(2)
    assert line["from_update"] == 1 and line["fresh_pairs"] == {"both": 0, "one": 1, "none": 0}


def test_a_stored_window_without_attempts_is_dropped():
    window = OutcomeWindow(every=4)
    old = {"outcomes/finished": np.array([9, 5, 0], np.int64), "outcomes/solved": np.array([8, 2, 0], np.int64)}
    window.start({"outcomes_from": 4, "outcomes_buffer": 0}, old, num_updates=6, sources=SOURCES)
    assert not window.add(7, _attempts([1, 1, 2]), 0, SOURCES)
    (line,) = window.add(8, _attempts([1, 0, 3]), 0, SOURCES)
    assert (line["format"], line["from_update"], line["update"], line["attempts"]) == (2, 6, 8, [1, 5])
