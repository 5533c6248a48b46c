"""Speed of a verdict: env steps per second, where the time goes, and the process that waits most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import BAD, GOOD, NEUTRAL, UNKNOWN, Statement, counted, percent
from kinetix_dist.studio.runs.warnings import RECENT_ROWS, SPEED, Warned
from kinetix_dist.telemetry.names import RED

SLOW_SHARE = 0.5  # of the median speed
TIMES = {
    "rollout": "playing levels",
    "learn": "gradient steps",
    "curate": "scoring levels, or waiting for it",
    "evaluate": "evaluation",
    "record": "recording",
    "checkpoint": "checkpoints",
    "idle": "dispatch, transfers and waiting",
}


def speed_statement(table: SeriesTable, processes: Mapping[str, Any] | None, warnings: Sequence[Warned]) -> Statement:
    """Env steps per second of the last rows, the largest share of their time, and the process that waits most.

    processes: `processes.Processes.describe`; warnings: `warnings.warnings_of`.
    """
    speeds = table.known("progress/env_steps_per_second")
    title, query = "Speed", {"panel": "Where the time goes"}
    if not len(speeds):
        return Statement(
            key="speed", title=title, state=UNKNOWN, sentence="No row of metrics so far.", query={"panel": "Speed"}
        )
    recent, median = float(speeds[-RECENT_ROWS:].mean()), float(np.median(speeds))
    rows = min(len(speeds), RECENT_ROWS)
    sentence = f"{recent:,.0f} env steps/s (mean of {counted(rows, 'row')})"
    state, remedy = NEUTRAL if len(speeds) < RECENT_ROWS else GOOD, ""
    if recent < SLOW_SHARE * median:
        state, remedy = BAD, RED["progress/env_steps_per_second"][1]
        sentence += f", less than half of its median {median:,.0f}"
    shares = {name: float(known[-RECENT_ROWS:].mean()) for name in TIMES if len(known := table.known(f"time/{name}"))}
    if shares:
        name, share = max(shares.items(), key=lambda item: item[1])
        sentence += f"; most of its time is {TIMES[name]} ({percent(share)})"
    slowed = [warning for warning in warnings if warning.rule.part == SPEED]
    if slowed and state != BAD:
        state = NEUTRAL
        sentence += "".join(f"; {one.rule.metric} {one.finding} (rule: {one.rule.condition})" for one in slowed)
        remedy = "; ".join(one.remedy for one in slowed)
    if idle := _idlest(processes):
        sentence += f"; idlest process: {idle}"
        query = {"panel": "Processes"} if not shares else query
    return Statement(key="speed", title=title, state=state, sentence=f"{sentence}.", remedy=remedy, query=query)


def _idlest(processes: Mapping[str, Any] | None) -> str:
    """ "learner 0, in no call for 60.0 % of the time"; "" where no process that trains reports its idle share."""
    idle = {
        process["name"]: process["idle"]
        for process in (processes or {"processes": ()})["processes"]
        if process["is_there"]
        and process["idle"] is not None
        and process.get("role") in ("worker", "learner", "rollout")
    }
    if not idle:
        return ""
    name, share = max(idle.items(), key=lambda item: item[1])
    return f"{name}, in no call for {percent(share)} of the time"
