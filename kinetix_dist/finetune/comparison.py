"""Comparison of specialists in words: steps from a policy and steps from scratch.

lines = comparison(read_results("runs/finetune-designed_s"))
"""

from __future__ import annotations

from collections.abc import Sequence

from kinetix_dist.finetune.results import Record
from kinetix_dist.finetune.specialists import FROM_SCRATCH

THRESHOLD = 0.9  # solve rate whose steps are compared, one of results.THRESHOLDS


def comparison(records: Sequence[Record]) -> list[str]:
    """A line for each level that has a specialist from scratch and one from a policy; none where nothing can be
    compared. A specialist that never reached the threshold says how far it came."""
    scratch = {record["level"]: record for record in records if record["start"] == FROM_SCRATCH}
    others = [record for record in records if record["start"] != FROM_SCRATCH and record["level"] in scratch]
    width = max((len(record["level"]) for record in others), default=0)
    return [
        f"{record['level']:<{width}}  {_reached(record)}; {_reached(scratch[record['level']])}"
        f"{_ratio(record, scratch[record['level']])}"
        for record in others
    ]


def _reached(record: Record) -> str:
    steps = _steps(record)
    if steps is None:
        end = f"{record['final']['rate']:.0%} at the end"
        return f"{record['label']}: not {THRESHOLD:.0%} solved within {record['env_steps']:,} env steps ({end})"
    when = "before any training" if steps == 0 else f"after {steps:,} env steps"
    return f"{record['label']}: {THRESHOLD:.0%} solved {when}"


def _ratio(record: Record, scratch: Record) -> str:
    """Steps from scratch as a multiple of the others, where both are known."""
    ours, theirs = _steps(record), _steps(scratch)
    return f" ({theirs / ours:.1f} times as many)" if ours and theirs else ""


def _steps(record: Record) -> int | None:
    return record["env_steps_to"][str(THRESHOLD)]
