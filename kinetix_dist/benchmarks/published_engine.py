"""The published jax2d in a process of its own: the other end of bench/peers/jax2d_published.py.

Both engines are packages called jax2d, so the peer has its own environment. Its Python is, in this order,
$KINETIX_PEER_PYTHON (with $KINETIX_PEER_PYTHONPATH as its PYTHONPATH: for machines where the packages are only
unpacked), or bench/.peers/jax2d, which bench/peers/setup.sh makes.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from kinetix_dist.benchmarks.line_process import LineProcess, ProcessError
from kinetix_dist.benchmarks.results import Record
from kinetix_dist.errors import UserError

PUBLISHED_PRESET = "paper"  # the one solver it has
PUBLISHED_BACKEND = "xla"


class PublishedProcess(LineProcess):
    """The published engine's process."""

    def __init__(self, checkout: Path) -> None:
        """Starts it; raises UserError where the published engine is not installed."""
        script = checkout / "bench" / "peers" / "jax2d_published.py"
        if not script.is_file():
            raise UserError(f"--peers needs {script}, which is in the repository; run from a checkout")
        python = os.environ.get("KINETIX_PEER_PYTHON") or str(
            checkout / "bench" / ".peers" / "jax2d" / "bin" / "python"
        )
        if not Path(python).is_file():
            raise UserError(f"--peers: {python} does not exist; run `bash bench/peers/setup.sh` first")
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        if path := os.environ.get("KINETIX_PEER_PYTHONPATH"):
            environment["PYTHONPATH"] = path
        # Two processes share the device: neither may take all its memory.
        environment.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        super().__init__("the published engine", [python, str(script)], environment)
        try:
            self.description = self.ask("describe")
        except ProcessError as error:
            self.close()
            raise UserError(f"--peers: {error}") from error

    def prepare(self, size: str, files: list[Path], worlds: int, steps: int, seed: int) -> PublishedEngine:
        """Compiles for these worlds and runs once."""
        self.ask("prepare", levels=[str(file) for file in files], worlds=worlds, steps=steps, seed=seed)
        record = {
            "engine": "published",
            "backend": PUBLISHED_BACKEND,
            "preset": PUBLISHED_PRESET,
            "size": size,
            "worlds": worlds,
            "device": self.description["device"],
        }
        return PublishedEngine(process=self, record=record)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublishedEngine:
    """An `engine_speed.Runner` in the other process."""

    process: PublishedProcess
    record: Record

    def restart(self) -> None:
        self.process.ask("restart")

    def run(self) -> float:
        return self.process.ask("run")["seconds"]
