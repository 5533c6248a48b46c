"""Run directories as training writes them, without training: by its own sinks, with numbers that a formula gives."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from kinetix_dist.telemetry.json_lines import append_line
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink

STEPS = 128  # of an update
SECONDS = 10.0


@functools.cache
def config_text() -> str:
    from kinetix_dist.config import to_dict
    from kinetix_dist.recipes import recipe

    config = recipe("tiny")
    return json.dumps({"hash": config.hash, "config": to_dict(config)})


def metrics_of(update: int, **more: float) -> dict[str, float]:
    return {
        "progress/updates": update,
        "progress/env_steps": STEPS * update,
        "progress/seconds": SECONDS * update,
        "progress/env_steps_per_second": STEPS / SECONDS,
        "train/episodes": 10,
        "train/solve_rate": solve_rate(update),
        "learner/entropy": 5.0,
        **more,
    }


def solve_rate(update: int) -> float:
    return (update % 50) / 50


def write_config(run: Path, /, **sections: dict[str, Any]) -> Path:
    """The configuration of recipe tiny, with other values in some sections."""
    run.mkdir(parents=True, exist_ok=True)
    stored = json.loads(config_text())
    for section, fields in sections.items():
        stored["config"][section] |= fields
    (run / "config.json").write_text(json.dumps(stored))
    return run


def write_rows(run: Path, first: int, last: int, *, resume_at: int | None = None, **more: float) -> None:
    """Rows of updates first to last. resume_at: as a session that goes on from there, which removes later rows."""
    sink = JsonlSink(run / "metrics" / "metrics.jsonl", resume_at=resume_at)
    for update in range(first, last + 1):
        sink.write(update, metrics_of(update, **more))
    sink.close()


def write_run(run: Path, updates: int = 20, /, **sections: dict[str, Any]) -> Path:
    write_config(run, **sections)
    write_rows(run, 1, updates)
    append_line(
        run / "events.jsonl",
        {"time": "2026-01-31T12:00:00Z", "event": "buffer_adopted", "policy_version": 0, "update": 0},
    )
    return run


def write_evaluations(run: Path, sets: dict[str, tuple[list[str], int, list[list[int]]]], *, every: int = 10) -> None:
    """Lines of evaluations.jsonl: random actions, before, and every `every` updates; the last one is "after".

    sets: {name: (names of levels, attempts at each, solved of each in each evaluation)}.
    """
    count = min(len(solved) for _, _, solved in sets.values())
    for k in range(count):
        phase = "random_policy" if k == 0 else "before" if k == 1 else "after" if k == count - 1 else "training"
        update = max(k - 1, 0) * every
        lines = {
            name: {"names": names, "solved": solved[k], "attempts": attempts}
            for name, (names, attempts, solved) in sets.items()
        }
        row = {"format": 1, "phase": phase, "update": update, "env_steps": STEPS * update, "reported_at": update}
        append_line(run / "evaluations.jsonl", row | {"sets": lines})
