"""Levels of a group are the same whichever other groups are drawn, so that they do not depend on how groups are spread.

Compiled as users do it: without most optimisations programs for other numbers of levels round the last bits otherwise.
"""

import jax
import numpy as np
import pytest

from kinetix_dist.curator.config import CurriculumConfig
from tests.curator.proposals import GROUPS, buffer_of, propose

pytestmark = pytest.mark.long

OPTIMISED = True


@pytest.mark.parametrize(
    ("name", "parts"),
    [("sfl", [[0, 1], [2, 3]]), ("sfl", [[0, 1, 2], [3]]), ("domain_randomization", [[0], [1], [2, 3]])],
)
def test_levels_of_a_group_do_not_depend_on_which_other_groups_are_drawn(name, parts):
    config = CurriculumConfig(name=name)
    buffer = buffer_of(0, [1] * 6, 2) if name == "sfl" else None
    apart = [propose(config, groups, buffer) for groups in parts]
    joined = jax.tree.map(lambda *xs: np.concatenate(xs), *apart)
    jax.tree.map(np.testing.assert_array_equal, propose(config, range(GROUPS), buffer), joined)
