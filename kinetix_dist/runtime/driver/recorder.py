"""Writes rollouts of a run: recordings/*.mcap, and at the end an .rrd and a picture of a solved and of a failed one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.errors import one_line
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.recording import Rollout
from kinetix_dist.telemetry.sinks.mcap import McapSink


class Recorder:
    """One file a recording, named by the policy version; no file is ever overwritten."""

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        self.last: list[Rollout] = []
        self.last_file: Path | None = None

    def __call__(self, rollouts: Sequence[Rollout]) -> None:
        if not rollouts:
            return
        self.last = list(rollouts)
        try:
            self._write(rollouts)
        except OSError as error:  # training is worth more than a recording of it
            self._run.event("recording_failed", path=str(self._run.recordings), error=one_line(error))

    def _write(self, rollouts: Sequence[Rollout]) -> None:
        self._run.recordings.mkdir(exist_ok=True)
        stem = f"update_{rollouts[0].policy_version:06d}"
        path = self._run.recordings / f"{stem}.mcap"
        number = 1
        while path.exists():
            number += 1
            path = self._run.recordings / f"{stem}-{number}.mcap"
        with McapSink(path, max_queued=max(len(rollouts), 1), on_event=self._event) as sink:
            for rollout in rollouts:
                sink.write(rollout)
        self.last_file = path
        update = rollouts[0].policy_version
        self._run.event("recorded", update=update, file=path.name, rollouts=len(rollouts))

    def make_pictures(self) -> str | None:
        """`solved.rrd`, `solved.png`, `failed.rrd`, `failed.png` of the last recording, where it has such rollouts. One
        line where that cannot be: a trained policy is worth more than pictures of it."""
        try:
            self._draw()
        except (ImportError, OSError) as error:
            self._run.event("pictures_failed", error=one_line(error))
            return f"no pictures of rollouts: {one_line(error)}; `kinetix-dist replay {self._run.path}` tries again"
        return None

    def _draw(self) -> None:
        from kinetix_dist.telemetry.pictures import write_rollout_picture
        from kinetix_dist.telemetry.sinks.rerun import rollout_to_rrd

        for name, wanted in (("solved", True), ("failed", False)):
            rollout = next((rollout for rollout in self.last if rollout.solved == wanted), None)
            if rollout is None:
                continue
            rollout_to_rrd(rollout, self._run.recordings / f"{name}.rrd")
            write_rollout_picture(self._run.recordings / f"{name}.png", rollout)

    def _event(self, name: str, fields: dict[str, Any]) -> None:
        self._run.event(name, **fields)
