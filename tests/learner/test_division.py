"""Parts of a batch on each device: every part once, whatever the number of devices."""

import numpy as np
import pytest

from kinetix_dist.learner.division import Division


def test_five_parts_on_three_devices():
    division = Division(5, 3)
    assert division.parts.tolist() == [[0, 1], [2, 3], [4, 4]]
    assert division.is_counted.tolist() == [[True, True], [True, True], [True, False]]
    assert division.spread(10).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 8, 9]
    assert division.gathered(12).tolist() == list(range(10))


@pytest.mark.parametrize("num_parts", [8, 64])
def test_every_part_counts_once_and_the_first_devices_have_at_most_one_more(num_parts):
    for num_devices in range(1, num_parts + 1):
        division = Division(num_parts, num_devices)
        assert division.parts[division.is_counted].tolist() == list(range(num_parts))
        counts = division.is_counted.sum(axis=1)
        assert counts.max() == division.slots and counts.min() >= counts.max() - 1 and np.all(np.diff(counts) <= 0)
        rows = np.arange(2 * num_parts)
        np.testing.assert_array_equal(
            rows[division.spread(rows.size)][division.gathered(division.parts.size * 2)], rows
        )
        assert division.is_even == division.is_counted.all()


def test_a_device_without_a_part_is_refused():
    with pytest.raises(ValueError, match=r"8 parts .* over 9 devices: some would have nothing to do; raise rollout"):
        Division(8, 9)
