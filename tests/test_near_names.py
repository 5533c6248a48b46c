"""Names of one file."""

from __future__ import annotations

import pytest

from kinetix_dist.near_names import first_shared


@pytest.mark.parametrize(
    ("names", "shared"),
    [
        ([], None),
        (["a", "b", "ab"], None),
        (["a", "b", "a"], ("a", "a")),
        (["Y", "x", "y"], ("Y", "y")),
        (["straße", "STRASSE"], ("straße", "STRASSE")),
    ],
)
def test_the_first_two_names_of_one_file(names: list[str], shared: tuple[str, str] | None) -> None:
    assert first_shared(names) == shared
