"""Programs of published packages, each run in the package's own environment (bench/peers/setup*.sh make them)."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[1]


class PeerMissing(Exception):
    """The published package is not installed here; one line says what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerProgram:
    """A program of bench/peers and the environment it runs in."""

    program: str
    folder: str  # under bench/.peers
    setup: str  # script in bench/peers that installs it
    variable: str  # environment variable that names another Python; with PATH at its end, what to add to its path

    def python(self) -> Path:
        named = os.environ.get(self.variable)
        path = Path(named) if named else CHECKOUT / "bench" / ".peers" / self.folder / "bin" / "python"
        if not path.is_file():
            raise PeerMissing(f"{path} does not exist; run `bash bench/peers/{self.setup}` first")
        return path

    def run(self, request: dict[str, Any], to: Path) -> None:
        """Runs `PROGRAM REQUEST.json TO` on the CPU. Raises PeerMissing, or RuntimeError with its last line."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment["JAX_PLATFORMS"] = "cpu"
        if path := os.environ.get(f"{self.variable}PATH"):
            environment["PYTHONPATH"] = path
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "request.json"
            file.write_text(json.dumps(request))
            program = CHECKOUT / "bench" / "peers" / self.program
            command = [str(self.python()), str(program), str(file), str(to)]
            ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode != 0:
            last = (ended.stderr.strip().splitlines() or ["no message"])[-1]
            raise RuntimeError(f"{self.program} failed: {last}")


PUBLISHED_JAX2D_STEPS = PeerProgram(
    program="jax2d_published_steps.py", folder="jax2d", setup="setup.sh", variable="KINETIX_PEER_PYTHON"
)
PUBLIC_PACKAGE_PLAY = PeerProgram(
    program="kinetix_play.py", folder="kinetix", setup="setup_kinetix.sh", variable="KINETIX_PACKAGE_PYTHON"
)
