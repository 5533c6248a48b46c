"""Makes the glossary of the pages from docs/glossary.md, its one source: `make glossary`.

Usage: python .ci/web/glossary.py        from the root of the repository
"""

from __future__ import annotations

import json
import re
from pathlib import Path

SOURCE = Path("docs/glossary.md")
TARGET = Path("kinetix_dist/studio/static/base/glossary.js")
ROW = re.compile(r"^\| <a id=\"([\w-]+)\"></a>(.*?) \| (.*) \|$", re.MULTILINE)
HEADER = """\
// Terms of the pages. Made from docs/glossary.md by `make glossary`: change that page.

/** By the anchor of a term there. @type {Record<string, { names: string[], text: string }>} */
export const GLOSSARY = """


def glossary(page: str) -> dict[str, dict[str, object]]:
    """Terms {anchor: {names, text}} of the page. Several names of one term are separated by commas."""
    return {
        anchor: {"names": [name.strip() for name in names.split(",")], "text": plain(text)}
        for anchor, names, text in ROW.findall(page)
    }


def plain(text: str) -> str:
    """Text of a cell without links and marks of code."""
    return re.sub(r"\[(.*?)\]\(.*?\)", r"\1", text).replace("`", "")


def script(page: str) -> str:
    """Content of the module for the pages."""
    return f"{HEADER}{json.dumps(glossary(page), indent=2, ensure_ascii=False)};\n"


if __name__ == "__main__":
    TARGET.write_text(script(SOURCE.read_text()))
