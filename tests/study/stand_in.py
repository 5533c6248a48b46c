"""Stand-in for `kinetix-dist train`, for tests of the loop around it: files of a run of two updates in 0.1 s.

python stand_in.py FACTS --run DIR [--resume] ...      FACTS: JSON file {hashes, rates, fails, held}

hashes and rates are by the name of the run; one in "fails" ends with 1; one in "held" waits for SIGTERM after its first
update unless it is resumed, and ends with 75 then.
"""

import json
import signal
import sys
import time
from pathlib import Path

LEVELS, NUM_UPDATES, STEPS = 20, 2, 128


def main() -> None:
    facts, arguments = json.loads(Path(sys.argv[1]).read_text()), sys.argv[2:]
    run = Path(arguments[arguments.index("--run") + 1])
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(75))
    metrics, evaluations = run / "metrics" / "metrics.jsonl", run / "evaluations.jsonl"
    metrics.parent.mkdir(parents=True, exist_ok=True)
    metrics.touch()
    if run.name in facts["fails"]:
        sys.exit("kinetix-dist: out of memory")
    update = len(metrics.read_text().splitlines()) if "--resume" in arguments else 0
    assert "--resume" in arguments or not (run / "config.json").exists()
    (run / "config.json").write_text(json.dumps({"hash": facts["hashes"][run.name]}))
    with metrics.open("a") as rows, evaluations.open("a") as lines:
        if update == 0:
            write(lines, evaluation("before", 0, 0.0))
        while update < NUM_UPDATES:
            update += 1
            phase = "after" if update == NUM_UPDATES else "training"
            write(lines, evaluation(phase, update, facts["rates"][run.name] * update / NUM_UPDATES))
            seconds = {"progress/seconds": 7.0 + 2 * update, "progress/warmup_seconds": 7.0}
            write(rows, {"update": update, "progress/env_steps": STEPS * update, **seconds})
            is_held = run.name in facts["held"] and "--resume" not in arguments
            time.sleep(600 if is_held else 0.02)


def evaluation(phase: str, update: int, rate: float) -> dict:
    names = [str(index) for index in range(LEVELS)]
    solved = [int(index < round(rate * LEVELS)) for index in range(LEVELS)]
    sets = {"designed_s": {"names": names, "solved": solved, "attempts": 1}}
    return {"phase": phase, "update": update, "env_steps": STEPS * update, "sets": sets}


def write(file, row: dict) -> None:
    file.write(json.dumps(row) + "\n")
    file.flush()


if __name__ == "__main__":
    main()
