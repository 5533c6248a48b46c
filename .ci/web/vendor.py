"""Copies the libraries of the pages from the npm packages, with version, licence and SHA-256: `make vendor`.

Usage: python .ci/web/vendor.py PACKAGES        from the root of the repository
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

TARGET = Path("kinetix_dist/studio/static/vendor")
FILES = {  # file there: (package, file in it)
    "uPlot.esm.js": ("uplot", "dist/uPlot.esm.js"),
    "uPlot.esm.d.ts": ("uplot", "dist/uPlot.d.ts"),
    "uPlot.min.css": ("uplot", "dist/uPlot.min.css"),
    "uPlot.LICENSE.txt": ("uplot", "LICENSE"),
    "htm_preact.js": ("htm", "preact/standalone.module.js"),
    "htm_preact.LICENSE.txt": ("htm", "LICENSE"),
}


def main(packages: Path) -> None:
    TARGET.mkdir(parents=True, exist_ok=True)
    listed = {}
    for name, (package, source) in FILES.items():
        content = (packages / package / source).read_bytes()
        (TARGET / name).write_bytes(content)
        about = json.loads((packages / package / "package.json").read_text())
        listed[name] = {
            "package": package,
            "file": source,
            "version": about["version"],
            "licence": about["license"],
            "sha256": hashlib.sha256(content).hexdigest(),
        }
    (TARGET / "vendored.json").write_text(json.dumps(listed, indent=2) + "\n")


main(Path(sys.argv[1]))
