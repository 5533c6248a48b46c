"""Metrics as TensorBoard event files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from tensorboardX import SummaryWriter

from kinetix_dist.telemetry.names import check_metrics


class TensorboardSink:
    """Writes scalars against environment steps; `purge_after` hides points of a killed session beyond it."""

    def __init__(self, directory: Path, *, purge_after: int | None = None) -> None:
        self._writer = SummaryWriter(str(directory), purge_step=purge_after, flush_secs=10)

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """One point a metric, at `progress/env_steps`; values that are not finite are left out."""
        values = check_metrics(metrics)
        step = int(values.get("progress/env_steps", update))
        for name, value in values.items():
            if math.isfinite(value):
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()
