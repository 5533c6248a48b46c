"""Fingerprints of the sets of levels that are drawn when they are used, for `kinetix_dist/level/fingerprints.py`.

    python -m bench.set_fingerprints --json levels/fingerprints.json

Sets in the file stay as they are; to change a set on purpose, remove its line. Those of frontier sets
are in their own file, which `bench.frontier_sets` writes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from bench.program import exit_code, parser_of
from kinetix_dist.atomic_files import replace_file
from kinetix_dist.level.fingerprints import NUM_CHECKED, fingerprint
from kinetix_dist.level.sets import RANDOM_SETS, VARIED_SETS, load_level_set
from kinetix_dist.program_cache import enable_compile_cache


def run(file: Path) -> int:
    enable_compile_cache("")
    known = json.loads(file.read_text()) if file.is_file() else {}
    for name in (*RANDOM_SETS, *VARIED_SETS):
        if name in known:
            print(f"{name}: stays as it is in {file}")
            continue
        levels, _ = load_level_set(name, num_levels=NUM_CHECKED if name in RANDOM_SETS else None)
        known[name] = fingerprint(levels)
        replace_file(file, (json.dumps(known, indent=0) + "\n").encode())
        print(f"{name}: {known[name][:40]} ...", flush=True)
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments.json))


if __name__ == "__main__":
    sys.exit(main())
