"""Sphinx: the pages of docs/, and those of other folders, as one site. `make docs` builds it into dist/docs.

The root of the repository is the source folder, so that links between pages are those that work on a code host. Nothing
is fetched: fonts are those of the reader's system, search is a script of the site.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

project = "kinetix-dist"
author = "the authors of kinetix-dist"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

root_doc = "docs/index"
source_suffix = {".md": "markdown"}
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "docs/**",
    "bench/README.md",
    "cluster/README.md",
    "pretrained/README.md",
]
exclude_patterns = [
    *(f"{name}/**" for name in ("jax2d", "kinetix_dist", "levels", "tests", "examples", "runs", "dist")),
    "**/.*",
    "docs/results/*/**",
]

# Anchors of headings, as code hosts make them.
myst_heading_anchors = 4
# Docstrings are plain text with `names`, not reStructuredText: the hook below helps, and what is left is no error.
# Links of pages are MyST's and stay errors.
suppress_warnings = ["misc.highlighting_failure", "docutils"]

html_theme = "furo"
html_title = "kinetix-dist"
html_show_sourcelink = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", _mark_code)


def _mark_code(app: Any, kind: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Makes `names` of docstrings code."""
    lines[:] = [re.sub(r"(?<!`)`([^`]+)`(?!`)(\w?)", r"``\1``\\ \2", line) for line in lines]
