"""Comparison of specialists in words: steps from a policy and steps from scratch.

lines = comparison(read_results(Path("runs/finetune-designed_s")))
"""

from __future__ import annotations

from collections.abc import Sequence

from kinetix_dist.stored_specialists import FROM_SCRATCH, Record

THRESHOLD = 0.9  # solve rate whose steps are compared, one of results.THRESHOLDS


def comparison(records: Sequence[Record]) -> list[str]:
    """A line for each level that has a specialist from scratch and one from a policy; none where nothing can be
    compared. A specialist that never reached the threshold says how far it came."""
    scratch = {_key(record): record for record in records if record["start"] == FROM_SCRATCH}
    others = [record for record in records if record["start"] != FROM_SCRATCH and _key(record) in scratch]
    names = [
        f"{record['level']} seed {_key(record)[1]}" if _has_seeds(records) else record["level"] for record in others
    ]
    width = max(map(len, names), default=0)
    return [
        f"{name:<{width}}  {_reached(record)}; {_reached(scratch[_key(record)])}{_ratio(record, scratch[_key(record)])}"
        for name, record in zip(names, others, strict=True)
    ]


def _key(record: Record) -> tuple[str, int]:
    return record["level"], record.get("seed", 0)


def _has_seeds(records: Sequence[Record]) -> bool:
    return len({record.get("seed", 0) for record in records}) > 1


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
