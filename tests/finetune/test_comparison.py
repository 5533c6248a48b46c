"""The comparison in words: steps of both starts, and how far a specialist came that never got there."""

from __future__ import annotations

import pytest

from kinetix_dist.finetune.comparison import comparison
from kinetix_dist.finetune.specialists import FROM_SCRATCH

NEVER = "not 90% solved within 200,000 env steps (62% at the end)"


def _record(start: str, steps: int | None, *, level: str = "kick") -> dict:
    return {
        "level": level,
        "start": start,
        "label": "from scratch" if start == FROM_SCRATCH else f"from {start}",
        "env_steps_to": {"0.5": 0, "0.9": steps},
        "env_steps": 200_000,
        "final": {"rate": 0.62},
    }


@pytest.mark.parametrize(
    ("policy", "scratch", "ours", "theirs"),
    [
        (5_000, 20_000, "90% solved after 5,000 env steps", "90% solved after 20,000 env steps (4.0 times as many)"),
        (20_000, 5_000, "90% solved after 20,000 env steps", "90% solved after 5,000 env steps (0.2 times as many)"),
        (0, 20_000, "90% solved before any training", "90% solved after 20,000 env steps"),
        (5_000, None, "90% solved after 5,000 env steps", NEVER),
        (None, 5_000, NEVER, "90% solved after 5,000 env steps"),
        (None, None, NEVER, NEVER),
    ],
)
def test_a_line_for_a_person(policy: int | None, scratch: int | None, ours: str, theirs: str) -> None:
    lines = comparison([_record(FROM_SCRATCH, scratch), _record("policy", policy)])
    assert lines == [f"kick  from policy: {ours}; from scratch: {theirs}"]


def test_levels_are_in_order_and_one_without_the_other_start_is_left_out() -> None:
    records = [
        _record(FROM_SCRATCH, 2, level="kick"),
        _record(FROM_SCRATCH, 2, level="hop_home"),
        _record("policy", 1, level="hop_home"),
        _record("policy", 1, level="kick"),
        _record("policy", 1, level="swing_up"),
    ]
    assert [line.split("  ")[0] for line in comparison(records)] == ["hop_home", "kick"]
    assert comparison(records[:2]) == comparison(records[2:]) == []
