"""Run directories for verdicts, written by formula: a generator of levels with known p, its scoring, its training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.evaluation.learnability import plug_in_learnability
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, OUTCOMES, REFRESH, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line, utc_text
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from kinetix_dist.telemetry.status import STATUS, Status, write_status
from tests.studio.runs_for_tests import metrics_of, write_config

NUM_CANDIDATES, BUFFER = 2048, 64
WINDOW = 16  # updates, of outcomes and of a refresh
ATTEMPTS = 512  # of a window at the buffer, and at fresh levels
LEVELS = [f"level_{k}" for k in range(50)]
FEATURES = ("shapes", "joints")
HARD_JOINTS = 4  # levels with so many are never solved

Random = np.random.Generator


def undecided(chance: Random) -> np.ndarray:
    """p [NUM_CANDIDATES] of a generator half of whose levels are solved sometimes."""
    p = chance.uniform(0.05, 0.95, NUM_CANDIDATES)
    p[: NUM_CANDIDATES // 3] = 0.0
    p[-NUM_CANDIDATES // 6 :] = 1.0
    return chance.permutation(p)


def decided(chance: Random) -> np.ndarray:
    """p of a generator whose levels are solved nearly always or nearly never."""
    return chance.choice([0.02, 0.98], NUM_CANDIDATES)


def write_evaluation(run: Path, phase: str, update: int, rates: Mapping[str, float], *, attempts: int = 50) -> None:
    """Each of 50 levels solved as often as the set, by rounding."""
    sets = {
        name: {"names": LEVELS, "solved": [round(attempts * rate)] * len(LEVELS), "attempts": attempts}
        for name, rate in rates.items()
    }
    row = {"format": 1, "phase": phase, "update": update, "env_steps": 128 * update, "reported_at": update}
    append_line(run / "evaluations.jsonl", row | {"sets": sets})


def write_metrics(run: Path, updates: int, metrics: Callable[[int], Mapping[str, float]]) -> None:
    sink = JsonlSink(run / "metrics" / "metrics.jsonl", resume_at=None)
    shares = {"time/rollout": 0.6, "time/learn": 0.3, "time/idle": 0.1}
    for update in range(1, updates + 1):
        sink.write(update, metrics_of(update) | {"learner/skipped_steps": 0.0} | shares | dict(metrics(update)))
    sink.close()


def write_curriculum(
    run: Path,
    refreshes: int,
    generator: Callable[[Random], np.ndarray],
    *,
    episodes: int,
    fresh_rate: Callable[[int], float] | None = None,
    rise: float = 0.0,
    probe_levels: int = 0,
    has_pairs: bool = False,
    seed: int = 0,
) -> None:
    """Refreshes that choose by so many episodes a level, and windows of training at their buffers.

    fresh_rate: solve rate of fresh levels by update; None: that of the generator. rise: of p of the buffer's levels,
    from each quarter of a buffer's use to the next.
    """
    chance = np.random.default_rng(seed)
    outgoing: tuple[int, np.ndarray] | None = None
    for number in range(refreshes):
        p = generator(chance)
        features = chance.integers(0, HARD_JOINTS + 1, (NUM_CANDIDATES, len(FEATURES))).astype(np.uint8)
        p[features[:, 1] == HARD_JOINTS] = 0.0
        solved, finished = chance.binomial(episodes, p), np.full(NUM_CANDIDATES, episodes)
        score = plug_in_learnability(solved, finished)
        chosen = np.lexsort((-solved, -score))[:BUFFER]
        version = WINDOW * number
        arrays: dict[str, Any] = {
            "curriculum": np.str_("sfl"), "size": np.str_("s"), "policy_version": np.int32(version),
            "written_after": np.int32(version), "first_batch": np.int32(version),
            "scoring_seconds": np.float64(1.5), "level_id": (10_000 * number + chosen).astype(np.uint64),
            "score": score[chosen].astype(np.float32), "features": features[chosen],
            "feature_names": np.array(FEATURES), "candidate": chosen.astype(np.int32),
            "solved": solved[chosen].astype(np.int32), "finished": finished[chosen].astype(np.int32),
            "candidates/solved": solved.astype(np.int32), "candidates/finished": finished.astype(np.int32),
            "candidates/features": features,
        }  # fmt: skip
        if probe_levels and outgoing is not None:
            rows = np.arange(probe_levels)
            arrays |= {
                "probe/policy_version": np.int32(outgoing[0]),
                "probe/index": rows.astype(np.int32),
                "probe/solved": chance.binomial(8, outgoing[1][rows]).astype(np.int32),
                "probe/finished": np.full(probe_levels, 8, np.int32),
            }
        (run / DIRECTORY).mkdir(parents=True, exist_ok=True)
        write_snapshot(run / DIRECTORY, REFRESH, version, arrays)
        now = p[chosen]
        for first in range(version, version + WINDOW, WINDOW // 4):
            rate = float(p.mean()) if fresh_rate is None else fresh_rate(first)
            write_window(run, version, first, now, rate, chance, pairs_of=p if has_pairs else None)
            now = np.minimum(now + rise, 1.0)
        outgoing = (version, now)


def write_window(
    run: Path, buffer: int, first: int, p: np.ndarray, fresh: float, chance: Random, *, pairs_of: np.ndarray | None
) -> None:
    attempts = chance.multinomial(ATTEMPTS, np.full(len(p), 1 / len(p)))
    row: dict[str, Any] = {
        "format": 2, "update": first + WINDOW // 4, "from_update": first, "buffer": buffer,
        "solved": chance.binomial(attempts, p).tolist(), "attempts": attempts.tolist(),
        "sources": {"fresh": {"solved": round(ATTEMPTS * fresh), "attempts": ATTEMPTS}},
    }  # fmt: skip
    if pairs_of is not None:
        twice = chance.binomial(2, chance.choice(pairs_of, ATTEMPTS // 2))
        row["fresh_pairs"] = {name: int((twice == count).sum()) for count, name in enumerate(("none", "one", "both"))}
    append_line(run / DIRECTORY / OUTCOMES, row)


def write_state(run: Path, state: str, phase: str, update: int | None, *, error: str | None = None) -> None:
    """status.json of a command on another machine, written now."""
    now = utc_text()
    status = Status(
        state=state, phase=phase, pid=1, host="elsewhere", session=1, started=now, time=now, update=update,
        env_steps=None, total_env_steps=1024, seconds_left=None, update_seconds=1.0, error=error,
    )  # fmt: skip
    write_status(run / STATUS, status)


def write_learning(run: Path, *, refreshes: int = 6, episodes: int = 8) -> Path:
    """A finished run that learns: both sets rise, labels hold, the buffer has more learnability than fresh levels."""
    updates = WINDOW * refreshes
    write_config(run, evaluation={"sets": ["random_s", "frontier_s"]})
    write_metrics(run, updates, lambda update: {"learner/entropy": 5.0 - 2.0 * update / updates})
    write_curriculum(
        run,
        refreshes,
        undecided,
        episodes=episodes,
        fresh_rate=lambda update: 0.3 + 0.2 * update / updates,
        rise=0.05,
        probe_levels=48,
        has_pairs=True,
    )
    write_evaluation(run, "random_policy", 0, {"random_s": 0.35, "frontier_s": 0.12})
    write_evaluation(run, "before", 0, {"random_s": 0.34, "frontier_s": 0.14})
    write_evaluation(run, "training", updates // 2, {"random_s": 0.48, "frontier_s": 0.3})
    write_evaluation(run, "after", updates, {"random_s": 0.54, "frontier_s": 0.4})
    write_state(run, "finished", "done", updates)
    return run


def write_mislabelled(run: Path, *, refreshes: int = 6) -> Path:
    """A run that gains little: two episodes a level choose a buffer whose levels are nearly always or never solved."""
    updates = WINDOW * refreshes
    write_config(run, evaluation={"sets": ["random_s"]})
    write_metrics(run, updates, lambda update: {})
    write_curriculum(run, refreshes, decided, episodes=2, has_pairs=True)
    write_evaluation(run, "random_policy", 0, {"random_s": 0.35})
    write_evaluation(run, "before", 0, {"random_s": 0.35})
    write_evaluation(run, "after", updates, {"random_s": 0.37})
    write_state(run, "finished", "done", updates)
    return run


def write_collapsed(run: Path, *, refreshes: int = 6) -> Path:
    """A run that learns for a half, then falls to nothing: entropy near 0, gradient steps skipped."""
    updates = WINDOW * refreshes
    half = updates // 2
    write_config(run, evaluation={"sets": ["random_s", "frontier_s"]})

    def metrics(update: int) -> dict[str, float]:
        if update <= half:
            return {"train/solve_rate": 0.5, "learner/entropy": 5.0}
        return {"train/solve_rate": 0.03, "learner/entropy": 0.01, "learner/skipped_steps": float(update % 7 == 0)}

    write_metrics(run, updates, metrics)
    write_curriculum(
        run, refreshes, undecided, episodes=8, fresh_rate=lambda u: 0.3 + 0.2 * u / half if u < half else 0.03
    )
    for phase, update, rate in (("random_policy", 0, 0.35), ("before", 0, 0.35), ("training", half, 0.5)):
        write_evaluation(run, phase, update, {"random_s": rate, "frontier_s": rate - 0.2})
    write_evaluation(run, "after", updates, {"random_s": 0.04, "frontier_s": 0.02})
    write_state(run, "finished", "done", updates)
    return run
