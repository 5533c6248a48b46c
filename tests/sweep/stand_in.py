"""Stand-in for `kinetix-dist train`, for tests of the loop around it: files of a run that trains 10 s in 0.1 s.

python stand_in.py HASHES --run DIR [--resume] ...      HASHES: JSON file, {name of a run: hash of its config}

It goes on from the files that are there, ends with 75 at SIGTERM, and fails where the name of the run is in "fails";
those in "unevaluated" are never evaluated, those in "held" wait for SIGTERM at second 20 unless they are resumed.
"""

import json
import signal
import sys
import time
from pathlib import Path

SETS, LEVELS, EVERY_UPDATES, SECONDS_AN_UPDATE, WARMUP_S = ("dev_designed_s",), 20, 5, 2.0, 7.0
HELD_AT_S = 20.0


def main() -> None:
    facts, arguments = json.loads(Path(sys.argv[1]).read_text()), sys.argv[2:]
    run = Path(arguments[arguments.index("--run") + 1])
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(75))
    metrics, evaluations = run / "metrics" / "metrics.jsonl", run / "evaluations.jsonl"
    metrics.parent.mkdir(parents=True, exist_ok=True)
    metrics.touch()  # before config.json, by which the sweep knows that there is a run to resume
    if run.name in facts.get("fails", []):
        sys.exit("kinetix-dist: out of memory")
    update = len(metrics.read_text().splitlines()) if "--resume" in arguments else 0
    assert "--resume" in arguments or not (run / "config.json").exists()
    (run / "config.json").write_text(json.dumps({"hash": facts["hashes"][run.name]}))
    with metrics.open("a") as rows, evaluations.open("a") as lines:
        if update == 0:
            write(lines, evaluation("before", 0, 0.0))
        while True:
            update += 1
            seconds = SECONDS_AN_UPDATE * (update - 1)
            if (update - 1) % EVERY_UPDATES == 0 and update > 1 and run.name not in facts.get("unevaluated", []):
                write(lines, evaluation("training", update, facts["rates"][run.name] * seconds / 100))
            write(rows, {"update": update, "progress/seconds": WARMUP_S + seconds, "progress/warmup_seconds": WARMUP_S})
            is_held = run.name in facts.get("held", []) and "--resume" not in arguments and seconds >= HELD_AT_S
            time.sleep(600 if is_held else 0.02)


def evaluation(phase: str, update: int, rate: float) -> dict:
    names = [str(index) for index in range(LEVELS)]
    sets = {
        name: {"names": names, "solved": [int(index < rate * LEVELS) for index in range(LEVELS)], "attempts": 1}
        for name in SETS
    }
    return {"phase": phase, "update": update, "env_steps": update, "sets": sets}


def write(file, row: dict) -> None:
    file.write(json.dumps(row) + "\n")
    file.flush()


if __name__ == "__main__":
    main()
