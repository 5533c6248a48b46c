"""Training by a stand-in, for tests of what starts and follows the runs of a sweep or a study."""

import json
import subprocess
import sys
import time

from kinetix_dist.sweep import run_loop


def replace_training(monkeypatch, tmp_path, program, facts):
    """Runs are started as `program FACTS ARGUMENTS`; (slot, arguments) of all that were started, in a list."""
    commands = []

    def start(words, slot, log):
        arguments = words[1:]
        assert words[0] == "train"
        commands.append((slot.name, arguments))
        # One file each: another may be reading its own.
        file = tmp_path / f"facts_{len(commands)}_{time.monotonic_ns()}.json"
        file.write_text(json.dumps(facts))
        command = [sys.executable, "-S", str(program), str(file), *arguments]
        return subprocess.Popen(command, stdout=log.open("ab"), stderr=subprocess.STDOUT, start_new_session=True)

    monkeypatch.setattr(run_loop, "start_command", start)
    monkeypatch.setattr(run_loop, "POLL_S", 0.02)
    return commands
